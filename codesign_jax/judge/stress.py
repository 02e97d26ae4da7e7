"""Tests of a design under other conditions, and warnings about the design.

Mass, friction and other constants are data of one program; the other bending law is a program.
"""

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from codesign_jax import model, rollout, section_sizes
from codesign_jax.batch import Batch
from codesign_jax.engines.mujoco import world_model
from codesign_jax.interrupts import interruptible
from codesign_jax.judge import verdict
from codesign_jax.judge.cases import Case
from codesign_jax.model import morphology, overlap
from codesign_jax.model.layout import touches_itself
from codesign_jax.model.overlap import Overlaps
from codesign_jax.reuse import quickly_compiled
from codesign_jax.scene import Scene, draws, silicones
from codesign_jax.scene.buildable import rim_drop
from codesign_jax.scene.schema import InputError
from codesign_jax.statistics import wilson
from codesign_jax.types import Outcome, Params, Trace, Trial

RECORDED, OTHER_LAW = "recorded states", "other bending law"
"""Names of the programs that a design's tests have beside that of its search."""
AS_IT_IS = "as it is"
"""Name of the condition in which nothing is changed, the first one."""
DRAWS = 6
"""Draws of other constants."""
HEAVIEST = 0.5
"""Largest mass [kg] of an object that is made heavier."""
FRICTION = 0.4
"""A coefficient between silicone and a smooth or dusty object."""
UNMEASURED = "unmeasured"
"""Table of the constants that nobody knows before a hand is built."""
OWN_MODULUS = (0.6, 1.65)
"""Range of the modulus of a silicone that is not named: moduli of one silicone by different tests
differ by 1.5 times, see docs/reality.md."""
STREAM = 0x73747265
"""Stream of the trials' noise at the end of a run, and root of the draws ("stre")."""
HELD = 10
"""Every so many time steps a state is looked at."""
STRAIN = 1.5
"""Largest strain at which the silicones of docs/measurements.md were measured."""
DEEP = 3e-3
"""Overlap [m] from which on it is told: less is within the contact's own softness."""
TURN = 2 * np.pi


class Stress(NamedTuple):
    """Grasps of one design under other conditions."""

    conditions: tuple[str, ...]  # what was changed, once for each set of numbers that was simulated
    kept: np.ndarray  # grasps that kept the object, shape (set,)
    trials: int  # grasps of each set
    warnings: tuple[str, ...]  # what the grasps as they are say of the design itself

    @property
    def head(self) -> tuple[str, str, str]:
        """Names of the columns of `rows`."""
        return "condition", "kept", "95 % interval"

    @property
    def by_condition(self) -> dict[str, np.ndarray]:
        """Grasps that kept the object of each set of numbers, shape (set,), by condition."""
        names = np.array(self.conditions)
        return {name: self.kept[names == name] for name in dict.fromkeys(self.conditions)}

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """A row for each condition; of several sets what the worst and the best one keep."""
        table_rows = []
        for name, kept in self.by_condition.items():
            total = self.trials * kept.size
            share, low, high = wilson(int(kept.sum()), total)
            suffix = ""
            if kept.size > 1:
                low = kept.min() / self.trials
                high = kept.max() / self.trials
                suffix = ", by draw"
            span = f"{100 * low:.0f} to {100 * high:.0f} %{suffix}"
            table_rows.append((name, f"{100 * share:.0f} % of {total}", span))
        return table_rows

    @property
    def limits(self) -> str:
        """The second word of a verdict: under which of the other conditions it does not hold.

        Those under which the design kept less than the share that a verdict takes for poor. If
        there is none, how much the grasps of a condition may have missed: the least lower end of
        Wilson's intervals of 95 %.
        """
        others = {name: kept for name, kept in self.by_condition.items() if name != AS_IT_IS}
        shares = {name: kept.mean() / self.trials for name, kept in others.items()}
        weak = [f"{n} ({100 * share:.0f} %)" for n, share in shares.items() if share < verdict.POOR]
        if weak:
            return f"not with {', '.join(weak)}"
        low = min(wilson(int(k.sum()), self.trials * k.size).low for k in others.values())
        return f"holds under all {len(shares)} other conditions (each at least {100 * low:.0f} %)"

    def lines(self) -> list[str]:
        """The rows as aligned text."""
        rows = [("", *self.head[1:]), *self.rows]
        widths = [max(len(row[k]) for row in rows) for k in range(3)]
        cells = [(a.ljust(widths[0]), b.rjust(widths[1]), c) for a, b, c in rows]
        return ["  " + "  ".join(row).rstrip() for row in cells]


def compilers(case: Case, trials: int) -> dict[str, Callable[[], None]]:
    """What compiles the programs of `simulate` that no search has, by their names in their order.

    See `Case.compile`.
    """
    other = case._replace(scene=other_law(case.scene)[1])
    return {
        RECORDED: partial(case.compile, trials, rollout.Options(record_qpos=True)),
        OTHER_LAW: partial(other.compile, trials, rollout.Options()),
    }


def other_law(scene: Scene) -> tuple[str, Scene]:
    """The scene with the other bending law of its fingers, and the name of the condition.

    Of sections by elements, whose walls are neo-Hookean, it is the other winding of the thread.
    """
    section = scene.hand.section
    if section.law == "elements":
        other, name = {"crossed": ("single", "one way"), "single": ("crossed", "there and back")}[
            section.winding
        ]
        section = dataclasses.replace(section, winding=other)
        hand = dataclasses.replace(scene.hand, section=section)
        return f"thread wound {name}", dataclasses.replace(scene, hand=hand)
    other = silicones.under(scene, neo_hookean=not scene.effects.neo_hookean)
    return f"{'neo-Hookean' if other.effects.neo_hookean else 'linear'} bending law", other


def simulate(
    case: Case,
    trials: int,
    key: jax.Array,
    done: Callable[[int], None] = lambda grasps: None,
    wait: Callable[[str], None] = lambda program: None,
) -> Stress:
    """Simulates the design under every condition, in the same trials.

    Args:
      case: The design.
      trials: Trials under each condition.
      key: Key of the trials.
      done: Counts the grasps.
      wait: Is called with the name of each program of `compilers` before its first use.
    """
    scene = case.scene
    params = jax.tree.map(np.asarray, jax.jit(case.space.params)(np.asarray(case.design, float)))
    hands = jax.tree.map(lambda v: np.repeat(v[None], trials, 0), params)

    def simulated(conditions: Batch, scene: Scene) -> tuple[Outcome, Trace, Trial]:
        drawn = rollout.sample_trials(scene, key, trials)
        outcomes, trace = interruptible(conditions.simulate, hands, drawn, scene)
        done(trials)
        return outcomes, trace, jax.tree.map(np.asarray, drawn)

    wait(RECORDED)
    recorded = Batch(scene, case.make_engine(), rollout.Options(record_qpos=True))
    outcomes, trace, drawn = simulated(recorded, scene)
    warnings = of_grasps(scene, params, outcomes, trace, drawn)
    every = [(AS_IT_IS, outcomes)]
    conditions = Batch(scene, case.make_engine(), rollout.Options())
    every += [(name, simulated(conditions, c)[0]) for name, c in variants(scene)]
    name, other = other_law(scene)
    wait(OTHER_LAW)
    try:
        conditions = Batch(other, case.make_engine(other), rollout.Options())
    except InputError:  # an engine that has one law only
        pass
    else:
        every.append((name, simulated(conditions, other)[0]))
    kept = [verdict.kept(outcome).sum() for _, outcome in every]
    return Stress(tuple(name for name, _ in every), np.array(kept), trials, tuple(warnings))


def sets(scene: Scene) -> int:
    """Number of simulations of each trial by `simulate`: unchanged, other law, and variants."""
    return 2 + len([*variants(scene)])


def heavier(scene: Scene) -> list[tuple[str, Scene]]:
    """Scenes with objects of four and of ten times the mass, as far as they are heavier."""
    masses = [shape.mass for shape in scene.objects.object]
    sets = [tuple(max(min(n * m, HEAVIEST), m) for m in masses) for n in (4, 10)]
    scenes = []
    for larger in dict.fromkeys(sets):
        if larger != (*masses,):
            grams = dict.fromkeys(f"{1e3 * m:.0f}" for m in (min(larger), max(larger)))
            path = ("objects", "object", "mass")
            each = iter(larger)
            heavier_scene = draws.changed(scene, path, lambda _, each=each: next(each))
            scenes.append((f"objects of {' to '.join(grams)} g", heavier_scene))
    return scenes


def slippery(scene: Scene) -> tuple[str, Scene]:
    """The scene with objects on which the hand slips."""
    changed = draws.changed(scene, ("objects", "object", "friction"), lambda _: FRICTION)
    return f"friction {FRICTION} on the hand", changed


def variants(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Scenes with other numbers, and the names of these conditions; draws have one name."""
    yield from heavier(scene)
    yield slippery(scene)
    table = unknown(scene)
    if not table.constant:
        return
    values = np.asarray(draws.deviations(table, jax.random.key(STREAM), DRAWS), float)
    for deviation in values:
        yield f"{DRAWS} draws of other constants", draws.applied(scene, table, deviation.tolist())


def unknown(scene: Scene) -> draws.Constants:
    """Constants of a scene of which nothing is known: those that it draws itself are left out.

    The modulus of a silicone that is named is within the interval that measurements give.
    """
    known = {entry.key for entry in scene.drawn.constant}
    silicone = scene.hand.material.silicone
    low, high = OWN_MODULUS
    if silicone is not None:
        rubber = silicones.get(silicone)
        low, high = (end / rubber.shear_modulus for end in rubber.interval)
    constants = []
    for entry in draws.read(UNMEASURED).constant:
        if entry.key == "hand.material.shear_modulus":
            entry = dataclasses.replace(entry, low=low, high=high)
        if entry.key not in known:
            constants.append(entry)
    return draws.Constants(constant=tuple(constants))


def of_grasps(
    scene: Scene, params: Params, outcomes: Outcome, trace: Trace, trials: Trial
) -> list[str]:
    """Warnings of what fingers do in kept grasps of a hand, whose trace has positions."""
    qpos = np.asarray(trace.qpos)[:, ::HELD]
    kept = np.flatnonzero(verdict.kept(outcomes))
    first = [kept[trials.shape[kept] == k][:1] for k in range(len(scene.objects.object))]
    times = np.arange(qpos.shape[1]) * HELD
    approached, lifted, end = (
        scene.steps_to(t) for t in (scene.phase_ends["approach"], *scene.window)
    )
    whole = (times >= approached) & (times < end)
    hold = (times >= lifted) & (times < end)
    bends = overlap.bend_angles(scene, qpos[kept])
    lines = of_bends(overlap.wall_strain(scene, params, bends[:, whole]), bends[:, hold])
    depths = []
    for w in np.concatenate(first).astype(int):
        trial = jax.tree.map(lambda v, w=w: v[w], trials)
        place, turn = _poses(scene, params, trial, qpos[w, hold])
        ctrl = None if trace.ctrl is None else trace.ctrl[w]
        size = section_sizes.of_bodies(scene, params, trial, ctrl)[::HELD]
        depths.append(overlap.overlaps(scene, params, place, turn, size[hold]))
    return [*lines, *of_overlaps(scene, params, depths)]


def _poses(
    scene: Scene, params: Params, trial: Trial, qpos: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (state, body, 3) and orientations (state, body, 3, 3) of bodies, by MuJoCo C."""
    fields = quickly_compiled(model.model_fields, static_argnums=0)(scene, params, trial)
    compiled = world_model(scene, jax.tree.map(np.asarray, fields))
    data = mujoco.MjData(compiled)
    poses = []
    for state in qpos:
        data.qpos[:] = state
        mujoco.mj_kinematics(compiled, data)
        poses.append((data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy()))
    place, turn = zip(*poses, strict=True)
    return np.stack(place), np.stack(turn)


def of_design(scene: Scene, params: Params) -> list[str]:
    """Warnings of a design itself, of which nothing is simulated."""
    warnings: list[str] = []
    limits = morphology.pressure_limits(scene.hand, params)
    law = bool(scene.effects.neo_hookean)
    for f, bend in enumerate(morphology.free_bends(scene.hand, params, neo_hookean=law)):
        limit = limits[f]
        if float(params.pressure[f]) > 0.99 * limit:
            warnings.append(f"finger {f}: its pressure is at its limit, {limit / 1e3:.0f} kPa")
        if bend > TURN:
            warnings.append(
                f"finger {f} bends by {np.degrees(bend):.0f}° without load, more than a turn"
            )
    rim = float(rim_drop(scene.hand.palm.radius, *np.asarray(params.arm, float)[3:]))
    low = scene.arm.zero_height + float(params.arm[2]) - rim
    if low < 0:
        warnings.append(f"the palm's rim is commanded {-1e3 * low:.0f} mm below the table")
    return warnings


def of_bends(strain: np.ndarray, bends: np.ndarray) -> list[str]:
    """Warnings of walls that stretch and fingers that coil in kept grasps.

    Args:
      strain: Strain of the walls, shape (grasp, state, finger, link).
      bends: Bend of the joints while the object is held [rad], shape (grasp, state, finger, link).
    """
    if not strain.size:
        return []
    warnings = []
    most = strain.max((0, 1, 3))
    for f in np.flatnonzero(most > STRAIN):
        warnings.append(
            f"finger {f}: its walls stretch by {100 * most[f]:.0f} % in grasps, more than the "
            f"{100 * STRAIN:.0f} % up to which silicones were measured"
        )
    angles = np.median(bends.sum(-1), 1).max(0)
    for f in np.flatnonzero(angles > TURN):
        warnings.append(
            f"finger {f} bends by {np.degrees(angles[f]):.0f}° in grasps, more than a turn"
        )
    return warnings


def of_overlaps(scene: Scene, params: Params, depths: list[Overlaps]) -> list[str]:
    """Warnings of fingers that stand in something while the object is held."""
    if not depths:
        return []
    fingers = np.concatenate([d.fingers for d in depths]).max(0)
    palm = np.concatenate([d.palm for d in depths]).max(0)
    ends = [(params.height, scene.hand.section.width)]
    ends += [] if params.tip is None else [(params.tip.height, params.tip.width)]
    thin = np.min([np.minimum(*map(np.asarray, pair)) for pair in ends], 0)
    warnings = []
    for i, j in np.argwhere(fingers > DEEP):
        deep = f"{1e3 * fingers[i, j]:.0f} mm"
        if i == j:
            more = "" if touches_itself(scene) else ": the simulation has no such contact"
            warnings.append(f"finger {i} stands {deep} deep in itself{more}")
        elif fingers[i, j] > thin[j] / 3 and (fingers[i, j] >= fingers[j, i] or i < j):
            warnings.append(f"finger {i} stands {deep} deep in finger {j}, more than a third of it")
    for f in np.flatnonzero(palm > DEEP):
        warnings.append(f"finger {f} stands {1e3 * palm[f]:.0f} mm deep in the palm")
    return warnings
