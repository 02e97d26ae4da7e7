"""The grasps of `codesign export` that say how far parameters of a design may drift."""

from typing import TYPE_CHECKING

import jax

from codesign_jax import batch
from codesign_jax.codesign import Task
from codesign_jax.commands.flags import Export
from codesign_jax.engines import Engine
from codesign_jax.runs.cases import Case
from codesign_jax.runs.progress import Meter
from codesign_jax.statistics import Interval
from codesign_jax.terminal import Console

if TYPE_CHECKING:
    from codesign_jax.export import sheet
    from codesign_jax.export.tolerance import Study


def simulate(case: Case, engine: Engine, options: Export, console: Console) -> "sheet.Drift":
    """Tolerances of the design: says how many grasps they take at most, and simulates."""
    from codesign_jax.export import sheet, tolerance  # with the extra

    steps = options.tolerance_steps
    count = options.tolerance_trials
    planned = study(case, options)
    task = Task(case.scene, planned.space, count, engine)
    size = batch.size(1 + int(planned.room.sum()), count)
    key = jax.random.key(options.seed)
    _announce(planned, options, console)
    with Meter("tolerance", planned.most * count, console) as meter:

        def shares_of(asked: list[int]) -> list[Interval]:
            designs = planned.designs[asked]
            return tolerance.shares(batch.evaluate(task, key, designs, size, meter.advance))

        found = tolerance.search(planned, shares_of)
    known = found[0].value >= tolerance.WANTED
    rows = tolerance.tolerances(planned, found) if known else []
    fixed = sum(source < 0 for source in planned.space.source)
    return sheet.Drift(found[0], count, steps, case.engine, rows, fixed)


def study(case: Case, options: Export) -> "Study":
    """The designs of the tolerances; of the free parameters if none are asked for."""
    from codesign_jax.export import tolerance  # with the extra

    free = options.tolerance != "all"
    steps = options.tolerance_steps
    return tolerance.study(case.scene, case.space, case.design, steps, free=free)


def _announce(planned: "Study", options: Export, console: Console) -> None:
    names = planned.space.names
    most = planned.most * options.tolerance_trials
    moved = ", ".join(names) if len(names) <= 4 else f"{len(names)} parameters"
    others = {"free": "all moves the hand's whole table", "all": "free moves fewer"}
    console.print(
        f"tolerance of {moved}: simulating at most {most} grasps "
        f"(--tolerance {others[options.tolerance]}, off none)"
    )
