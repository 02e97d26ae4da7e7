"""What the solver's limit of iterations leaves, by preset, in the default scene.

python -m scripts.accuracy.residual --json docs/data/residual_cpu.json     # 6 minutes of two cores
python -m scripts.accuracy.residual --json docs/data/residual_cpu.json --report --page PAGE

Trials tell the share of their steps at the limit and the largest residual of one.  What that is in
newtons is measured as well: every fifth step of some grasps is solved again, until it converges,
and the net contact force on the object is compared.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, control, model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import Scene, load, parameters
from scripts.accuracy import decision, worlds
from scripts.shared import addition, output, provenance, tables

PRESETS = ("standard", "fast", "fine")
DESIGNS, TRIALS, SEED = 24, 3, 11
"""Designs of each population, and trials of a design."""
GRASPS, STRIDE = 12, 5
"""Grasps whose steps are solved again, and steps between those that are."""


def populations(scene: Scene, data: Path) -> dict[str, np.ndarray]:
    """Good designs, with which searches ended, and random ones [SI], shape (design, 23)."""
    space = parameters.design_space(scene.hand)
    low, high = np.array(space.low), np.array(space.high)
    unit = np.random.default_rng(SEED).random((DESIGNS, len(low)))
    random = jax.vmap(space.project)(jnp.asarray(low + (high - low) * unit, jnp.float32))
    good = decision.populations(data, DESIGNS)["late"]
    return {"good": good, "random": np.asarray(random)}


def of_trials(scene: Scene, designs: np.ndarray) -> dict[str, Any]:
    """Share of steps at the limit, and quantiles of the trials' largest residuals."""
    task = codesign.Task(scene, parameters.design_space(scene.hand), TRIALS)
    found = task.evaluate(jnp.asarray(designs, jnp.float32), jax.random.key(SEED))
    residual = np.asarray(found.residual)
    return {
        "steps_at_limit": float(np.asarray(found.capped).mean()),
        "residual": {f"{q:g}": float(np.quantile(residual, q)) for q in (0.5, 0.9, 0.99, 1)},
        "above_threshold": float((residual > scene.newton.residual).mean()),
    }


def of_steps(scene: Scene, designs: np.ndarray) -> dict[str, Any]:
    """Residuals of single steps, and what they lack of the net force on the object [N]."""
    drawn = worlds.trials(scene, GRASPS)
    params = jax.vmap(lambda v: parameters.unflatten(scene.hand, v))(jnp.asarray(designs[:GRASPS]))

    @jax.jit
    def inputs(params, trials):
        fields = jax.vmap(lambda p, t: model.model_fields(scene, p, t))(params, trials)
        return fields, jax.vmap(lambda p, t: control.commands(scene, p, t))(params, trials)

    engine, exact = (
        StructuredEngine(scene),
        StructuredEngine(scene, iterations=100, tolerance=1e-10),
    )

    @jax.jit
    def path(fields, ctrl):
        return engine.advance(world_constants(scene, fields), engine.reset(fields), ctrl)[0]

    @jax.jit
    def again(fields, qpos, qvel, acc, ctrl):
        hand, start = world_constants(scene, fields), exact.reset(fields)
        return exact.advance(hand, exact.place(start, qpos, qvel, acc), ctrl)[0]["acc"][:, 0]

    fields, ctrl = inputs(params, drawn)
    found = {k: np.asarray(v) for k, v in path(fields, ctrl).items()}
    steps = slice(1, None, STRIDE)
    count = found["qpos"][:, steps].shape[1]
    many = jax.tree.map(lambda v: np.repeat(np.asarray(v), count, 0), fields)
    states = (found["qpos"], found["qvel"], found["acc"], np.asarray(ctrl))
    qpos, qvel, acc, u = (v[:, steps].reshape(-1, v.shape[-1]) for v in states)
    solved = np.asarray(again(many, qpos, qvel, acc, u[:, None]))
    mass = np.asarray(many.body_mass)[:, -1]
    # Of the object the last three are linear, see `kinematics.Acc`.
    force = mass * np.linalg.norm((solved - acc)[:, -3:], axis=1)
    residual = np.sqrt(found["residual"][:, steps].ravel())
    at_limit = residual**2 > engine.limits.tolerance
    if not at_limit.any():
        return {"steps": len(force), "at_limit": 0}
    quantiles = {f"{q:g}": float(np.quantile(force[at_limit], q)) for q in (0.5, 0.9, 0.99, 1)}
    return {
        "steps": len(force),
        "at_limit": int(at_limit.sum()),
        "force_N": quantiles,
        "force_N_by_residual": [
            {
                "residual": [low, high],
                "steps": int(mine.sum()),
                "median": float(np.median(force[mine])),
            }
            for low, high in ((1e-3, 0.1), (0.1, 1), (1, 10), (10, 1e3))
            if (mine := at_limit & (residual > low) & (residual <= high)).any()
        ],
    }


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures all presets and writes the file."""
    found: dict[str, Any] = {"designs": DESIGNS, "trials": TRIALS, "presets": {}}
    found |= provenance.results(args.commit)
    for name in PRESETS:
        scene = load("paper", accuracy=name)
        designs = populations(scene, args.data)
        trials = {which: of_trials(scene, each) for which, each in designs.items()}
        steps = of_steps(scene, designs["good"])
        found["presets"][name] = {"threshold": scene.newton.residual, **trials, "steps": steps}
        output.write_json(args.json, found)
        print(name, found["presets"][name], flush=True)
    return found


def table(found: dict[str, Any]) -> str:
    """A row for each preset."""
    rows = [
        [
            "preset",
            "steps at the limit, good and random designs",
            "largest residual of a trial: median",
            "99 %",
            "`newton.residual`",
            "trials above it",
            "of a step at the limit, error of the force on the object: median",
            "99 %",
        ]
    ]
    for name, each in found["presets"].items():
        both = [each[which] for which in ("good", "random")]
        shares = ", ".join(f"{v['steps_at_limit']:.1%}" for v in both)
        middle, high = (", ".join(f"{v['residual'][q]:.2g}" for v in both) for q in ("0.5", "0.99"))
        above = ", ".join(f"{v['above_threshold']:.1%}" for v in both)
        lacks = each["steps"].get("force_N")
        forces = [f"{lacks[q]:.2g} N" for q in ("0.5", "0.99")] if lacks else ["–"] * 2
        rows.append([f"`{name}`", shares, middle, high, f"{each['threshold']:g}", above, *forces])
    return tables.markdown(rows)


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = addition.parser(__doc__, "residual")
    parser.add_argument("--data", type=Path, default=Path("docs/data/experiments"))
    return addition.main(parser.parse_args(), run, table, "residual")


if __name__ == "__main__":
    sys.exit(main())
