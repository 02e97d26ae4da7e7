"""Tests the best particle of a run on fresh trials at the accuracy `reference`.

An optimiser picks what the errors of its simulation favour (the winner's curse), and the best of
several final particles was chosen by the very trials that tested it.  So it is simulated again, in
trials that the run has not met and with finer steps; docs/results.md has how much that changes.
"""

from pathlib import Path

import jax
from rich.console import Console

from codesign_jax import codesign, engines, rollout
from codesign_jax.commands.case import Case, find_case
from codesign_jax.commands.common import counted
from codesign_jax.commands.flags import Subject
from codesign_jax.report.verdicts import Judged
from codesign_jax.runs import RunResult, Settings, columns, outcomes, read_run, tables
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import Scene, with_accuracy
from codesign_jax.types import Outcome

ACCURACY = "reference"
FILE = "reference.npz"
"""Where the outcomes are kept in the run folder."""
TRIALS = 24
"""Fresh trials by default: without a loss in them, 86 to 100 % of grasps hold (95 % interval)."""

STREAM_REFERENCE = 0x72656665
"""Stream of their noise ("refe")."""


def number_of_trials(asked: int | None, settings: Settings) -> int:
    """Fresh trials of a run: those asked for, or `TRIALS` with the engine that is fast."""
    if asked is not None:
        return asked
    return TRIALS if settings.engine == engines.DEFAULT and settings.test_trials else 0


def test(folder: Path, settings: Settings, trials: int, console: Console) -> Outcome:
    """Simulates the best particle of a run in fresh trials at `reference`.

    Its outcomes are kept in the run folder: a finished run does not simulate them again.
    """
    case, key = _case(folder, settings, trials)
    found, why = outcomes.load(folder / FILE, key)
    if found is None:
        if why:
            console.print(f"{folder / FILE} {why}: simulated again", markup=False)
        with Busy(console, f"reference test, {counted(trials, 'grasp')}"):
            found = case.simulate(trials, _noise(settings))
            outcomes.save(folder / FILE, found, key)
            drawn = rollout.sample_trials(case.scene, _noise(settings), trials)
            tables.write_grasps(folder / columns.REFERENCE, case.scene, drawn, found)
    return found


def judged(scene: Scene, found: Outcome) -> Judged:
    """Outcomes of the test with the scene that was simulated."""
    return Judged(with_accuracy(scene, ACCURACY), found, ACCURACY)


def of_runs(results: dict[Path, RunResult | None]) -> dict[Path, Judged | None]:
    """What `test` kept of each run, by its folder; None where there is nothing."""
    kept: dict[Path, Judged | None] = dict.fromkeys(results)
    for folder, result in results.items():
        if result is not None and result.test is not None and (folder / FILE).exists():
            scene, settings = read_run(folder)
            found, _ = stored(folder, settings)
            kept[folder] = None if found is None else judged(scene, found)
    return kept


def steps_and_links(scene: Scene) -> float:
    """How much more time a grasp of the test takes than one of the scene, by steps and links."""
    finer = with_accuracy(scene, ACCURACY)
    sizes = [s.num_steps * s.discretization.links for s in (finer, scene)]
    return sizes[0] / sizes[1]


def stored(folder: Path, settings: Settings) -> tuple[Outcome | None, str]:
    """Outcomes that `test` kept of the run's design, or why there are none; see `outcomes.load`."""
    trials = outcomes.count(folder / FILE)
    return outcomes.load(folder / FILE, _case(folder, settings, trials)[1])


def _case(folder: Path, settings: Settings, trials: int) -> tuple[Case, str]:
    """The design to test and the digest of what determines its outcomes."""
    subject = Subject(run_folder=folder, engine=settings.engine, accuracy=ACCURACY)
    case = find_case(subject, tell=lambda text: None)  # the command says what is amiss
    return case, outcomes.key(case.scene, case.engine, case.design[None], trials, settings.seed)


def _noise(settings: Settings) -> jax.Array:
    return codesign.stream_key(jax.random.key(settings.seed), STREAM_REFERENCE)
