"""What is simulated of a run's design once it has ended, and kept in its folder.

An optimiser picks what the errors of its simulation favour (the winner's curse), and the best of
several final particles was chosen by the very trials that tested it.  So it is simulated again, in
trials that the run has not met and with finer steps (accuracy `reference`; docs/results.md has how
much that changes), and at the run's accuracy under other conditions (`report.stress`).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, engines, rollout, store
from codesign_jax.commands.common import counted
from codesign_jax.report import stress
from codesign_jax.report.stress import Stress
from codesign_jax.report.verdicts import Judged
from codesign_jax.runs import Settings, columns, tables
from codesign_jax.runs.choice import Case, case_of_run
from codesign_jax.runs.progress import Busy, Meter
from codesign_jax.scene import Scene, with_accuracy
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome

ACCURACY = "reference"
FILE, STRESS_FILE = "reference.npz", "stress.npz"
TRIALS = 24
"""Fresh trials by default: without a loss in them, 86 to 100 % of grasps hold (95 % interval)."""
STRESS_TRIALS = 12
"""Grasps of each condition."""
_OUTCOME = ("cost", "status", "lost_time", "bad_step")
"""Arrays that every outcome has."""
_NO_RESULT = "does not hold what such a file has"
_LEFT_OUT = {
    FILE: "the design's fresh trials and their verdict are",
    STRESS_FILE: "its grasps under other conditions and their warnings are",
}
STREAM_REFERENCE = 0x72656665
"""Stream of the fresh trials' noise ("refe")."""


def number_of_trials(asked: int | None, settings: Settings) -> int:
    """Fresh trials of a run: those asked for, or `TRIALS` with the engine that is fast."""
    if asked is not None:
        return asked
    return TRIALS if settings.engine == engines.DEFAULT and settings.test_trials else 0


def test(folder: Path, settings: Settings, trials: int, console: Console) -> Outcome:
    """Outcomes of the run's design in fresh trials at `reference`, simulated if not yet."""
    found, why = stored(folder, settings)
    if found is not None and found.cost.size == trials:
        return found
    if why:
        console.print(f"{folder / FILE} {why}: simulated again")
    case, key = _finer(folder, settings), _noise(settings, STREAM_REFERENCE)
    with Busy(console, f"reference test, {counted(trials, 'grasp')}"):
        found = case.simulate(trials, key)
        store.keep(folder / FILE, case.digest(settings.seed), found._asdict())
        drawn = rollout.sample_trials(case.scene, key, trials)
        tables.write_grasps(folder / columns.REFERENCE, case.scene, drawn, found)
    return found


def judged(scene: Scene, found: Outcome) -> Judged:
    """Outcomes of the test with the scene that was simulated."""
    return Judged(with_accuracy(scene, ACCURACY), found, ACCURACY)


def steps_and_links(scene: Scene) -> float:
    """How much more time a grasp of the test takes than one of the scene, by steps and links."""
    finer = with_accuracy(scene, ACCURACY)
    sizes = [s.num_steps * s.discretization.links for s in (finer, scene)]
    return sizes[0] / sizes[1]


def stored(folder: Path, settings: Settings) -> tuple[Outcome | None, str]:
    """Outcomes that `test` kept of the run's design; or None and why, see `store.found`."""
    arrays, why = store.found(folder / FILE, _finer(folder, settings).digest(settings.seed))
    if arrays is None:
        return None, why
    shapes = {v.shape if v.dtype.kind in "biuf" else () for v in arrays.values()}
    if not {*_OUTCOME} <= {*arrays} <= {*Outcome._fields} or {len(s) for s in shapes} != {1}:
        return None, _NO_RESULT
    return (Outcome(**arrays), "") if len(shapes) == 1 else (None, _NO_RESULT)


def tell_stress(case: Case, found: Stress, console: Console) -> None:
    """Prints what grasps under other conditions found, and the warnings of the design."""
    console.print(
        f"under other conditions, {found.trials} grasps each, steps of "
        f"{1e3 * case.scene.discretization.timestep:g} ms:"
    )
    params = jax.tree.map(np.asarray, case.space.params(jnp.asarray(case.design)))
    warnings = [*stress.of_design(case.scene, params), *found.warnings]
    for line in [*found.lines(), *(f"warning: {words}" for words in warnings)]:
        console.print(line)


def stress_run(folder: Path, settings: Settings, console: Console) -> None:
    """Tells what the run's design keeps under other conditions, simulated if not yet."""
    case, about = _stress_case(folder, settings)
    place = folder / STRESS_FILE
    found = stored_stress(
        folder, settings, lambda why: console.print(f"{place} {why}: simulated again")
    )
    if found is None:
        total = STRESS_TRIALS * stress.sets(case.scene)
        with Meter("stress", total, console) as meter:
            noise = _noise(settings, stress.STREAM)
            found = stress.simulate(case, STRESS_TRIALS, noise, done=meter.advance)
        store.keep(folder / STRESS_FILE, about, found._asdict())
    tell_stress(case, found, console)


def stored_stress(
    folder: Path, settings: Settings, tell: Callable[[str], None] = lambda why: None
) -> Stress | None:
    """What `stress_run` kept of the run's design; else None, and `tell` takes why."""
    arrays, why = store.found(folder / STRESS_FILE, _stress_case(folder, settings)[1])
    found = None if arrays is None else _stress(arrays)
    if why or (arrays is not None and found is None):
        tell(why or _NO_RESULT)
    return found


def _stress(arrays: dict[str, Any]) -> Stress | None:
    """Arrays of a file as a result; None if they are none."""
    try:
        texts = {k: tuple(map(str, arrays[k].tolist())) for k in ("conditions", "warnings")}
        found = Stress(kept=arrays["kept"].astype(int), trials=int(arrays["trials"]), **texts)
    except (KeyError, TypeError, ValueError):
        return None
    if found.kept.shape != (len(found.conditions),) or found.trials < 1:
        return None
    return found if ((0 <= found.kept) & (found.kept <= found.trials)).all() else None


class Kept(NamedTuple):
    """What is kept of a run's design from the grasps after its search."""

    fresh: Judged | None
    stress: Stress | None
    notes: list[str]  # what is left out, and why


def kept(folder: Path, scene: Scene, settings: Settings) -> Kept:
    """Both results of a run's design, and notes where one cannot be shown or is gone."""
    outcome, why = stored(folder, settings)
    causes: list[str] = []
    conditions = stored_stress(folder, settings, causes.append)
    gone = (outcome is None) != (conditions is None)  # a run that ended has both, or neither
    reasons = {FILE: why, STRESS_FILE: "".join(causes)}
    lacking = {FILE: outcome is None, STRESS_FILE: conditions is None}
    notes = [
        f"{folder / name} {reasons[name] or 'is missing'}: {_LEFT_OUT[name]} left out. The "
        "command of codesign optimize that made the run simulates them again"
        for name in reasons
        if lacking[name] and (reasons[name] or gone)
    ]
    return Kept(None if outcome is None else judged(scene, outcome), conditions, notes)


def _stress_case(folder: Path, settings: Settings) -> tuple[Case, str]:
    case = case_of_run(folder, engine=settings.engine)
    return case, case.digest(STRESS_TRIALS, settings.seed)


def _finer(folder: Path, settings: Settings) -> Case:
    return case_of_run(folder, accuracy=ACCURACY, engine=settings.engine)


def _noise(settings: Settings, stream: int) -> jax.Array:
    return codesign.stream_key(jax.random.key(settings.seed), stream)
