"""Bayesian optimisation beside the default search: TuRBO-1 on Gaussian processes of BoTorch.

python -m scripts.search.turbo --preset 23d --seeds 10 --out runs/search
python -m scripts.search.turbo --preset 2d --budget 936 --particles 12 --tests 200 --out runs/search
taskset -c 0,1 python -m scripts.search.turbo --equal-time --workers 1    # on two cores

Needs `botorch`, which is no dependency of the project.  The method is that of Eriksson et al.
(2019), "Scalable Global Optimization via Local Bayesian Optimization": a trust region around the
best design so far, in which Thompson sampling proposes a batch; the region doubles after three
batches that improve, halves after as many that do not as the space has parameters for each
proposal (at least four), and starts anew once it is small.  Trials, final test and judging trials
are those of `scripts.search` for random designs.  With --equal-time the seeds run one after the
other, each for as long as the default search takes on this machine, without compiling.
"""
# pyright: reportMissingImports=false
# BoTorch and PyTorch are no dependencies.

import math
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, optimize, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.engines import make_engine
from codesign_jax.judge.verdict import WANTED
from codesign_jax.scene.parameters import design_space
from scripts.search.tables import EQUAL_TIME
from scripts.shared import output, provenance
from scripts.shared.lock_step import Study, make_case

LONGEST = 1.6
FIRST = 0.8
SHORTEST = 0.5**7
SUCCESSES = 3
"""Sides of the trust region, largest, first and smallest [bounds of the space = 1], and batches
that improve in a row until it doubles: Eriksson et al."""
CANDIDATES = 2000
"""Points of the region among which Thompson sampling chooses."""
DEFAULT_GRASPS = 4794
"""Grasps of the default search, most of them at the accuracy `fast`."""


class Region(NamedTuple):
    """A seed's trust region.

    Attributes:
      length: Its side.
      successes: Batches that improved in a row.
      failures: Batches that did not, in a row.
      best: Least cost since it started.
      first: Number of the first design that belongs to it.
    """

    length: float = FIRST
    successes: int = 0
    failures: int = 0
    best: float = math.inf
    first: int = 0

    def after(self, costs: np.ndarray, count: int, patience: int) -> "Region":
        """The region after a batch; count is the number of designs that were simulated before."""
        better = costs.min() < self.best - 1e-3 * abs(self.best) if self.best < math.inf else True
        successes = self.successes + 1 if better else 0
        failures = 0 if better else self.failures + 1
        length = self.length
        if successes == SUCCESSES:
            length = min(2.0 * length, LONGEST)
            successes = 0
        elif failures == patience:
            length = length / 2.0
            failures = 0
        if length < SHORTEST:
            return Region(first=count + len(costs))
        return Region(length, successes, failures, min(self.best, float(costs.min())), self.first)


def propose(
    units: np.ndarray, costs: np.ndarray, length: float, count: int, seed: int, threads: int
) -> np.ndarray:
    """A batch of a seed: Thompson samples in the region around the best design.

    Args:
      units: Designs so far in parts of the bounds, shape (design, parameter).
      costs: Their mean costs, shape (design,).
      length: Side of the region.
      count: Proposals.
      seed: Seed of the candidates and samples.
      threads: Threads of PyTorch.
    """
    import torch
    from botorch.fit import fit_gpytorch_mll
    from botorch.generation import MaxPosteriorSampling
    from botorch.models import SingleTaskGP
    from gpytorch.kernels import MaternKernel, ScaleKernel
    from gpytorch.mlls import ExactMarginalLogLikelihood
    from torch.quasirandom import SobolEngine

    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    places = torch.tensor(units, dtype=torch.double)
    gains = -torch.tensor(costs, dtype=torch.double)[:, None]
    values = (gains - gains.mean()) / gains.std().clamp_min(1e-6)
    parameters = places.shape[1]
    kernel = ScaleKernel(MaternKernel(nu=2.5, ard_num_dims=parameters))
    model = SingleTaskGP(places, values, covar_module=kernel, outcome_transform=None)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    with torch.no_grad():
        centre = places[model.posterior(places).mean.argmax()]  # noisy costs: the mean decides
        scales = kernel.base_kernel.lengthscale.detach().squeeze(0)
        weights = scales / scales.log().mean().exp()
        low = (centre - weights * length / 2).clamp(0.0, 1.0)
        high = (centre + weights * length / 2).clamp(0.0, 1.0)
        points = SobolEngine(parameters, scramble=True, seed=seed).draw(CANDIDATES).double()
        points = low + (high - low) * points
        share = min(20.0 / parameters, 1.0)
        changed = torch.rand(CANDIDATES, parameters) <= share
        rows = (~changed.any(1)).nonzero()[:, 0]
        changed[rows, torch.randint(0, parameters, (len(rows),))] = True
        candidates = torch.where(changed, points, centre)
        chosen = MaxPosteriorSampling(model, replacement=False)(candidates, num_samples=count)
    return chosen.numpy()


class Searches:
    """All seeds side by side: the simulations of a round are one batch."""

    def __init__(self, study: Study, pool: ProcessPoolExecutor, threads: int):
        self.study = study
        self.pool = pool
        self.threads = threads
        space = study.space
        self.low = np.asarray(space.low)
        self.span = np.asarray(space.high) - self.low
        self.project = jax.jit(jax.vmap(jax.vmap(space.project)))
        self.seeds = len(study.keys)
        self.units: list[np.ndarray] = []
        self.costs: list[np.ndarray] = []
        self.regions = [Region()] * self.seeds

    def round(self) -> None:
        """Proposes and simulates a batch of every seed."""
        number = len(self.units)
        particles = self.study.case.particles
        proposals = np.stack(self._proposals(number, particles))
        designs = self.project(jnp.asarray(self.low + self.span * proposals, jnp.float32))
        noise = self.study.noise(codesign.STREAM_TRIAL, number)
        outcome = self.study.outcomes(designs, noise, self.study.case.trials)
        costs = np.asarray(self.study.costs(outcome))
        self.units.append((np.asarray(designs, float) - self.low) / self.span)
        self.costs.append(costs)
        patience = max(4, math.ceil(len(self.low) / particles))
        done = number * particles
        self.regions = [
            region.after(batch, done, patience)
            for region, batch in zip(self.regions, costs, strict=True)
        ]

    def _proposals(self, number: int, particles: int) -> list[np.ndarray]:
        """Random designs until a region holds two batches, samples afterwards."""
        jobs: list[Any] = []
        for seed, region in enumerate(self.regions):
            first = region.first // particles
            if number - first < 2:
                rng = np.random.default_rng([seed, number])
                jobs.append(rng.random((particles, len(self.low))))
                continue
            units = np.concatenate([batch[seed] for batch in self.units[first:]])
            costs = np.concatenate([batch[seed] for batch in self.costs[first:]])
            mixed = 1000 * seed + number
            batch = region.length, particles, mixed, self.threads
            jobs.append(self.pool.submit(propose, units, costs, *batch))
        return [job if isinstance(job, np.ndarray) else job.result() for job in jobs]

    def recommend(self) -> np.ndarray:
        """What each seed recommends: of its designs that cost least, the best in fresh trials."""
        case = self.study.case
        units = np.concatenate(self.units, axis=1)
        costs = np.concatenate(self.costs, axis=1)
        order = np.argsort(costs, axis=1)[:, : case.finalists, None]
        finalists = self.low + self.span * np.take_along_axis(units, order, axis=1)
        noise = self.study.noise(codesign.STREAM_TEST, len(self.units))
        outcome = self.study.outcomes(jnp.asarray(finalists, jnp.float32), noise, self.study.rounds)
        best = np.asarray(self.study.costs(outcome)).argmin(1)
        return finalists[np.arange(self.seeds), best]


def seconds_of_default(make: Callable[..., Study]) -> float:
    """Time of the default search's episodes and test, once its programs are compiled [s]."""
    for seed in (0, 1):
        study = make(optimize.DEFAULT, first=seed, seeds=1, at=[DEFAULT_GRASPS], coarse=True)
        start = time.monotonic()
        while not study.finished:
            study.step()
    return time.monotonic() - start


def in_equal_time(
    make: Callable[..., Study], name: str, seeds: int, pool: ProcessPoolExecutor, threads: int
) -> tuple[list[Searches], float]:
    """Searches of a seed each, for the default search's time, and that time [s].

    A search of seed 0 goes before them, and is not returned: in it the programs are compiled and
    the workers begin.
    """
    seconds = seconds_of_default(make)
    searches = []
    for seed in (0, *range(seeds)):
        search = Searches(make(name, first=seed, seeds=1), pool, threads)
        start = time.monotonic()
        while time.monotonic() - start < seconds:
            search.round()
        print(f"seed {seed}: {len(search.units)} batches in {seconds:.1f} s", flush=True)
        searches.append(search)
    return searches[1:], seconds


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/search"), help="folder")
    parser.add_argument("--preset", default="23d")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--budget", type=int, default=2400, help="grasps of a seed, all counted")
    parser.add_argument("--equal-time", action="store_true", help="the default search's time")
    parser.add_argument("--particles", type=int, default=24, help="designs of a batch")
    parser.add_argument("--tests", type=int, default=400, help="trials of a recommended design")
    parser.add_argument("--workers", type=int, default=10, help="processes that propose")
    args = parser.parse_args()
    use_compilation_cache()
    start = time.monotonic()
    scene = scenes.load("paper")
    space = design_space(scene.hand, args.preset)
    engine = make_engine("structured", scene)
    name = f"random:particles={args.particles},trials=3"
    path = args.out / f"{args.preset}-turbo{'-equal-time' if args.equal_time else ''}.npz"

    def make(kind: str, *, coarse: bool = False, **sizes: Any) -> Study:
        sizes = {"budget": args.budget, "tests": args.tests} | sizes
        searched = scenes.with_accuracy(scene, "fast") if coarse else None
        case = make_case(kind, space, args.preset)
        return Study(case, scene, engine, space, **sizes, path=path, searched=searched)

    pool = ProcessPoolExecutor(args.workers, mp_context=get_context("spawn"))
    threads = max(1, len(os.sched_getaffinity(0)) // args.workers)
    row: dict[str, Any] = {
        "preset": args.preset,
        "scene": "paper",
        "objects": None,
        "changes": [],
        "tests": args.tests,
        "optimizer": f"turbo:particles={args.particles},trials=3",
        "particles": args.particles,
        "trials": 3,
    }
    if args.equal_time:
        searches, row["seconds_of_a_seed"] = in_equal_time(make, name, args.seeds, pool, threads)
        row["changes"] = [EQUAL_TIME]
    else:
        search = Searches(make(name, seeds=args.seeds), pool, threads)
        rounds = (args.budget - search.study.tested) // search.study.case.worlds
        for number in range(rounds):
            search.round()
            least = [round(region.length, 3) for region in search.regions]
            print(f"batch {number + 1}/{rounds}, sides {least}", flush=True)
        searches = [search]
    kept = np.concatenate([s.study.judge(s.recommend(), scene) for s in searches])
    grasps = [len(s.units) * s.study.case.worlds + s.study.tested for s in searches]
    row["grasps"] = [int(np.median(grasps))]
    row["kept"] = [np.round(kept, 4).tolist()]
    row["seconds"] = round(time.monotonic() - start)
    row["provenance"] = provenance.results(args.commit)
    output.write_json(path.with_suffix(".json"), row)
    print(f"{np.mean(kept):.3f} kept, {np.mean(kept >= WANTED):.2f} of the seeds keep 95 %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
