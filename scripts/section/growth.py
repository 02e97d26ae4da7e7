"""How many verdicts change where sections are as large as pressure makes them.

python -m scripts.section.growth runs/a runs/b       # runs of `codesign optimize --scene build`

By elements with the thread outside, height and width grow in free bend (docs/data/section.npz).
The contact surface is made as large throughout the grasp, and all else stays.  The side of the
fabric does not move.  A time step of 2 ms, in the same trials, says what the integration changes.
"""

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import parameters, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.judge import verdict
from codesign_jax.runs import selection
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Params
from scripts.section import study
from scripts.shared import output, provenance, statistics

SECTIONS = Path("docs/data/section.npz")
FINALISTS = 3
LATE = 20
"""Last episodes of a run, of which proposals are drawn."""
HARD = (0.3, 0.95)
"""Share of kept grasps of a design that is hard."""
LEAST = 5e3
"""Pressure up to which growth is in proportion [Pa]; elements were computed from 10 kPa on."""
MOST = (0.6, 0.5)
"""Largest growth of height and width: that of the computed sections [chosen]."""


def terms(pressure: Any, wall: Any, width: Any) -> Any:
    """Terms of the growth: 1, pressure over the modulus, wall and width over the height."""
    a = jnp.log(pressure)
    b = jnp.log(wall / 0.2)
    c = jnp.log(width / 1.2)
    return jnp.stack([a * 0 + 1, a, b, c, a * b, b * b, c * c, b * c], -1)


def fitted() -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of growth in height and width, shape (term, 2), and their errors, shape (2,)."""
    proportions = []
    growth = []
    for section, states in study.read(SECTIONS).values():
        if section.thread_depth or section.fabric_stiffness != 1e5:
            continue
        free = (states["pressure"] >= 1e4) & (np.abs(states["moment_bend"]) < 1e-6)
        free &= states["lateral"] == 0
        for k in np.flatnonzero(free):
            pressure = states["pressure"][k] / section.shear_modulus
            sizes = section.wall / section.height, section.width / section.height
            proportions.append((pressure, *sizes))
            high = (states["high"][k] - states["low"][k]) / section.height
            growth.append((high - 1, states["width"][k] / section.width - 1))
    matrix = np.asarray(terms(*np.transpose(proportions)))
    coefficients = np.linalg.lstsq(matrix, np.array(growth), rcond=None)[0]
    return coefficients, (matrix @ coefficients - growth).std(0)


def grown(section: Any, params: Params, modulus: float, coefficients: np.ndarray) -> Any:
    """Height, wall, segment and width of fingers at their pressures, shape (world, finger, 4)."""
    height, wall, segment, width = jnp.moveaxis(section, -1, 0)
    pressure = jnp.maximum(params.pressure, LEAST) / modulus
    share = jnp.minimum(params.pressure / LEAST, 1.0)
    matrix = terms(pressure, wall / height, width / height)
    growth = matrix @ jnp.asarray(coefficients, height.dtype)
    growth = share[..., None] * jnp.clip(growth, 0.0, jnp.array(MOST))
    by_height, by_width = jnp.moveaxis(growth, -1, 0)
    return jnp.stack([height * (1 + by_height), wall, segment, width * (1 + by_width)], -1)


def kept(
    the_scene: Scene,
    space: DesignSpace,
    designs: np.ndarray,
    trials: int,
    coefficients: np.ndarray | None,
) -> np.ndarray:
    """Which grasps are kept, shape (design, trial); sections grow if there are coefficients."""
    engine = make_engine("structured", the_scene)
    drawn = rollout.sample_trials(the_scene, jax.random.key(77), trials)

    @jax.jit
    def simulated(params: Params) -> Any:
        hands = jax.tree.map(lambda v: jnp.repeat(v, trials, 0), params)
        index = jnp.tile(jnp.arange(trials), len(params.length))
        worlds = jax.tree.map(lambda v: jnp.asarray(v)[index], drawn)
        fields, ctrl = rollout.prepare(the_scene, hands, worlds, engine)
        if coefficients is not None:
            modulus = the_scene.hand.material.shear_modulus
            larger = grown(fields.section, hands, modulus, coefficients)
            fields = fields._replace(section=larger)
        trace = engine.rollout(fields, ctrl)
        clear = jnp.zeros(len(worlds.shape), jnp.int32)
        return rollout.judge(the_scene, trace, None, clear, worlds, rollout.Options())

    outcomes = simulated(parameters.params_of(space, designs))
    return np.asarray(verdict.kept(outcomes)).reshape(len(designs), trials)


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


def main() -> None:
    parser = provenance.parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("runs", type=Path, nargs="+", help="run folders of the scene `build`")
    parser.add_argument("--late", type=int, default=26, help="late proposals of each run")
    parser.add_argument("--trials", type=int, default=8)
    parser.add_argument("--out", type=Path, default=Path("docs/data/growth.json"))
    args = parser.parse_args()
    coefficients, errors = fitted()
    the_scene = scene.load("build")
    space = parameters.design_space(the_scene.hand, "23d")
    finalists, late = designs_of(args.runs, args.late)
    designs = np.concatenate([finalists, late])
    plain = kept(the_scene, space, designs, args.trials, None)
    fine = scene.load("build", overrides={"discretization.timestep": 0.002})
    others = {
        "grown": kept(the_scene, space, designs, args.trials, coefficients),
        "2 ms": kept(fine, space, designs, args.trials, None),
    }
    share = plain.mean(1)
    recommended = np.arange(len(designs)) < len(finalists)
    hard = ~recommended & (share > HARD[0]) & (share < HARD[1])
    groups = {"recommended": recommended, "late": ~recommended, "hard": hard}
    rows = {
        f"{name}, {group}": flips(plain[which], after[which])
        for name, after in others.items()
        for group, which in groups.items()
    }
    notes = provenance.results(args.commit) | {"scene_sha256": provenance.scene_hash(the_scene)}
    content = {"errors_of_growth": errors.tolist(), "trials": args.trials, "changes": rows}
    output.write_json(args.out, notes | content)
    arrays = {"designs": designs, "as it is": plain} | others
    output.write_arrays(args.out.with_suffix(".npz"), arrays)
    for name, row in rows.items():
        print(name, row)


if __name__ == "__main__":
    main()
