"""What designs keep that another study found: the paper's filter, by `scripts.experiments`.

The file has the particles of every seed as they were simulated at some marks, and what they cost
there.  As in `scripts.search`, the 25 best meet 12 fresh trials, which count as the search's, and
400 others judge the one that costs least in these.  The same command goes on where it stopped.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import optimize, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.engines import make_engine
from codesign_jax.optimize import State
from codesign_jax.scene.parameters import design_space
from scripts.search.study import UNFINISHED, Study, make_case
from scripts.shared import provenance
from scripts.shared.output import write_json


class Given(Study):
    """Particles that were found elsewhere: nothing is simulated but their tests."""

    def _start(self) -> State:
        n, any_design = self.case.particles, jnp.asarray(self.space.default())
        return jax.vmap(lambda key: self.case.optimizer.init(key, any_design, n))(self.keys)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(prog="scripts.search.judge", description=__doc__)
    parser.add_argument("--particles", type=Path, required=True, help="particlesG, costG, seeds")
    parser.add_argument("--out", type=Path, required=True, help="result, .json")
    parser.add_argument("--preset", default="23d")
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--optimizer", default=optimize.PAPER, help="what found them")
    parser.add_argument("--before", type=int, default=0, help="grasps that found the seeds")
    parser.add_argument("--tests", type=int, default=400, help="trials of a recommended design")
    parser.add_argument("--minutes", type=float, help="time after which no step begins")
    parser.add_argument("--chunk", type=int, help="most grasps of a call")
    provenance.add_commit(parser)
    args = parser.parse_args(arguments)
    use_compilation_cache()
    begin, scene = time.monotonic(), scenes.load(args.scene)
    engine, space = make_engine("structured", scene), design_space(scene.hand, args.preset)
    with np.load(args.particles) as stored:
        given = {name: stored[name] for name in stored}
    marks = sorted(int(n.removeprefix("particles")) for n in given if n.startswith("particles"))
    seeds, (count, particles, _) = given["seeds"], given[f"particles{marks[0]}"].shape
    case = make_case(f"{args.optimizer}:particles={particles}", space, args.preset)
    chunk = args.chunk or (512 if jax.default_backend() == "cpu" else 16_384)
    how = {"seeds": count, "budget": marks[-1], "tests": args.tests, "chunk": chunk}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    how |= {"first_seed": int(seeds[0]), "path": args.out.with_suffix(".npz")}
    if (seeds != seeds[0] + np.arange(count)).any():
        parser.error(f"--particles: the seeds {seeds.tolist()} do not follow one another")
    study = Given(case, scene, engine, space, **how)
    for mark in [m for m in marks if m not in study.kept]:
        if args.minutes is not None and time.monotonic() - begin > 60 * args.minutes:
            print("the same command goes on", flush=True)
            return UNFINISHED
        study.judge(mark, jnp.asarray(given[f"particles{mark}"]), given[f"cost{mark}"])
        study.save()
        print(f"{mark} grasps: {np.mean(study.kept[mark] >= 0.95):.2f} keep 95 %", flush=True)
    row = study.row() | {"preset": args.preset, "scene": args.scene, "objects": None}
    row |= {"optimizer": args.optimizer, "seeds": seeds.tolist()}
    row["first_seed"] = int(seeds[0])
    row["grasps"] = [args.before + mark + study.tested for mark in marks]
    write_json(args.out, row | {"provenance": provenance.results(args.commit), "tests": args.tests})
    return 0


if __name__ == "__main__":
    sys.exit(main())
