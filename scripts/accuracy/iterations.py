"""Newton iterations of a step of the structured engine in contact, by the contact's constants.

python -m scripts.accuracy.iterations --json docs/data/iterations_cpu.json
python -m scripts.accuracy.iterations --json docs/data/iterations_cpu.json --report --page PAGE

A block of the kernel iterates until its last world has converged.  Each world fills a block alone
here, as copies of itself, so that the iterations are its own.
"""

import argparse
import sys
from typing import Any

import jax
import numpy as np

from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import Program
from codesign_jax.engines.structured.world_model import world_constants
from scripts.accuracy import timing, worlds
from scripts.accuracy.settings import CONTACT, FINGERS, STANDARD, Setting, sweep
from scripts.shared import addition, output, provenance, tables

DISTINCT, STEPS = 24, 50
"""Worlds, and steps from the time on at which the fingers are inflated and touch the object."""


def settings() -> list[Setting]:
    """The standard setting, other constants of the contact, and other springs and time steps."""
    found = [STANDARD, *sweep(STANDARD, extra=tuple((c,) for c in (*CONTACT, FINGERS)))]
    return [*found, *sweep(STANDARD, damping=("least",), timestep=(5.0, 2.0))]


def measure(setting: Setting) -> dict[str, float]:
    """Iterations a step of a setting: mean, 99 % quantile, and share of steps above tolerance."""
    with worlds.floats(setting.wide) as dtype:
        scene, fields, ctrl = timing.contact(setting, DISTINCT, STEPS, dtype, distinct=DISTINCT)
        engine = setting.make(scene)
        assert isinstance(engine, StructuredEngine)
        copies = Program.here(scene, engine.limits, np.dtype(dtype)).block
        fields, ctrl = jax.tree.map(lambda x: np.repeat(x, copies, 0), (fields, ctrl))

        @jax.jit
        def run(fields, ctrl):
            hand, start = world_constants(scene, fields), engine.reset(fields)
            found, _ = engine.advance(hand, start, ctrl)
            return found["iterations"], found["residual"]

        iterations, residual = (np.asarray(v)[::copies] for v in run(fields, ctrl))
    return {
        "mean": round(float(iterations.mean()), 3),
        "p99": float(np.quantile(iterations, 0.99)),
        "above_tolerance": round(float((residual > engine.limits.tolerance).mean()), 5),
    }


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures all settings and writes the file."""
    found = {"worlds": DISTINCT, "steps": STEPS, **provenance.results(args.commit)}
    found["settings"] = {s.label: measure(s) for s in settings()}
    output.write_json(args.json, found)
    return found


def table(found: dict[str, Any]) -> str:
    """Iterations of all settings."""
    rows = [["setting", "Newton iterations a step: mean", "99 %", "steps above the tolerance"]]
    for label, each in found["settings"].items():
        share = f"{each['above_tolerance']:.2%}"
        rows.append([label, f"{each['mean']:.2f}", f"{each['p99']:.0f}", share])
    return tables.markdown(rows)


def main() -> int:
    """Runs the command and returns the exit status."""
    args = addition.parser(__doc__, "iterations").parse_args()
    return addition.main(args, run, table, "iterations")


if __name__ == "__main__":
    sys.exit(main())
