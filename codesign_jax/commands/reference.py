"""What is simulated of a run's design once it has ended, and kept in its folder.

An optimiser picks what the errors of its simulation favour (the winner's curse), and the best of
several final particles was chosen by the very trials that tested it.  So it is simulated again, in
trials that the run has not met and with finer steps (accuracy `reference`; docs/results.md has how
much that changes), and at the run's accuracy under other conditions (`report.stress`).
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from codesign_jax import codesign, engines, rollout, store
from codesign_jax.commands.common import counted
from codesign_jax.report import stress
from codesign_jax.report.stress import Stress
from codesign_jax.report.verdicts import Judged
from codesign_jax.runs import Settings, columns, tables
from codesign_jax.runs.choice import Case, case_of_run
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import Scene, with_accuracy
from codesign_jax.types import Outcome

ACCURACY = "reference"
FILE, STRESS_FILE = "reference.npz", "stress.npz"
TRIALS = 24
"""Fresh trials by default: without a loss in them, 86 to 100 % of grasps hold (95 % interval)."""
STRESS_TRIALS = 12
"""Grasps of each condition."""
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
    return None if arrays is None else Outcome(**arrays), why


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
    (case, about), found = _stress_case(folder, settings), stored_stress(folder, settings)
    if found is None:
        with Busy(console, f"stress, {counted(STRESS_TRIALS, 'grasp')} of each condition"):
            found = stress.simulate(case, STRESS_TRIALS, _noise(settings, stress.STREAM))
        store.keep(folder / STRESS_FILE, about, found._asdict())
    tell_stress(case, found, console)


def stored_stress(folder: Path, settings: Settings) -> Stress | None:
    """What `stress_run` kept in a run folder, if it is of its design today."""
    arrays, _ = store.found(folder / STRESS_FILE, _stress_case(folder, settings)[1])
    if arrays is None:
        return None
    texts = {k: tuple(arrays[k].tolist()) for k in ("conditions", "warnings")}
    return Stress(kept=arrays["kept"], trials=int(arrays["trials"]), **texts)


def _stress_case(folder: Path, settings: Settings) -> tuple[Case, str]:
    case = case_of_run(folder, engine=settings.engine)
    return case, case.digest(STRESS_TRIALS, settings.seed)


def _finer(folder: Path, settings: Settings) -> Case:
    return case_of_run(folder, accuracy=ACCURACY, engine=settings.engine)


def _noise(settings: Settings, stream: int) -> jax.Array:
    return codesign.stream_key(jax.random.key(settings.seed), stream)
