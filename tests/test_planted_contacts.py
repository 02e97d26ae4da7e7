"""Faults planted in the rings' stages and in contact between fingers: a check notices each.

As in `test_planted_faults.py`.  MuJoCo C has no rings, whose oracle is a dense solve with geometry,
Jacobians and friction cones of its own, minimised by SciPy; of spheres on fingers it is MuJoCo C.
All worlds start in one state, so that one solve is the oracle of all of them.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from codesign_jax.engines.structured import coordinates
from codesign_jax.engines.structured.forces import forces
from codesign_jax.engines.structured.kernel import memory_tables
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.placement import SlotCounts, at
from codesign_jax.engines.structured.kernel.ring_pairs import RingPairs
from codesign_jax.engines.structured.kernel.sides import Sides
from codesign_jax.engines.structured.lanewise import lanes, lanewise, of_code
from codesign_jax.engines.structured.laws import inertia
from codesign_jax.engines.structured.laws.rings import Place
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import layout
from tests.helpers import curled_hands, dense_steps, grasps
from tests.helpers.curled_hands import curled, kinds, on_palm
from tests.helpers.planted_faults import Fault, chosen, cone_of, planted, simulate

BOUND = 1e-8
"""As in test_steps.py."""
ITERATIONS = {"hull": 12, "spheres": 11, "vectors": 12}
"""Of Newton's method.  With many to spare a wrong matrix of the conjugate gradients would cost
iterations and change no result."""
SLOTS = 14
"""Between two fingers, and of a finger with itself and the palm."""

# Stages of the kernel: functions that it evaluates lane by lane.
FIELD = "ring_place"
AIM = "aim"
BETWEEN = "place_of"
LINE = "facing_line"
BALLS = "balls"
CANDIDATES = "as_candidates"
HELD = "_with_held"
HOLD = "sums.<locals>.add"
KEEP = "quotient"
RINGS_HELD = "with_held"
RINGS_HOLD = "_keep_of_list.<locals>.after"
TURN = "in_world"
RAY = "cost_along_line"
SLOPES = "slopes_along_line"
LOAD = "wrench_of_force"
LINK = "load_link"
ADD = "_add"
NEXT = "next acceleration"
"""A check of the second step, of a fault in what the first one leaves."""
TIMES = "symmetric_times"
AGAIN = "_again"
PALM_AGAIN = "solve_palm_again"


def place(stage, **wrong):
    """Wrong fields of a contact."""

    def change(right, *args):
        result = right(*args)
        return result._replace(**{name: f(getattr(result, name)) for name, f in wrong.items()})

    return Fault({stage: change})


def one_stiffness(right, first, *rest):
    """In the line search all contacts have the same stiffness."""
    if isinstance(first, Place):
        return right(first._replace(share=0 * first.share + 1), *rest)
    return right(0 * first + 1, *rest)


def unwanted(right, margin, where, cone, motion, velocity):
    """Accelerations over what is wanted as if nothing were."""
    contact, jar = right(margin, where, cone, motion, velocity)
    return contact, jar - right(margin, where, cone, 0 * motion, velocity)[1]


def at_rest(right, margin, where, cone, motion, velocity):
    """Contacts whose bodies have no velocity."""
    return right(margin, where, cone, motion, 0 * velocity)


def touched(right, margin, where, *rest):
    """Only what touches at the step's beginning is a contact."""
    contact, jar = right(margin, where, *rest)
    return contact._replace(share=jnp.where(contact.gap < 0, contact.share, 0.0)), jar


def half_gap(right, margin, where, *rest):
    """Gaps close when they are half as wide."""
    gap = jnp.where(where.gap > 0, 0.5 * where.gap, where.gap)
    return right(margin, where._replace(gap=gap), *rest)


def without_pairs(right, node, body, motion, smooth, pair):
    """Links do not feel contacts between fingers."""
    return right(node, body, motion, smooth, 0 * pair)


def added(*fields):
    """Contacts with object or table add nothing to these fields of the elimination."""

    def stage(right, node, *rest):
        return right(node, *rest)._replace(**{f: getattr(node, f) for f in fields})

    return Fault({ADD: stage})


def first_only(right, mine, self, row, which, fields):
    """The first contact of a row alone gets a slot."""
    right(self, row, which & ~(mine & (self.read("count", at(row)).lane > 0)), fields)


def not_emptied(right, mine, self, row):
    """The first slot stays as it was in the step before."""
    before = self.read("count", at(row)).lane
    right(self, row)
    kept = jnp.where(mine, jnp.minimum(before, 1.0), 0.0).astype(before.dtype)
    self.write("count", lanes([kept], (), wide=True), at(row))


def no_flag(right, mine, self):
    """Too few slots are not told."""
    flag = right(self)
    return jnp.where(mine, 0 * flag, flag)


def own_half(right, mine, self, contacts, item):
    """A relative motion without the other side's part."""
    motion = right(self, contacts, item)
    return chosen(mine, lanewise(lambda m: 0.5 * m, motion), motion)


def one_side(right, mine, self, contacts, item, field, more, *rest):
    """A finger does not feel the other side of its contact with itself, nor the palm fingers."""
    left = chosen(mine, lanewise(lambda m: 0 * m, more), more) if field == "other_side" else more
    right(self, contacts, item, field, left, *rest)


def pulled(right, *args):
    """Both sides of a sphere's contact with the palm are pushed the wrong way."""
    contact = right(*args)
    return contact._replace(normal=-contact.normal)


def first_ring(right, mine, self, contact, other, close, items):
    """The second finger's lane finds nothing."""
    right(self, contact, other, close & ~(mine & self.second), items)


def at_rest_there(right, mine, self, row, near):
    """The second finger's links do not move."""
    segment, moves = right(self, row, near)
    still = [lanewise(lambda m: 0 * m, v) for v in moves]
    return segment, [chosen(mine, a, b) for a, b in zip(still, moves, strict=True)]


def passed_over(right, mine, self, busy):
    """Contacts of a world that still iterates are passed over."""
    return right(self, busy & ~mine)


def on_parent(right, mine, self, row, which, owner, side, other, alike):
    """Contacts between fingers act on the link before theirs."""
    behind = lanewise(lambda r: jnp.maximum(r - 1, 0), side["side"])
    right(
        self, row, which, owner, side | {"side": chosen(mine, behind, side["side"])}, other, alike
    )


def same_way(right, mine, self, row, which, owner, side, other, alike):
    """Both fingers are pushed the same way."""
    other = other | {"normal": chosen(mine, side["normal"], other["normal"])}
    right(self, row, which, owner, side, other, alike)


def without_last(right, *args):
    """The last argument, velocities or forces, counts nothing."""
    return right(*args[:-1], jax.tree.map(lambda v: 0 * v, args[-1]))


SHORT = "a short finger"
"""A check of the first step of the state `short`, where no finger is as long as it is high."""
PAIRS = {
    "short fingers press on the palm": Fault(
        {"free_of_palm": lambda f, *a: 0 * f(*a) + 1}, check=SHORT
    ),
    # contacts between fingers, with spheres and with rings
    "both fingers are pushed the same way": Fault({}, methods={(ContactList, "enter"): same_way}),
    "contacts act on the link before": Fault({}, methods={(ContactList, "enter"): on_parent}),
    "the other finger does not feel the contact": Fault(
        {LOAD: lambda f, *a: jnp.zeros_like(f(*a))}, finger=1
    ),
    "links do not feel contacts between fingers": Fault({LINK: without_pairs}),
    "relative motion of one side": Fault({}, methods={(Sides, "relative"): own_half}),
    "half the Hessian between fingers": Fault({TIMES: lambda f, *a: 0.5 * f(*a)}),
    "conjugate gradients without forces on the object": Fault({PALM_AGAIN: without_last}),
    "conjugate gradients without forces on links": Fault({AGAIN: without_last}),
    # of all contacts
    "no reference acceleration": Fault({CANDIDATES: unwanted}),
    "contacts without velocity": Fault({CANDIDATES: at_rest}),
    "the object does not feel fingers": added("r_object"),
    "link and object apart": added("c"),
    "the object's matrix has no contacts": added("q"),
    "links do not feel the object": added("r"),
    "fingers rub each other as the object": cone_of("finger_finger", "finger_object"),
}
HULL = {
    # geometry and law
    "normals point inwards": place(FIELD, normal=jnp.negative),
    "normals between fingers point inwards": place(BETWEEN, normal=jnp.negative),
    "rings of one stiffness": place(FIELD, share=lambda v: 0 * v + 0.1),
    "rings of one stiffness between fingers": place(BETWEEN, share=lambda v: 0 * v + 0.1),
    "contacts beside the caps": place(FIELD, point=lambda v: 0.9 * v),
    "contacts beside the caps between fingers": place(BETWEEN, point=lambda v: 0.9 * v),
    "fields are looked at once": Fault({AIM: lambda f, *a: 0 * f(*a)}),
    "segments touch where they begin": Fault({LINE: without_last}),
    "what does not touch is no contact": Fault({CANDIDATES: touched}),
    "gaps close when they are half as wide": Fault({CANDIDATES: half_gap}),
    "a line search of one stiffness": Fault({RAY: one_stiffness, SLOPES: one_stiffness}),
    # one lane with both sides
    "one side of a contact alone": Fault({}, methods={(Sides, "_add_wrench"): one_side}),
    "the palm rubs as fingers do": cone_of("finger_palm", "finger_finger"),
    # state
    "fingers hold nothing": Fault({HELD: lambda f, jar, *rest: jar}, later=True),
    "fingers hold the other way": Fault({KEEP: lambda f, sums: -f(sums)}, NEXT),
    "fingers hold by one contact": Fault({HOLD: lambda f, sums, *rest: f(0 * sums, *rest)}, NEXT),
    "rings hold nothing": Fault({RINGS_HELD: lambda f, jar, *rest: jar}, later=True),
    "rings hold the other way": Fault({RINGS_HOLD: lambda f, *a: -f(*a)}, NEXT),
    "what rings hold does not turn": Fault({TURN: lambda f, columns, hold: hold}, later=True),
    # slots
    "a pairing has one slot": Fault({}, methods={(ContactList, "append"): first_only}),
    "a slot of the step before": Fault(
        {}, methods={(ContactList, "clear"): not_emptied}, later=True
    ),
    # where lanes gather; others pass through the slots of their block's other worlds as well
    "a world that iterates is passed over": Fault(
        {}, methods={(SlotCounts, "masked"): passed_over}
    ),
    "no flag for too few slots": Fault(
        {}, "overflow", methods={(ContactList, "overflow"): no_flag}
    ),
    **PAIRS,
}
SPHERES = {
    "the palm pulls": Fault({"ball_on_field": pulled}),
    "the palm does not feel fingers": Fault({}, methods={(Sides, "_add_wrench"): one_side}),
    "the palm rubs as fingers do": cone_of("finger_palm", "finger_finger"),
    "contacts between spheres in the centre": place(BALLS, point=lambda v: 0.9 * v),
    "spheres half as deep": place(BALLS, gap=lambda v: 0.5 * v),
    "normals between spheres point inwards": place(BALLS, normal=jnp.negative),
    **PAIRS,
}
VECTORS = {
    "every second ring is passed over": Fault({}, methods={(RingPairs, "_enter"): first_ring}),
    "rings turn at the wrong speed": Fault({}, methods={(RingPairs, "_segment"): at_rest_there}),
}
"""Of hulls whose lanes do not gather, as on a CPU."""
SURFACES = {"hull": HULL, "spheres": SPHERES, "vectors": VECTORS}
QUICK = ["hull", "spheres", pytest.param("vectors", marks=pytest.mark.slow)]  # 30 s
STATES = {
    "hull": {"main": (16, 0.95, 0.06), SHORT: (2, 0.6, 0.3, 0.012), "overflow": (1, 1.5, 0.045)},
    "spheres": {"main": (3, 1.9, 0.045), SHORT: (2, -1.2, 0.3, 0.012)},
    "vectors": {"main": (16, 0.95, 0.06), SHORT: (2, 0.6, 0.3, 0.012)},
}
"""Arguments of `curled`: seed, bend, height and length [m]. Contacts of every kind, none, and with
rings more than `SLOTS` of one kind."""


class Worlds(NamedTuple):
    """What the kernel made of the faults' worlds and, behind them, of sound ones of `STATES`.

    `solve` is the oracle's of qpos and qvel, `start` what it has of the state in which all start
    but the short fingers, whose accelerations are `short`.
    """

    faults: dict[str, Fault]
    outputs: dict[str, np.ndarray]
    solve: Callable
    start: tuple
    short: np.ndarray
    timestep: float

    def error(self, world, step=0, *, short=False):
        """Relative error of a step's accelerations."""
        qpos, qvel = (self.outputs[name][world, step:] for name in ("qpos", "qvel"))
        expected = self.solve(qpos[0], qvel[0], self.start[1])[0] if step else self.start[0]
        expected = self.short if short else expected
        acc = (qvel[1] - qvel[0]) / self.timestep
        return np.linalg.norm(acc - expected) / np.linalg.norm(expected)


def scene_of(surface):
    shape = "spheres" if surface == "spheres" else "hull"
    settings = {"effects__finger_finger": True, "effects__surface": shape}
    settings |= {"effects__palm_object": False, "effects__palm_table": False}
    settings |= {"effects__finger_palm": True}
    settings |= {"contact__finger_finger_friction": 0.6}  # neither the object's nor the palm's
    settings |= {"contact__finger_palm_friction": 0.4}
    if surface == "spheres":
        return grasps.pinch("sphere", links=2, discretization__spheres_per_link=2, **settings)
    settings |= {"effects__friction_memory": True, "effects__finger_itself": True}
    return grasps.pinch("sphere", links=8, **settings)


@functools.cache
def simulated(surface):
    """The worlds of a surface."""
    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        # Contacts of this depth make light links fast; the oracles' velocity products are MuJoCo's.
        patch.setattr(inertia, "share_of_products", lambda omega, *_: 1 + 0 * omega[0])
        of_code(None)
        scene = scene_of(surface)
        faults = SURFACES[surface]
        patch.setattr(memory_tables, "pair_slots", lambda _: SLOTS)
        if surface == "hull":  # as on a GPU; the others as on this CPU
            patch.setattr(memory_tables, "GATHERING", ("cpu", "gpu"))
        states = {name: curled(scene, *state) for name, state in STATES[surface].items()}
        checks = [f.check if f.check in states else "main" for f in faults.values()]
        each = [states[check] for check in [*checks, *states]]
        fields, qpos, qvel, ctrl = curled_hands.batched(each)
        with planted(faults):
            run = jax.jit(partial(simulate, scene, iterations=ITERATIONS[surface]))
            ctrl = jnp.asarray(np.repeat(ctrl[:, None], 3, 1))
            outputs = run(fields, (qpos, qvel), ctrl, np.arange(len(each)))
    of_code(None)
    solve = partial(solved, scene, *states["main"][:2])
    outputs = jax.tree.map(np.asarray, outputs)
    start = len(faults)
    start_grips = np.zeros(3), np.zeros((scene.num_fingers, 3)), {}
    start = solve(outputs["qpos"][start, 0], outputs["qvel"][start, 0], start_grips)
    assert surface != "spheres" or min(kinds(*states["main"][:2])) > 0
    assert surface != "spheres" or on_palm(*states["main"][:2]) > 0
    model, data, _ = states[SHORT]
    short = solved(scene, model, data, data.qpos.copy(), data.qvel.copy(), start_grips, 0.012)[0]
    return Worlds(faults, outputs, solve, start, short, scene.discretization.timestep)


def solved(scene, model, data, qpos, qvel, start_grips, length=0.1):
    """Accelerations by MuJoCo C, of rings by a dense solve; what fingers hold then; how they press.

    The last is a matrix of normal forces, of each finger and, in the last row, of the palm.
    """
    data.qpos[:] = qpos
    data.qvel[:] = qvel
    mujoco.mj_forward(model, data)
    if scene.effects.surface != "hull":
        return data.qacc.copy(), None, pressing(scene, model, data)
    with jax.enable_x64(True):
        hand, _ = grasps.hand_world(scene, length=length)
    dense = dense_steps.DensePairs(scene, model, data, hand, *start_grips)
    print(dense.num_hull, dense.pairs, dense.on_palm, dense.ahead, dense.itself)
    first = not np.any(start_grips[0]) and length == 0.1
    assert not first or min(dense.pairs, dense.on_palm, dense.itself, 4 * dense.ahead) > 3
    acceleration = dense.solve()
    grips = np.array([dense.next_grip(f) for f in range(scene.num_fingers)])
    holds = dense.next_holds()
    # Some contact of each kind holds something that the second step begins with.
    kinds = {name if isinstance(name, str) else name[2] for name, g in holds.items() if g.any()}
    assert not first or kinds >= {True, "lowest"}
    return (
        acceleration,
        (dense.next_grip(), grips, holds),
        dense.normal_forces(scene.num_fingers + 1),
    )


def pressing(scene, model, data):
    """MuJoCo's normal forces between fingers and, last, on the palm."""
    lay = layout(scene)
    pressed = np.zeros([scene.num_fingers + 1] * 2)
    sides = {body: f for f, row in enumerate(lay.bodies) for body in (*row, lay.stubs[f])}
    sides[model.body("palm").id] = -1
    for i in range(data.ncon):
        geoms = data.contact[i].geom
        force = np.zeros(6)
        ends = [sides.get(int(body)) for body in model.geom_bodyid[geoms]]
        mujoco.mj_contactForce(model, data, i, force)
        if None not in ends:
            pressed[*ends] += force[0]
            pressed[*ends[::-1]] += force[0]
    return pressed


@pytest.mark.slow  # 35 s; quick: the same worlds' accelerations
@pytest.mark.parametrize("surface", SURFACES)
def test_recorded_forces_are_the_oracle_s(surface):
    """How fingers press on one another, on themselves and on the palm, in the two steps."""
    worlds = simulated(surface)
    scene = scene_of(surface)
    sound = len(worlds.faults)
    fingers = scene.num_fingers
    names = [n for n in ("qpos", "qvel", "acc", "held") if n in worlds.outputs]
    state = [worlds.outputs[n][sound, :2] for n in names]
    with jax.enable_x64(True):
        fields = grasps.nth(curled(scene, *STATES[surface]["main"])[2], 0)
        fields = grasps.repeat(fields, 2)

        @jax.jit
        def run(fields, state):
            rows = coordinates.make(scene, *state)
            # No number of these scenes depends on the chambers' pressures.
            pressure = jnp.zeros((2, fingers))
            return forces(scene, world_constants(scene, fields), rows, pressure)

        recorded = jax.tree.map(np.asarray, run(fields, state))
    second = worlds.solve(state[0][1], state[1][1], worlds.start[1])
    for k, expected in enumerate((worlds.start[2], second[2])):
        largest = expected.max()
        np.testing.assert_allclose(
            recorded.finger_finger[k], expected[:-1, :-1], atol=1e-6 * largest
        )
        np.testing.assert_allclose(recorded.finger_palm[k], expected[-1, :-1], atol=1e-6 * largest)
        assert (expected[0, 1] > 0) and (expected[-1] > 0).any()
        assert np.diag(expected[:fingers, :fingers]).any() == (surface != "spheres")


@pytest.mark.parametrize("surface", QUICK)
def test_sound_worlds_equal_the_oracle(surface):
    """Two steps, and flags in the state that has too many contacts, and in no other."""
    worlds = simulated(surface)
    sound = len(worlds.faults)
    assert worlds.error(sound) < BOUND
    assert worlds.error(sound, 1) < 2 * BOUND  # see `ITERATIONS`
    assert not worlds.outputs["overflow"][sound].any()
    assert worlds.error(sound + 1, short=True) < BOUND
    assert not worlds.outputs["overflow"][sound + 1].any()
    if surface == "hull":
        assert (worlds.outputs["overflow"][sound + 2 :, 0] == 1).all()


@pytest.mark.parametrize(
    ("surface", "name"),
    [
        pytest.param(surface, name, marks=[pytest.mark.slow] if surface == "vectors" else [])
        for surface in SURFACES
        for name in SURFACES[surface]
    ],
)
def test_a_planted_fault_is_noticed(surface, name):
    """By a hundred times the bound, because nothing is left but NaN, or by a flag that lacks."""
    worlds = simulated(surface)
    fault = worlds.faults[name]
    world = [*worlds.faults].index(name)
    if fault.check in ("acceleration", NEXT):
        step = int(fault.later or fault.check == NEXT)
        assert not worlds.error(world, step) < 100 * BOUND
    elif fault.check == SHORT:
        assert not worlds.error(world, short=True) < 100 * BOUND
    else:
        assert worlds.outputs["overflow"][world, 0] == 0
