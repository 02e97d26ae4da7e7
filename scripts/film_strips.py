"""Film strips of grasps from two sides: does a finger stand in itself, an edge in a finger?

python -m scripts.film_strips docs/data/experiments/23d.npz --count 10 --out runs/strips

A row is a trial from one side: approach, half and all of the inflation, release, five moments of
the hold.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from codesign_jax import rollout
from codesign_jax import scene as scenes
from codesign_jax.engines import make_engine
from codesign_jax.report import animation
from codesign_jax.scene import keypaths, parameters
from scripts.contact_depths import designs_of

SIDES = (125.0, -20.0, 0.36), (215.0, 5.0, 0.36)
"""Azimuth and elevation [degrees], and distance [m] of the camera."""


def strip(scene: scenes.Scene, grasps: list[animation.Replay], path: Path) -> None:
    """Writes an image of grasps, each from both sides; the camera follows the hand up."""
    p = scene.phases
    low = np.array([p.approach, (p.approach + p.inflate) / 2, p.inflate, scene.end_time])
    rows = []
    for grasp in grasps:
        step = round(p.lift / scene.discretization.timestep)
        up = float(grasp.qpos[step, -5])  # of the object
        for azimuth, elevation, distance in SIDES:
            row = []
            for times, height in ((low, 0.06), (np.linspace(p.lift, p.disturb, 5), up)):
                animation.CAMERA = (0.0, 0.0, height, distance, azimuth, elevation)
                row += [*animation.frames(scene, grasp, times, size=(280, 280))]
            rows.append(np.concatenate(row, axis=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).quantize(128).save(path)


def main() -> None:
    """Command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--count", type=int, default=10, help="designs of each file")
    parser.add_argument("--trials", type=int, default=2, help="of a design, objects in turn")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    scene = scenes.load("paper", overrides=keypaths.parse(args.set))
    space = parameters.design_space(scene.hand, "23d")
    engine = make_engine("structured", scene)
    trials = rollout.sample_trials(scene, jax.random.key(1), args.trials)
    designs = [v for path in args.files for v in designs_of(path)[: args.count]]
    for number, design in enumerate(designs):
        params = space.params(jnp.asarray(design, jnp.float32))
        grasps = animation.replay(scene, engine, params, trials)
        strip(scene, grasps, args.out / f"{number:02d}.png")
        kept = [round(float(g.outcome.cost), 2) for g in grasps]
        print(f"{number:02d}.png: costs {kept}", flush=True)


if __name__ == "__main__":
    main()
