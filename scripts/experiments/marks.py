"""How good a design the runs recommend on their way: judged by fresh trials, as in scripts.search.

python -m scripts.experiments.marks --runs runs/paper/23d/concurrent --out runs/paper/marks.npz

After so many grasps of a run, its last episode's particles of least cost meet fresh trials, and the
one that costs least in these is what the run recommends there; it is judged by 400 further ones.
The trials that choose count as the run's, those that judge do not.  MARKS.npz holds the episodes'
particles and costs as well, so that another rule can be judged without the runs.
"""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, rollout, runs, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine, make_engine
from codesign_jax.runs.manifest import read_provenance
from codesign_jax.scene import InputError, Scene, keypaths
from codesign_jax.scene.parameters import design_space
from codesign_jax.types import Outcome, Trial, failed
from scripts.search.study import CANDIDATES, ROUNDS, STREAM_JUDGE
from scripts.shared import output, provenance

AT = (2400, 11_520, 23_040, 46_080)
"""Grasps of a run at which a design is judged."""


def episodes(grasps: int, worlds: int, tested: int) -> int:
    """Episodes of a run after which it has simulated no more than so many grasps.

    Args:
      grasps: All grasps of the run.
      worlds: Grasps of an episode; as many find the seed.
      tested: Grasps that choose the design.
    """
    return max(1, (grasps - worlds - tested) // worlds)


def read(folders: list[Path], at: list[int]) -> dict[str, Any]:
    """Particles and costs of the runs' episodes at the marks that all of them have reached.

    Args:
      folders: Run folders.
      at: Grasps.

    Returns:
      `seeds`, `episodes`, `grasps` (mark,), `population` (mark, run, particle, parameter) and
      `cost` (mark, run, particle).
    """
    found = [runs.load_record(folder) for folder in folders]
    records = [record for record in found if record is not None]
    if not records or len(records) < len(found):
        raise InputError(["not all of the folders hold a run that has begun"])
    done = min(record.done for record in records)
    shape = records[0].history.trials.cost.shape
    worlds, tested = shape[1] * shape[2], min(CANDIDATES, shape[1]) * ROUNDS
    marks = [(episodes(n, worlds, tested), n) for n in at]
    marks = [(e, n) for e, n in marks if e <= done]
    pick = lambda values: np.array([[v[e - 1] for v in values] for e, _ in marks])  # noqa: E731
    return {
        "seeds": np.array([read_provenance(folder)["settings"]["seed"] for folder in folders]),
        "episodes": np.array([e for e, _ in marks]),
        "grasps": np.array([worlds + e * worlds + tested for e, _ in marks]),
        "population": pick([r.history.population for r in records]),
        "cost": pick([r.history.cost for r in records]),
    }


class Judge:
    """Simulates designs in their runs' own fresh trials, in calls of one size."""

    def __init__(self, scene: Scene, engine: Engine, space: Any, seeds: np.ndarray, chunk: int):
        """Compiles nothing yet."""
        self.scene, self.chunk = scene, chunk
        self.keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))

        def simulate(designs: jax.Array, trials: Trial) -> Outcome:
            return rollout.simulate(scene, engine, jax.vmap(space.params)(designs), trials)[0]

        self._simulate = jax.jit(simulate)

    def __call__(self, designs: np.ndarray, trials: int, stream: int, index: int) -> Outcome:
        """Outcomes of shape (run, design, trial).

        Args:
          designs: Designs of each run [SI], shape (run, design, parameter).
          trials: Trials of a run, which all of its designs meet.
          stream: Stream of their noise.
          index: Number in the stream.
        """
        shape = (*designs.shape[:2], trials)

        @jax.jit
        def draw(keys: jax.Array) -> Trial:
            noise = jax.vmap(lambda k: codesign.stream_key(k, stream, index))(keys)
            return jax.vmap(lambda k: rollout.sample_trials(self.scene, k, trials))(noise)

        drawn = jax.tree.map(np.asarray, draw(self.keys))
        run, design, trial = (i.ravel() for i in np.indices(shape))
        parts = []
        for start in range(0, run.size, self.chunk):
            rows = np.minimum(np.arange(start, start + self.chunk), run.size - 1)
            own = jax.tree.map(lambda v, rows=rows: v[run[rows], trial[rows]], drawn)
            made = self._simulate(np.float32(designs[run[rows], design[rows]]), own)
            parts.append(jax.tree.map(np.asarray, made))
        joined = jax.tree.map(lambda *v: np.concatenate(v)[: run.size].reshape(shape), *parts)
        return joined


def judged(judge: Judge, found: dict[str, Any], tests: int) -> dict[str, Any]:
    """The design of each run and mark, and the share of fresh trials that it keeps.

    Args:
      judge: What simulates.
      found: See `read`.
      tests: Trials that judge.
    """
    designs, kept = [], []
    for episode, population, cost in zip(
        found["episodes"], found["population"], found["cost"], strict=True
    ):
        order = np.argsort(cost, axis=1, kind="stable")[:, :CANDIDATES, None]
        best = np.take_along_axis(population, order, 1)
        outcome = judge(best, ROUNDS, codesign.STREAM_TEST, int(episode))
        tested = np.asarray(particle_cost(judge.scene, outcome))
        chosen = np.take_along_axis(best, tested.argmin(1)[:, None, None], 1)
        last = judge(chosen, tests, STREAM_JUDGE, 0)
        good = ~failed(last.status) & (last.cost < SUCCESS_COST)
        designs.append(chosen[:, 0])
        kept.append(good[:, 0].mean(-1))
        share = (kept[-1] >= 0.95).mean()
        print(f"episode {episode}: {share:.0%} of {len(good)} runs keep 95 %", flush=True)
    return found | {"designs": np.array(designs), "kept": np.array(kept)}


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="folder of run folders")
    parser.add_argument("--out", type=Path, required=True, help="file of the results, .npz")
    parser.add_argument("--at", type=int, nargs="+", default=list(AT))
    parser.add_argument("--tests", type=int, default=400, help="trials that judge a design")
    parser.add_argument("--chunk", type=int, help="most grasps of a call")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--only-read", action="store_true", help="particles and costs, no trials")
    args = parser.parse_args()
    use_compilation_cache()
    folders = sorted(args.runs.glob("seed-*"), key=lambda p: int(p.name.split("-")[1]))
    found = read(folders, args.at)
    if not args.only_read:
        scene = scenes.load("paper", overrides=keypaths.parse(args.set))
        space = design_space(scene.hand, read_provenance(folders[0])["settings"]["preset"])
        chunk = args.chunk or (512 if jax.default_backend() == "cpu" else 8192)
        judge = Judge(scene, make_engine("structured", scene), space, found["seeds"], chunk)
        found = judged(judge, found, args.tests)
    print(output.write_arrays(args.out, found))
    notes = provenance.results(args.commit) | {"tests": args.tests, "candidates": CANDIDATES}
    print(output.write_json(args.out.with_suffix(".json"), notes | {"rounds": ROUNDS}, indent=2))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"error: {error}")
