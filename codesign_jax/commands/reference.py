"""Tests the best particle of a run on fresh trials at the accuracy `reference`.

An optimiser picks what the errors of its simulation favour (the winner's curse), and the best of
several final particles was chosen by the very trials that tested it.  So it is simulated again, in
trials that the run has not met and with finer steps; docs/results.md has how much that changes.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from codesign_jax import codesign, engines
from codesign_jax.commands import verdicts
from codesign_jax.commands.case import Case, find_case
from codesign_jax.commands.estimate import Part
from codesign_jax.commands.flags import Subject
from codesign_jax.engines import make_engine
from codesign_jax.runs import Settings, outcomes, rates
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
    """Fresh trials of a run: what was asked for, or `TRIALS` with the engine that is fast enough.

    Args:
      asked: Number on the command line; None for none.
      settings: The run's settings; a run without a final test has no reference test either.
    """
    if asked is not None:
        return asked
    return TRIALS if settings.engine == engines.DEFAULT and settings.test_trials else 0


def part(scene: Scene, settings: Settings, trials: int, runs: int) -> Part:
    """What the test takes, for an estimate.

    Args:
      scene: Scene of the runs.
      settings: Their settings.
      trials: Fresh trials of each run.
      runs: Runs, whose tests come one after the other.
    """
    finer = with_accuracy(scene, ACCURACY)
    work = rates.batch_work(finer, settings.engine, trials, devices=1)
    return Part(f"the test at accuracy {ACCURACY}", work, trials * runs)


def test(folder: Path, settings: Settings, trials: int, console: Console) -> Outcome:
    """Simulates the best particle of a run in fresh trials at `reference` and says how it did.

    Its outcomes are kept in the run folder: a finished run does not simulate them again.

    Args:
      folder: Run folder.
      settings: The run's settings.
      trials: Fresh trials.
      console: Told the verdict.

    Returns:
      Outcomes of the trials, shape (trial,).
    """
    case, key = _case(folder, settings, trials)
    found, why = outcomes.load(folder / FILE, key)
    if found is None:
        if why:
            console.print(f"{folder / FILE} {why}: simulated again", markup=False)
        found = _simulate(case, settings, trials)
        outcomes.save(folder / FILE, found, key)
    size = case.scene.discretization
    verdict = verdicts.verdict(case.scene, found)
    console.print(
        f"on {trials} fresh trials at accuracy {ACCURACY} ({1e3 * size.timestep:g} ms, "
        f"{size.links} links): {verdict}"
    )
    return found


def stored(folder: Path, settings: Settings) -> tuple[Outcome | None, str]:
    """Outcomes that `test` kept in a run folder, shape (trial,), if they are of its design today.

    Args:
      folder: Run folder with a finished episode.
      settings: The run's settings.

    Returns:
      The outcomes or None, and why there are none; see `runs.outcomes.load`.
    """
    trials = outcomes.count(folder / FILE)
    return outcomes.load(folder / FILE, _case(folder, settings, trials)[1])


def _case(folder: Path, settings: Settings, trials: int) -> tuple[Case, str]:
    """The design to test and the digest of what determines its outcomes."""
    subject = Subject(run_folder=folder, engine=settings.engine, accuracy=ACCURACY)
    case = find_case(subject, tell=lambda text: None)  # the command says what is amiss
    return case, outcomes.key(case.scene, case.engine, case.design[None], trials, settings.seed)


def _simulate(case: Case, settings: Settings, trials: int) -> Outcome:
    """Outcomes of the design in fresh trials, shape (trial,)."""
    evaluate = codesign.make_evaluate(
        case.scene, make_engine(case.engine, case.scene), case.space, trials
    )
    key = codesign.stream_key(jax.random.key(settings.seed), STREAM_REFERENCE)
    found = evaluate(jnp.asarray(case.design, jnp.float32)[None], key)
    return jax.tree.map(lambda v: np.asarray(v)[0], found)
