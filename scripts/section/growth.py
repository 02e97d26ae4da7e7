"""The law of how sections grow under pressure: its fit to elements, and verdicts that it changes.

python -m scripts.section.growth                     # the constants by elements, and their errors
python -m scripts.section.growth runs/a runs/b       # runs of `codesign optimize --scene build`

The law is `scene.section_growth`; docs/data/section.npz has heights and widths by elements.
Verdicts are those of the scene `build` with and without `effects.section_growth`.  A time step of 2
ms, in the same trials, says what the integration changes.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import optimize

from codesign_jax import parameters, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.judge import verdict
from codesign_jax.runs import selection
from codesign_jax.scene import Scene, section_growth
from codesign_jax.scene.parameters import DesignSpace
from scripts.section import fit, study
from scripts.shared import output, provenance, statistics

SECTIONS = Path("docs/data/section.npz")
FINALISTS = 3
LATE = 20
"""Last episodes of a run, of which proposals are drawn."""
HARD = (0.3, 0.95)
"""Share of kept grasps of a design that is hard."""

PACKAGE = np.array(
    [
        section_growth.HIGHEST,
        section_growth.HEIGHT_RATE,
        section_growth.WIDEST,
        section_growth.WIDTH_RATE,
    ]
)
"""The constants of the law as the package has them."""


class States(NamedTuple):
    """Sections under pressure, bent towards the fabric by any amount; one state a row."""

    section: np.ndarray  # height, wall, width [m], shear modulus [Pa] and depth of the thread
    pressure: np.ndarray  # [Pa]
    grown: np.ndarray  # height and width over those without pressure, shape (state, 2)
    held_out: np.ndarray  # whether the section takes no part in the fit
    usual: np.ndarray  # whether pressure and proportions are those for which the law is made


def states() -> States:
    """The states of elements: outlines as wide and high as with straight sides."""
    rows = []
    for name, (section, column) in study.read(SECTIONS).items():
        untwisted = (column["lateral"] == 0) & (np.abs(column["twist"]) < 1e-9)
        size = section.height, section.wall, section.width
        kind = (*size, section.shear_modulus, section.thread_depth)
        inside = all(
            low <= value / section.height <= high
            for value, (low, high) in zip(size[1:], fit.PROPORTIONS, strict=True)
        )
        for k in np.flatnonzero(untwisted & (column["pressure"] > 0)):
            pressure = column["pressure"][k]
            usual = inside and pressure / section.shear_modulus <= fit.USUAL_PRESSURE
            # The side of the fabric is at zero: what bulges below it is not in the height.
            grown = column["high"][k] / section.height, column["width"][k] / section.width
            rows.append((kind, pressure, grown, study.held_out(name), usual))
    return States(*(np.array(v) for v in zip(*rows, strict=True)))


def errors(data: States, constants: np.ndarray | None = None) -> np.ndarray:
    """Height and width by the law less those of elements, over the size without pressure.

    Args:
      constants: As `PACKAGE`; None for these.
    """
    height, wall, width, modulus, depth = data.section.T
    law = section_growth.growth(height, wall, width, shear_modulus=modulus, thread_depth=depth)
    if constants is not None:
        highest, height_rate, widest, width_rate = constants / PACKAGE
        law = section_growth.Growth(
            highest * law.height,
            widest * law.width,
            height_rate * law.height_rate,
            width_rate * law.width_rate,
        )
    return np.stack(section_growth.factors(law, data.pressure), 1) - data.grown


def fitted(data: States) -> np.ndarray:
    """The four constants by least squares over the sections that are not held out."""
    use = ~data.held_out
    weight = np.where(data.usual, 1.0, fit.OUTSIDE)[use, None]
    chosen = States(*(v[use] for v in data))
    solution = optimize.least_squares(lambda v: (weight * errors(chosen, v)).ravel(), PACKAGE)
    return solution.x


def residuals(data: States) -> dict[str, Any]:
    """Root mean squares of the errors of height and width, and of the growth itself, in %."""

    def percent(values: np.ndarray) -> list[float]:
        return [round(100 * float(v), 1) for v in np.sqrt((values**2).mean(0))]

    wrong = errors(data)
    groups = {
        "fitted": ~data.held_out & data.usual,
        "held out": data.held_out & data.usual,
        "held out, all": data.held_out,
    }
    rows = {name: percent(wrong[which]) for name, which in groups.items()}
    return rows | {"growth, held out": percent(data.grown[groups["held out"]] - 1)}


def kept(
    the_scene: Scene, space: DesignSpace, designs: np.ndarray, trials: int, batch: int
) -> np.ndarray:
    """Which grasps are kept, shape (design, trial); `batch`: designs of a call."""
    engine = make_engine("structured", the_scene)
    drawn = rollout.sample_trials(the_scene, jax.random.key(77), trials)
    run = jax.jit(lambda params: rollout.evaluate(the_scene, engine, params, drawn))
    rows = []
    for first in range(0, len(designs), batch):
        some = designs[first : first + batch]
        filled = np.concatenate([some, np.repeat(some[-1:], batch - len(some), 0)])
        outcomes = run(parameters.params_of(space, filled))
        rows.append(np.asarray(verdict.kept(outcomes))[: len(some)])
    return np.concatenate(rows)


def designs_of(folders: list[Path], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Finalists and drawn late proposals of runs, shape (design, parameter) each."""
    rng = np.random.default_rng(0)
    finalists = []
    late = []
    for folder in folders:
        record = selection.read_record(folder)
        finalists.append(np.asarray(record.state.particles)[:FINALISTS])
        proposals = np.concatenate(record.history.population[record.done - LATE : record.done])
        late.append(proposals[rng.permutation(len(proposals))[:count]])
    return np.concatenate(finalists), np.concatenate(late)


def flips(before: np.ndarray, after: np.ndarray) -> dict[str, Any]:
    """Share of trials that change, and by how much more is kept, in % with 95 % intervals."""

    def both(a: np.ndarray, b: np.ndarray) -> list[float]:
        return [100 * float((a != b).mean()), 100 * float(b.mean() - a.mean())]

    changed, more = statistics.two_way(both, before, after, resamples=2000)
    return {"designs": len(before), "flips": [*changed], "kept_more": [*more]}


def changes(finalists: np.ndarray, late: np.ndarray, trials: int, batch: int) -> tuple[dict, dict]:
    """Flips by change and group of designs, and the grasps that are kept."""
    steady = {"effects.section_growth": False}
    scenes = {
        "steady": scene.load("build", overrides=steady),
        "grown": scene.load("build"),
        "2 ms": scene.load("build", overrides=steady | {"discretization.timestep": 0.002}),
    }
    space = parameters.design_space(scenes["grown"].hand, "23d")
    designs = np.concatenate([finalists, late])
    grasps = {name: kept(s, space, designs, trials, batch) for name, s in scenes.items()}
    plain = grasps["steady"]
    share = plain.mean(1)
    recommended = np.arange(len(designs)) < len(finalists)
    hard = ~recommended & (share > HARD[0]) & (share < HARD[1])
    groups = {"recommended": recommended, "late": ~recommended, "hard": hard}
    rows = {
        f"{name}, {group}": flips(plain[which], grasps[name][which])
        for name in ("grown", "2 ms")
        for group, which in groups.items()
        if which.any()
    }
    return rows, {"designs": designs} | grasps


def main() -> None:
    parser = provenance.parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("runs", type=Path, nargs="*", help="run folders of the scene `build`")
    parser.add_argument("--late", type=int, default=26, help="late proposals of each run")
    parser.add_argument("--trials", type=int, default=8)
    parser.add_argument("--batch", type=int, default=64, help="designs of a call")
    parser.add_argument("--out", type=Path, default=Path("docs/data/growth.json"))
    args = parser.parse_args()
    data = states()
    print("constants by elements", fitted(data).round(4))
    wrong = residuals(data)
    for name, row in wrong.items():
        print(f"{name}: height {row[0]} %, width {row[1]} %")
    if not args.runs:
        return
    rows, arrays = changes(*designs_of(args.runs, args.late), args.trials, args.batch)
    notes = provenance.results(args.commit)
    notes |= {"scene_sha256": provenance.scene_hash(scene.load("build"))}
    content = {"errors_of_growth": wrong, "trials": args.trials, "changes": rows}
    output.write_json(args.out, notes | content)
    output.write_arrays(args.out.with_suffix(".npz"), arrays)
    for name, row in rows.items():
        print(name, row)


if __name__ == "__main__":
    main()
