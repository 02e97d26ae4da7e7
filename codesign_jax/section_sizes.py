"""How large the sections of fingers are over a grasp, by the pressure of each moment.

Engines grow contact surfaces in their steps, with the effect `section_growth`.  What looks at poses
that were recorded has no surfaces but those of the design: it takes from here how much larger they
are, to measure depths and to draw.  Moulds and other exports are without pressure.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import control
from codesign_jax.model import morphology
from codesign_jax.model.layout import layout, sections_grow
from codesign_jax.reuse import quickly_compiled
from codesign_jax.scene import Scene, section_growth
from codesign_jax.scene.constants import with_trial
from codesign_jax.types import Params, Trial


def of_bodies(
    scene: Scene, params: Params, trial: Trial, ctrl: jax.Array | None = None
) -> np.ndarray:
    """Width and height of what is on each body over those without pressure.

    Those of a finger's links are the factors of their sections in the engine's contacts; all others
    are 1, also those of its half link at the palm, which touches nothing.

    Args:
      scene: The scene.
      params: Parameters of one hand, concrete arrays.
      trial: Its trial, likewise: silicones differ between trials.
      ctrl: Controls that a policy gave, as `Trace.ctrl`, shape (time, nu); None for those of the
        key frames.

    Returns:
      Factors at the states of a trace, shape (time, body, 2), bodies as in `model.layout`.
    """
    lay = layout(scene)
    steps = scene.num_steps if ctrl is None else len(ctrl)
    sizes = np.ones((steps, len(lay.centre_weights), 2))
    if sections_grow(scene):
        sizes[:, lay.bodies] = _of_links(scene.bare, params, trial, ctrl)
    return sizes


@functools.partial(quickly_compiled, static_argnums=0)
def _of_links(scene: Scene, params: Params, trial: Trial, ctrl: jax.Array | None) -> jax.Array:
    """Factors of width and height, shape (time, finger, N, 2), N = 1 where they are alike."""
    if ctrl is None:
        ctrl = control.commands(scene, params, trial)
    hand = with_trial(scene, trial).hand
    places = morphology.at_joints(layout(scene).links)
    grows = morphology.growth_numbers(hand, params, places)
    # Of the step from a state: that by which its contacts are found.
    height, width = section_growth.factors(grows, ctrl[:, 6:, None])
    return jnp.stack(jnp.broadcast_arrays(width, height), -1)
