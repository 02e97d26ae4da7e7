"""The figure of docs/control.md that shows how roll, yaw and pitch turn the hand.

python -m scripts.axes_figure
"""

from pathlib import Path

import jax
import matplotlib.figure
import numpy as np

from codesign_jax import parameters, scene
from codesign_jax.export import posture, process, sheet

FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "axes.png"


def main() -> None:
    """Draws the hand of the default scene at 0, turned about each axis, and pointing ahead."""
    grasping = scene.load("paper")
    space = parameters.design_space(grasping.hand, "full")
    params = jax.tree.map(np.asarray, space.params(space.default()))
    sizes = process.sizes(grasping.hand, params, process.Process())
    fingers = sheet.corners(grasping, params, sizes)
    palm = grasping.hand.palm
    turns = {**posture.TURNS, "pitch +90°: fingers along +x": {"roll": 0, "yaw": 0, "pitch": 90}}
    figure = matplotlib.figure.Figure(figsize=(11, 2.6))
    for k, (words, angles) in enumerate(turns.items()):
        axes = figure.add_axes((0.01 + 0.198 * k, 0.02, 0.188, 0.86))
        posture.draw(axes, fingers, (1e3 * palm.radius, 1e3 * palm.thickness), angles, words)
        axes.title.set_fontsize(8)
    figure.savefig(FIGURE, dpi=110)


if __name__ == "__main__":
    main()
