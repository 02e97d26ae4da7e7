"""What is simulated of a run's design once it has ended, and kept in its folder.

An optimiser picks what the errors of its simulation favour (the winner's curse), and the best of
several final particles was chosen by the very trials that tested it.  So it is simulated again, in
trials that the run has not met and with finer steps (accuracy `reference`; docs/results.md has how
much that changes), until its verdict is decided, and at the run's accuracy under other conditions
(`stress`).
"""

import shlex
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import array_files, codesign, engines, rollout
from codesign_jax.array_files import Array
from codesign_jax.interrupts import interruptible
from codesign_jax.judge import fresh_trials, stress, verdict, worth
from codesign_jax.judge.cases import Case
from codesign_jax.judge.sentences import Judged
from codesign_jax.judge.stress import Stress
from codesign_jax.judge.worth import Worth
from codesign_jax.runs import Settings, columns, tables
from codesign_jax.runs.directory import RunDirectory
from codesign_jax.runs.plan import Plan
from codesign_jax.runs.programs import RETEST, Programs
from codesign_jax.runs.progress import Meter
from codesign_jax.runs.record import outcome_layout
from codesign_jax.runs.selection import case_of_run
from codesign_jax.scene import Scene, with_accuracy
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome

FRESH = "fresh trials"
"""Name of the program of `test`."""
FILE = "reference.npz"
STRESS_FILE = "stress.npz"
FINGERS_FILE = "fingers.npz"
STRESS_TRIALS = 12
"""Grasps of each condition."""
_FINGERS = {
    "conditions": Array("U", ("condition",)),
    "absent": Array("b", ("hand", "finger")),
    **dict.fromkeys(("both", "whole", "fewer", "total"), Array("iu", ("hand", "condition"))),
}
_STRESS = {
    "conditions": Array("U", ("set",)),
    "kept": Array("iu", ("set",)),
    "trials": Array("iu", ()),
    "warnings": Array("U", ("warning",)),
}
_NO_RESULT = "does not hold what such a file has"
_LEFT_OUT = {
    FILE: "the design's fresh trials and their verdict are",
    STRESS_FILE: "its grasps under other conditions and their warnings are",
}


def most_trials(trials: int | None, settings: Settings) -> int:
    """Most fresh trials of a run: as asked for, or `MOST` with the engine that is fast."""
    if trials is not None:
        return trials
    return verdict.MOST if settings.engine == engines.DEFAULT and settings.test_trials else 0


def programs_of(plan: Plan, most: int, worlds: int = 0) -> Programs:
    """The programs of a search and of what is simulated of its design, in the order of their use.

    Args:
      most: Most fresh trials; with 0 nothing is simulated behind the search.
      worlds: Worlds of an episode of all runs, where one device simulates them; 0 if several do.
    """
    settings = plan.settings
    if settings.policy or not getattr(plan.task.engine, "fills", False):
        return Programs()
    case = Case(plan.scene, plan.space, plan.space.default(), settings.engine)
    retest = {}
    if plan.retests and plan.task.cost is None and worlds:
        retest = {RETEST: partial(case.compile, worlds, rollout.Options())}
    if not most:
        return Programs(retest)
    finer = case._replace(scene=with_accuracy(plan.scene, fresh_trials.ACCURACY))
    fresh = {FRESH: partial(finer.compile, verdict.BATCH, rollout.Options())}
    if finer.scene.structure == case.scene.structure:
        fresh = {}
    return Programs(retest | fresh | stress.compilers(case, STRESS_TRIALS))


def test(
    run: RunDirectory,
    settings: Settings,
    most: int,
    console: Console,
    programs: Programs,
    later: float = 0.0,
) -> Outcome:
    """Outcomes of the run's design in fresh trials at `reference`, as many as decide its verdict.

    Every batch is kept, so that the test goes on where it was stopped, or with a larger `most`.

    Args:
      most: Most trials; at least 1.
      programs: As of `programs_of`.
      later: What is simulated after it, for the time left, in grasps of this accuracy.
    """
    folder = run.path
    case = _finer(folder, settings)
    key = _noise(settings, fresh_trials.STREAM)
    about = case.digest(settings.seed)
    kept, why = _outcomes(folder, about)
    if why:
        console.print(f"{folder / FILE} {why}: simulated again")
    with Meter("reference test", min(verdict.USUAL, most), console, later=later) as meter:

        def keep(outcomes: Outcome) -> None:
            array_files.save_results(run.here() / FILE, about, outcomes._asdict())
            show(meter, outcomes, most)

        meter.count(kept.cost.size if kept else 0)
        if kept is None or verdict.undecided(kept, most):
            programs.wait(FRESH, meter.compiling)
        outcomes = fresh_trials.decide(case, key, most, kept, keep)
    if kept is None or outcomes.cost.size > kept.cost.size:
        drawn = rollout.sample_trials(case.scene, key, outcomes.cost.size)
        tables.write_grasps(run.here() / columns.REFERENCE, case.scene, drawn, outcomes)
    return outcomes


def show(meter: Meter, outcomes: Outcome, most: int) -> None:
    """Shows on a meter how many trials there are, and how many are to come."""
    total = outcomes.cost.size
    meter.total = min(most, total + fresh_trials.lacking(outcomes))
    meter.advance(total - meter.done)


def _outcomes(folder: Path, about: str, *, any_code: bool = False) -> tuple[Outcome | None, str]:
    layout = outcome_layout("trial")
    arrays, why = array_files.load_results(folder / FILE, about, layout, any_code=any_code)
    return (None if arrays is None else Outcome(**arrays)), why


def stored(folder: Path, settings: Settings) -> tuple[Outcome | None, str]:
    """Outcomes that `test` kept of the run's design, or None; and what is amiss with them.

    To be shown: those of another version of the code are among them.
    """
    return _outcomes(folder, _finer(folder, settings).digest(settings.seed), any_code=True)


def tell_stress(case: Case, result: Stress, console: Console) -> None:
    """Prints what grasps under other conditions found, and the warnings of the design."""
    console.print(
        f"under other conditions, {result.trials} grasps each, steps of "
        f"{1e3 * case.scene.discretization.timestep:g} ms:"
    )
    params = jax.tree.map(np.asarray, case.space.params(jnp.asarray(case.design)))
    warnings = [*stress.of_design(case.scene, params), *result.warnings]
    for line in [*result.lines(), *(f"warning: {words}" for words in warnings)]:
        console.print(line)


def stress_run(
    run: RunDirectory,
    settings: Settings,
    console: Console,
    programs: Programs,
    later: float = 0.0,
) -> tuple[Case, Stress]:
    """The run's design, and what it keeps under other conditions, simulated if not yet.

    Args:
      programs: As of `programs_of`.
      later: What is simulated after it, for the time left, in grasps of the run's accuracy.
    """
    folder = run.path
    case, about = tested(folder, settings)
    result, why = read_stress(folder, about)
    if why:
        console.print(f"{folder / STRESS_FILE} {why}: simulated again")
    if result is None:
        total = STRESS_TRIALS * stress.sets(case.scene)
        with Meter("other conditions", total, console, later=later) as meter:
            noise = _noise(settings, stress.STREAM)
            wait = partial(programs.wait, tell=meter.compiling)
            result = stress.simulate(case, STRESS_TRIALS, noise, meter.advance, wait)
        array_files.save_results(run.here() / STRESS_FILE, about, result._asdict())
    return case, result


def read_stress(folder: Path, about: str, *, any_code: bool = False) -> tuple[Stress | None, str]:
    """What `stress_run` kept of a design, or None; and what is amiss with it.

    Args:
      about: Digest of design and trials.
      any_code: Whether results of another version of the code are taken, to be shown.
    """
    path = folder / STRESS_FILE
    arrays, why = array_files.load_results(path, about, _STRESS, any_code=any_code)
    if arrays is None:
        return None, why
    texts = {k: tuple(map(str, arrays[k].tolist())) for k in ("conditions", "warnings")}
    result = Stress(kept=arrays["kept"].astype(int), trials=int(arrays["trials"]), **texts)
    if result.trials < 1 or not ((0 <= result.kept) & (result.kept <= result.trials)).all():
        return None, _NO_RESULT
    return result, why


def worth_run(run: RunDirectory, settings: Settings, console: Console) -> Worth | None:
    """What each finger of the run's design is worth, simulated if not yet.

    None where there is nothing to leave out, or the design has a policy.
    """
    folder = run.path
    case, about = tested(folder, settings)
    if case.policy or case.scene.num_fingers < 2 or settings.engine != engines.DEFAULT:
        return None
    result, why = read_worth(folder, about)
    if why:
        console.print(f"{folder / FINGERS_FILE} {why}: simulated again")
    if result is None:
        with Meter("fingers", worth.grasps(case.scene.num_fingers), console) as meter:
            noise = _noise(settings, worth.STREAM)
            params = case.space.params(jnp.asarray(case.design, jnp.float32))
            results: list[Worth] = []

            def simulate() -> None:
                engine = case.make_engine()
                results.append(worth.simulate(case.scene, engine, params, noise, meter.advance))

            interruptible(simulate)
            [result] = results
        array_files.save_results(run.here() / FINGERS_FILE, about, result._asdict())
    return result


def tell_worth(result: Worth, folder: Path, console: Console) -> None:
    """Prints what each finger is worth, and how to judge the hand that lacks some."""
    console.print("without a finger, in the trials of the whole hand:")
    for line in [*result.lines(), result.sentence]:
        console.print(line)
    if result.least:
        words = ["codesign", "evaluate", "--run", str(folder), "--stress"]
        words += ["--accuracy", fresh_trials.ACCURACY, "--without", *map(str, result.least)]
        console.print(f"to judge that hand: {shlex.join(words)}")


def read_worth(folder: Path, about: str, *, any_code: bool = False) -> tuple[Worth | None, str]:
    """What `worth_run` kept of a design, or None; arguments as of `read_stress`."""
    path = folder / FINGERS_FILE
    arrays, why = array_files.load_results(path, about, _FINGERS, any_code=any_code)
    if arrays is None:
        return None, why
    names = tuple(map(str, arrays.pop("conditions").tolist()))
    absent = arrays.pop("absent")
    counts = {name: value.astype(int) for name, value in arrays.items()}
    result = Worth(names, absent, **counts)
    parts = np.array([result.both, result.whole, result.fewer])
    tried = result.total.any(1).all()
    if (parts < 0).any() or (parts.sum(0) > result.total).any() or not tried:
        return None, _NO_RESULT
    return result, why


class Kept(NamedTuple):
    """What is kept of a run's design from the grasps after its search."""

    fresh: Judged | None
    stress: Stress | None
    notes: list[str]  # what is left out or of another version of the code, and why
    worth: Worth | None = None


def kept(folder: Path, scene: Scene, settings: Settings) -> Kept:
    """Both results of a run's design, and notes where one cannot be shown or is gone."""
    outcome, why = stored(folder, settings)
    about = tested(folder, settings)[1]
    conditions, cause = read_stress(folder, about, any_code=True)
    gone = (outcome is None) != (conditions is None)  # a run that ended has both, or neither
    reasons = {FILE: why, STRESS_FILE: cause}
    lacking = {FILE: outcome is None, STRESS_FILE: conditions is None}
    again = "The command of codesign optimize that made the run simulates them again"
    notes = []
    for name, reason in reasons.items():
        if lacking[name] and (reason or gone):
            text = f"{folder / name} {reason or 'is missing'}: {_LEFT_OUT[name]} left out"
            notes.append(f"{text}. {again}")
        elif reason:
            notes.append(f"{folder / name} {reason}. {again}")
    fingers, cause = read_worth(folder, about, any_code=True)
    if cause:
        words = f"{folder / FINGERS_FILE} {cause}"
        notes.append(f"{words}{': it is left out' if fingers is None else ''}. {again}")
    trials = None if outcome is None else fresh_trials.judged(scene, outcome, conditions)
    return Kept(trials, conditions, notes, fingers)


def tested(folder: Path, settings: Settings) -> tuple[Case, str]:
    """The run's design at the run's accuracy, and the digest of what it is tested by."""
    case = case_of_run(folder, engine=settings.engine)
    return case, case.digest(STRESS_TRIALS, settings.seed)


def _finer(folder: Path, settings: Settings) -> Case:
    return case_of_run(folder, accuracy=fresh_trials.ACCURACY, engine=settings.engine)


def _noise(settings: Settings, stream: int) -> jax.Array:
    return codesign.stream_key(jax.random.key(settings.seed), stream)
