"""Ways to grasp: the best design for each posture, by quality-diversity search (pyribs).

CMA-MAE (Fontaine and Nikolaidis 2023, arXiv:2205.10752) fills a grid over two numbers that say how
a design grasps, not what it looks like: the distance between the object's centre and the hand's,
and the bending of the fingers, both at the end of the lift, means over the objects that it keeps.
The search asks for low costs in every cell and knows nothing of the paper's two regions.  What it
finds then meets fresh trials, and a cell shows the design that keeps most of these.

`pip install '.[ways]'`.  The same command goes on where it stopped, its strategies from anew.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, model, rollout, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.cost import particle_cost
from codesign_jax.engines import make_engine
from codesign_jax.optimize.bounds import reflect
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.scene.parameters import design_space as make_space
from codesign_jax.types import Trial, failed
from scripts.search.study import STREAM_JUDGE, UNFINISHED
from scripts.shared import figures, provenance
from scripts.shared.output import write_arrays, write_json

RANGES = ((0.0, 0.08), (0.0, 4.5))
"""Of the distance [m] and of the bending [rad]."""
CELLS = (16, 16)
WORST = -4.0
"""Objective below which nothing enters the grid: minus the cost of losing everything at once."""


class Grasped(NamedTuple):
    """What became of designs, leading axis (design,).

    Attributes:
      cost: Mean cost over the trials.
      kept: Share of the trials that kept the object.
      ways: Mean distance [m] and bending [rad] over these, shape (design, 2); not a number if none.
    """

    cost: np.ndarray
    kept: np.ndarray
    ways: np.ndarray


class Simulator:
    """Grasps of designs, by one program."""

    def __init__(self, scene: Scene, space: DesignSpace, chunk: int):
        """Takes scene, design space, and grasps of a call; compiles nothing yet."""
        self.scene, self.space, self.chunk = scene, space, chunk
        engine, layout = make_engine("structured", scene), model.layout(scene)
        bends = 6 + np.arange(layout.dofs.size).reshape(layout.dofs.shape)[..., 0]
        step = round(scene.phases.lift / scene.discretization.timestep)

        def simulate(designs: jax.Array, trials: Trial) -> tuple[Any, ...]:
            hands = jax.vmap(space.params)(designs)
            outcome, trace = rollout.simulate(scene, engine, hands, trials, record_qpos=True)
            bend = trace.qpos[:, step][:, bends].sum(-1).mean(-1)
            return outcome, trace.distance[:, step], bend

        self.program = jax.jit(simulate)

    def __call__(self, designs: np.ndarray, key: jax.Array, turns: int) -> Grasped:
        """Simulates designs in common trials, so many with each object."""
        shape = len(designs), turns * len(self.scene.objects.object)
        drawn = rollout.sample_trials(self.scene, key, shape[1])
        trials, parts = jax.tree.map(np.asarray, drawn), []
        for start in range(0, shape[0] * shape[1], self.chunk):
            world = np.minimum(np.arange(start, start + self.chunk), shape[0] * shape[1] - 1)
            d, t = np.unravel_index(world, shape)
            own = jax.tree.map(lambda v, t=t: v[t], trials)
            parts.append(jax.tree.map(np.asarray, self.program(designs[d], own)))
        found = jax.tree.map(
            lambda *v: np.concatenate(v)[: shape[0] * shape[1]].reshape(shape), *parts
        )
        outcome, *ways = found
        kept = ~failed(outcome.status) & (outcome.cost < SUCCESS_COST)
        with np.errstate(invalid="ignore"):
            means = [(w * kept).sum(1) / kept.sum(1) for w in ways]
        cost = np.asarray(particle_cost(self.scene, outcome))
        return Grasped(cost, kept.mean(1), np.stack(means, -1))


class Search:
    """A grid of designs, and the strategies that fill it."""

    def __init__(self, simulate: Simulator, seed: int, emitters: int, batch: int, path: Path):
        """Goes on with what a file holds, or begins with random designs."""
        from ribs.archives import GridArchive  # pyright: ignore[reportMissingImports]
        from ribs.emitters import EvolutionStrategyEmitter  # pyright: ignore[reportMissingImports]
        from ribs.schedulers import Scheduler  # pyright: ignore[reportMissingImports]

        self.simulate, self.space, self.path = simulate, simulate.space, path
        self.key, width = jax.random.key(seed), simulate.space.num_parameters
        how = {"solution_dim": width, "dims": CELLS, "ranges": RANGES, "seed": seed}
        aims = GridArchive(**how, learning_rate=0.1, threshold_min=WORST)
        self.best = GridArchive(**how)
        self.done, self.grasps, self.filled = 0, 0, []
        if path.exists():
            with np.load(path) as stored:
                self.done, self.grasps = int(stored["done"]), int(stored["grasps"])
                self.filled = stored["filled"].tolist()
                kept = stored["solution"], stored["objective"], stored["measures"]
        else:
            drawn = np.asarray(self.space.sample(self.key, emitters * batch))
            low, high = self.space.low, self.space.high
            kept = (drawn - low) / (high - low), *self._judged(drawn)
        for archive in (aims, self.best):
            archive.add(*kept)
        order = np.argsort(-kept[1])[:: max(1, len(kept[1]) // (4 * emitters))][:emitters]
        self.scheduler = Scheduler(
            aims,
            [
                EvolutionStrategyEmitter(
                    aims,
                    x0=kept[0][i],
                    sigma0=0.15,
                    ranker="imp",
                    selection_rule="mu",
                    restart_rule="basic",
                    batch_size=batch,
                    seed=[seed, self.done, number],
                )
                for number, i in enumerate(order)
            ],
            result_archive=self.best,
        )

    def step(self) -> None:
        """One generation of every strategy."""
        low, high = self.space.low, self.space.high
        asked = low + self.scheduler.ask() * (high - low)
        designs = jax.vmap(self.space.project)(reflect(asked, low, high).astype(np.float32))
        self.scheduler.tell(*self._judged(np.asarray(designs)))

    def _judged(self, designs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Objectives and measures of designs; those that keep nothing enter no cell."""
        noise = codesign.stream_key(self.key, codesign.STREAM_TRIAL, self.done)
        found = self.simulate(designs, noise, 1)
        self.done, self.grasps = self.done + 1, self.grasps + len(designs) * self._objects
        none = np.asarray(np.isnan(found.ways).any(1))
        objective = np.where(none, 10 * WORST, -found.cost)
        return objective, np.where(none[:, None], 0.0, found.ways)

    @property
    def _objects(self) -> int:
        return len(self.simulate.scene.objects.object)

    def save(self) -> None:
        """Writes the grid."""
        self.filled.append([self.grasps, len(self.best)])
        kept = self.best.data(["solution", "objective", "measures"], return_type="dict")
        counts = {"done": self.done, "grasps": self.grasps, "filled": np.array(self.filled)}
        write_arrays(self.path, kept | {n: np.asarray(v) for n, v in counts.items()})

    def elites(self, turns: int) -> dict[str, np.ndarray]:
        """Designs of the grid in fresh trials: of each cell the one that keeps most there.

        Args:
          turns: Trials with each object.
        """
        low, high = self.space.low, self.space.high
        unit = self.best.data("solution")
        asked = reflect(low + unit * (high - low), low, high).astype(np.float32)
        designs = np.asarray(jax.vmap(self.space.project)(asked))
        found = self.simulate(designs, codesign.stream_key(self.key, STREAM_JUDGE), turns)
        fresh = type(self.best)(solution_dim=designs.shape[1], dims=CELLS, ranges=RANGES)
        good = found.kept > 0
        fresh.add(designs[good], found.kept[good], found.ways[good])
        kept = fresh.data(["solution", "objective", "measures", "index"], return_type="dict")
        names = {"solution": "design", "objective": "kept", "measures": "ways", "index": "cell"}
        return {name: kept[old] for old, name in names.items()}


def apart(ways: np.ndarray, kept: np.ndarray, count: int) -> list[int]:
    """Rows that lie far from one another: the best one, then always the farthest from the others.

    Args:
      ways: Shape (design, 2).
      kept: Share kept; only designs that keep at least nine tenths of the best are taken.
      count: Number of rows.
    """
    size = np.diff(RANGES, axis=1)[:, 0]
    good = np.flatnonzero(kept >= 0.9 * kept.max())
    chosen = [int(good[kept[good].argmax()])]
    while len(chosen) < min(count, len(good)):
        away = np.linalg.norm((ways[good][:, None] - ways[chosen]) / size, axis=-1).min(1)
        chosen.append(int(good[away.argmax()]))
    return chosen


def draw(
    simulate: Simulator, found: dict[str, np.ndarray], pictures: int, path: Path
) -> list[dict[str, Any]]:
    """The grid by what it keeps and by the length of the fingers, with pictures; what these show.

    Args:
      simulate: What simulated.
      found: See `Search.elites`.
      pictures: Number of elites to show.
      path: The figure.
    """
    from codesign_jax.report import animation

    scene, space, shown = simulate.scene, simulate.space, []
    hands = jax.vmap(space.params)(jnp.asarray(found["design"]))
    length, palm = np.asarray(hands.length).mean(1), np.asarray(hands.arm)[:, 2]
    rows = apart(found["ways"], found["kept"], pictures)
    rows.sort(key=lambda row: found["ways"][row, 1])
    figure = figures.new(11.0, 7.0)
    halves: Any = figure.subfigures(2, 1, height_ratios=[1.35, 1])
    above, below = halves
    maps = above.subplots(1, 2)
    parts = ((found["kept"], "share of fresh grasps kept"), (1e3 * length, "finger length [mm]"))
    for place, (values, name) in enumerate(parts):
        axes = maps[place]
        image = np.full(np.prod(CELLS), np.nan)
        image[found["cell"]] = values
        extent = [1e3 * v for v in RANGES[0]] + [float(np.degrees(v)) for v in RANGES[1]]
        drawn = axes.imshow(image.reshape(CELLS).T, origin="lower", extent=extent, aspect="auto")
        above.colorbar(drawn, ax=axes, label=name)
        axes.set(xlabel="object to hand's centre [mm]", ylabel="bending of the fingers [deg]")
        for number, row in enumerate(rows):
            x, y = 1e3 * found["ways"][row, 0], np.degrees(found["ways"][row, 1])
            style = {"weight": "bold", "ha": "center", "va": "center", "color": "k"}
            axes.annotate("ABCDEFGH"[number], (x, y), **style, bbox={"fc": "w", "pad": 1, "lw": 0})
    places, time_s = below.subplots(1, len(rows), squeeze=False)[0], np.array([scene.phases.lift])
    for number, row in enumerate(rows):
        params = space.params(jnp.asarray(found["design"][row]))
        trials = jax.tree.map(lambda v: jnp.asarray(v)[None], rollout.nominal_trial(scene, 0))
        [grasp] = animation.replay(scene, make_engine("structured", scene), params, trials)
        axes = places[number]
        picture = animation.frames(scene, grasp, time_s, size=(480, 480))[0]
        axes.imshow(picture[60:400, 80:400])
        axes.set_axis_off()
        kept, mm, arm = found["kept"][row], 1e3 * length[row], 1e3 * palm[row]
        axes.set_title(
            f"{'ABCDEFGH'[number]}: keeps {kept:.0%},\nfingers {mm:.0f} mm, palm at {arm:.0f} mm",
            fontsize=8,
        )
        shown.append(
            {
                "letter": "ABCDEFGH"[number],
                "kept": float(kept),
                "finger_length_mm": float(mm),
                "arm_z_mm": float(arm),
                "distance_mm": float(1e3 * found["ways"][row, 0]),
                "bending_deg": float(np.degrees(found["ways"][row, 1])),
                "design": dict(
                    zip(space.names, space.in_units(found["design"][row]).tolist(), strict=True)
                ),
            }
        )
    figures.save(figure, path)
    return shown


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(prog="scripts.search.ways", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="file of the grid, .npz")
    parser.add_argument("--preset", default="23d")
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--emitters", type=int, default=5, help="strategies side by side")
    parser.add_argument("--batch", type=int, default=24, help="designs of each in a generation")
    parser.add_argument("--generations", type=int, default=100)
    parser.add_argument("--turns", type=int, default=8, help="fresh trials with each object")
    parser.add_argument("--pictures", type=int, default=6, help="elites that are shown")
    parser.add_argument("--minutes", type=float, help="time after which no generation begins")
    parser.add_argument("--chunk", type=int, help="grasps of a call")
    parser.add_argument("--figure", type=Path, help="draw it")
    provenance.add_commit(parser)
    args = parser.parse_args(arguments)
    use_compilation_cache()
    begin, scene = time.monotonic(), scenes.load(args.scene)
    space = make_space(scene.hand, args.preset)
    chunk = args.chunk or args.emitters * args.batch * len(scene.objects.object)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    simulate = Simulator(scene, space, chunk)
    search = Search(simulate, args.seed, args.emitters, args.batch, args.out)
    search.save()
    while search.done <= args.generations:
        if args.minutes is not None and time.monotonic() - begin > 60 * args.minutes:
            print(f"after {search.done} generations; the same command goes on", flush=True)
            return UNFINISHED
        search.step()
        search.save()
        print(f"generation {search.done - 1}: {len(search.best)} cells", flush=True)
    elites = args.out.with_name(f"{args.out.stem}-elites.npz")
    if not elites.exists():
        write_arrays(elites, search.elites(args.turns))
    with np.load(elites) as stored:
        found = {name: stored[name] for name in stored}
    row: dict[str, Any] = {"preset": args.preset, "scene": args.scene, "seed": args.seed}
    row |= {"generations": args.generations, "grasps": search.grasps, "cells": len(search.best)}
    row |= {"turns": args.turns, "filled": search.filled, "ranges": RANGES}
    hands = jax.vmap(space.params)(jnp.asarray(found["design"]))
    row["elites"] = {
        "distance_mm": np.round(1e3 * found["ways"][:, 0], 1).tolist(),
        "bending_deg": np.round(np.degrees(found["ways"][:, 1]), 1).tolist(),
        "kept": np.round(found["kept"], 4).tolist(),
        "finger_length_mm": np.round(1e3 * np.asarray(hands.length).mean(1), 1).tolist(),
        "arm_z_mm": np.round(1e3 * np.asarray(hands.arm)[:, 2], 1).tolist(),
    }
    if args.figure is not None:
        row["shown"] = draw(simulate, found, args.pictures, args.figure)
    write_json(args.out.with_suffix(".json"), row | {"provenance": provenance.results(args.commit)})
    print(f"{len(found['kept'])} cells, {np.sum(found['kept'] >= 0.95)} keep 95 %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
