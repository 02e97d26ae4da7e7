"""Simulates a design under other conditions, see `report.stress`; a run keeps what was found.

Mass, friction and other constants are data of one program; the other bending law is a program.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from rich.console import Console

from codesign_jax import codesign, model, rollout, store
from codesign_jax.commands.case import Case, find_case
from codesign_jax.commands.common import counted
from codesign_jax.commands.flags import Subject
from codesign_jax.engines import Engine, make_engine
from codesign_jax.engines.mujoco import world_model
from codesign_jax.model import overlap
from codesign_jax.report import stress
from codesign_jax.report.stress import Stress
from codesign_jax.reuse import Program, shared
from codesign_jax.runs import Settings, outcomes
from codesign_jax.runs.interrupts import interruptible
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import Constants, Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.scene.schema import InputError
from codesign_jax.types import Outcome, Params, Trial

FILE = "stress.npz"
"""Where what was found is kept in the run folder."""
TRIALS = 12
"""Grasps of each condition at the end of a run."""
DRAWS = 6
"""Draws of other constants."""
HEAVIEST = 0.5
"""Largest mass [kg] of an object that is made heavier."""
FRICTION = 0.4
"""A coefficient between silicone and a smooth or dusty object."""
FACTORS = {
    ("hand", "material", "shear_modulus"): (0.6, 1.65),
    ("hand", "material", "lateral_factor"): (0.44, 1.3),
    ("hand", "material", "torsion_factor"): (0.5, 1.1),
    ("hand", "wrist", "linear_stiffness"): (0.6, 7.0),
    ("hand", "wrist", "angular_stiffness"): (0.1, 1.4),
    ("objects", "object", "friction"): (0.7, 1.4),
    ("objects", "table", "friction"): (0.57, 1.4),
    ("contact", "normal_stiffness"): (0.3, 4.5),
    ("contact", "friction_ratio"): (0.12, 2.5),
}
"""Ranges of factors on constants that nobody knows before a hand is built, drawn log-uniformly:
those between 5 and 95 % of the sets that no target of docs/calibration.md rules out."""
STREAM_STRESS = 0x73747265
"""Stream of the trials' noise ("stre")."""
HELD = 10
"""Every so many time steps a state is looked at."""


def simulate(case: Case, trials: int, key: jax.Array) -> Stress:
    """Simulates the design under every condition, in the same trials."""
    scene, conditions, kept = case.scene, [], []
    run = _program(scene, case.engine, case.space, trials)
    design = jnp.asarray(case.design, jnp.float32)
    found, qpos, drawn = interruptible(run, design, key)
    params = jax.tree.map(np.asarray, jax.jit(case.space.params)(design))
    warnings = _in_grasps(scene, params, *jax.tree.map(np.asarray, (found, qpos, drawn)))
    every = [("as it is", found)]
    every += [(name, interruptible(run, design, key, c)[0]) for name, c in variants(scene)]
    law = not scene.effects.neo_hookean
    other = dataclasses.replace(scene, effects=dataclasses.replace(scene.effects, neo_hookean=law))
    name = f"{'neo-Hookean' if law else 'linear'} bending law"
    try:
        run = _program(other, case.engine, case.space, trials)
    except InputError:  # an engine that has one law only
        pass
    else:
        every.append((name, interruptible(run, design, key)[0]))
    for name, outcome in every:
        conditions.append(name)
        kept.append((codesign.verdicts(outcome) == codesign.VERDICTS.index("kept")).sum())
    return Stress(tuple(conditions), np.array(kept), trials, tuple(warnings))


def sets(scene: Scene) -> int:
    """How often `simulate` simulates its trials: as they are, by the other law, and of variants."""
    return 2 + len([*variants(scene)])


def variants(scene: Scene) -> Iterator[tuple[str, Constants]]:
    """Conditions that are numbers of the scene, with their names; draws have one name."""
    numbers, masses = scene.constants(), [shape.mass for shape in scene.objects.object]
    sets = [tuple(max(min(n * m, HEAVIEST), m) for m in masses) for n in (4, 10)]
    for heavier in dict.fromkeys(sets):
        if heavier != (*masses,):
            grams = dict.fromkeys(f"{1e3 * m:.0f}" for m in (min(heavier), max(heavier)))
            path, place = ("objects", "object", "mass"), iter(heavier)
            own = _changed(numbers, path, lambda _, place=place: next(place))
            yield f"objects of {' to '.join(grams)} g", own
    own = _changed(numbers, ("objects", "object", "friction"), lambda _: FRICTION)
    yield f"friction {FRICTION} on the hand", own
    random = np.random.default_rng(STREAM_STRESS)
    for _ in range(DRAWS):
        own = numbers
        for path, ends in FACTORS.items():
            factor = float(np.exp(random.uniform(*np.log(ends))))
            own = _changed(own, path, lambda v, factor=factor: v * factor)
        yield f"{DRAWS} draws of other constants", own


def _changed(table: Any, path: tuple[str, ...], change: Callable[[float], float]) -> Any:
    """Nested tables with changed numbers at a path, of all entries of arrays of tables."""
    if not path:
        return change(table)
    if not hasattr(table, "_fields"):
        return tuple(_changed(entry, path, change) for entry in table)
    return table._replace(**{path[0]: _changed(getattr(table, path[0]), path[1:], change)})


def _program(scene: Scene, engine: str, space: DesignSpace, trials: int) -> Program:
    return Program(scene, _recorded(scene, make_engine(engine, scene), space, trials))


@shared
def _recorded(scene: Scene, engine: Engine, space: DesignSpace, num_trials: int) -> Callable:
    def simulated(
        design: jax.Array, key: jax.Array, constants: Constants
    ) -> tuple[Outcome, jax.Array, Trial]:
        trials = rollout.sample_trials(scene, key, num_trials, constants=constants)
        hands, trials = rollout.crossed(
            jax.tree.map(lambda v: v[None], space.params(design)), trials
        )
        found, trace = rollout.simulate(
            scene, engine, hands, trials, record_qpos=True, constants=constants
        )
        return found, trace.qpos[:, ::HELD], trials

    return simulated


def _in_grasps(
    scene: Scene, params: Params, found: Outcome, qpos: np.ndarray, trials: Trial
) -> list[str]:
    """Warnings of what fingers do until the release, in kept grasps, one of each object."""
    kept = np.flatnonzero(codesign.verdicts(found) == codesign.VERDICTS.index("kept"))
    first = [kept[trials.shape[kept] == k][:1] for k in range(len(scene.objects.object))]
    times = np.arange(qpos.shape[1]) * HELD
    closed, held, end = (scene.steps_to(t) for t in (scene.phases.approach, *scene.window))
    whole, hold = (times >= closed) & (times < end), (times >= held) & (times < end)
    bends = overlap.bend_angles(scene, qpos[kept])
    lines = stress.of_bends(overlap.wall_strain(scene, params, bends[:, whole]), bends[:, hold])
    depths = []
    for w in np.concatenate(first).astype(int):
        trial = jax.tree.map(lambda v, w=w: v[w], trials)
        place, turn = _poses(scene, params, trial, qpos[w, hold])
        depths.append(overlap.overlaps(scene, params, place, turn))
    return [*lines, *stress.of_overlaps(scene, params, depths)]


def _poses(
    scene: Scene, params: Params, trial: Trial, qpos: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (state, body, 3) and orientations (state, body, 3, 3) of bodies, by MuJoCo C."""
    fields = jax.jit(model.model_fields, static_argnums=0)(scene, params, trial)
    compiled = world_model(scene, jax.tree.map(np.asarray, fields))
    data, found = mujoco.MjData(compiled), []
    for state in qpos:
        data.qpos[:] = state
        mujoco.mj_kinematics(compiled, data)
        found.append((data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy()))
    place, turn = zip(*found, strict=True)
    return np.stack(place), np.stack(turn)


def tell(case: Case, found: Stress, console: Console) -> None:
    """Prints what was found, and the warnings of the design."""
    console.print(
        f"under other conditions, {found.trials} grasps each, steps of "
        f"{1e3 * case.scene.discretization.timestep:g} ms:"
    )
    params = jax.tree.map(np.asarray, case.space.params(jnp.asarray(case.design)))
    warnings = [*stress.of_design(case.scene, params), *found.warnings]
    for line in [*found.lines(), *(f"warning: {words}" for words in warnings)]:
        console.print(line, markup=False)


def of_run(folder: Path, settings: Settings, console: Console) -> None:
    """Tells what was found of a run's design; simulated and kept in its folder if not yet."""
    case = _case(folder, settings)
    found = stored(folder, settings)
    if found is None:
        with Busy(console, f"stress, {counted(TRIALS, 'grasp')} of each condition"):
            found = simulate(case, TRIALS, _noise(settings))
        arrays = {k: np.array(v) for k, v in found._asdict().items()}
        store.save(folder / FILE, store.head(_key(case, settings)) | arrays)
    tell(case, found, console)


def stored(folder: Path, settings: Settings) -> Stress | None:
    """What `of_run` kept in a run folder, if it is of its design today."""
    try:
        arrays = store.load(folder / FILE)
    except (OSError, store.StoreError):
        return None
    if store.refusal(arrays, _key(_case(folder, settings), settings)):
        return None
    texts = {k: tuple(arrays[k].tolist()) for k in ("conditions", "warnings")}
    return Stress(kept=arrays["kept"], trials=int(arrays["trials"]), **texts)


def _case(folder: Path, settings: Settings) -> Case:
    return find_case(Subject(run_folder=folder, engine=settings.engine), tell=lambda text: None)


def _key(case: Case, settings: Settings) -> str:
    return outcomes.key(case.scene, case.engine, case.design[None], TRIALS, settings.seed)


def _noise(settings: Settings) -> jax.Array:
    return codesign.stream_key(jax.random.key(settings.seed), STREAM_STRESS)
