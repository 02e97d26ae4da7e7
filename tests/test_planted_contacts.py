"""Faults planted in the hull's stages and in contact between fingers: a check notices each.

As in `test_planted_faults.py`.  MuJoCo C has no hull, whose oracle is a dense solve with geometry,
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

from codesign_jax.engines.structured.kernel import tables
from codesign_jax.engines.structured.kernel.counts import Counts
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.slots import BoundSlots
from codesign_jax.engines.structured.lanewise import lanes, lanewise
from tests.helpers import curled_hands, dense_steps, grasps
from tests.helpers.curled_hands import curled, kinds
from tests.helpers.planted_faults import Fault, chosen, cone_of, planted, simulate

BOUND = 1e-8
"""As in test_kernel_pairs.py."""
ITERATIONS = 10
"""Of Newton's method: by then the sound hull errs by 1e-9 in its first step and 1e-8 in its second
one, and by 4e-10 with two more.  With many to spare a wrong matrix of the conjugate gradients would
cost iterations and change no result."""
SLOTS = 5
"""Of a row of the hull, and between two fingers: as many as the main state's fingers have contacts
with each other."""

# Stages of the kernel: functions that it evaluates lane by lane.
SURFACE, VERTEX = "sphere_on_object.<locals>.place", "placed"
LEVER = "Skin._vertex.<locals>.store.<locals>.<lambda>"
JAR, ROW, ADD_ROW = "BoundContacts.begin.<locals>.jar", "row_terms", "_add_row"
RAY, SLOPES = "BoundContacts.line.<locals>.ray", "BoundContacts._slopes.<locals>.both"
INSIDE, SUM, PRESSURE, BETWEEN = "inside", "add_vertex", "pressure", "between"
ENTER, LOAD = "Search._enter.<locals>.jar", "BoundPairs.load.<locals>.wrench"
ELIMINATE = "Elimination.backward.<locals>.eliminate"
HOLD, KEEP = "sums.<locals>.add", "quotient"
NEXT = "next acceleration"
"""A check of the second step, of a fault in what the first one leaves."""
TIMES, AGAIN, PALM_AGAIN = "_times", "_again", "Coupling._palm.<locals>.solve"


def ends(stage, **wrong):
    """Wrong fields of a contact on its own side, or with an underscore on the other one."""

    def change(right, *args):
        found = []
        for side, place in zip(("", "_"), right(*args), strict=True):
            names = [side + name for name in ("point", "normal", "gap", "lever", "share")]
            # Spheres have no lever and share.
            pairs = zip(names, place, strict=False)
            found.append(tuple(wrong.get(n, lambda v: v)(v) for n, v in pairs))
        return tuple(found)

    return Fault({stage: change})


def inwards(right, *args):
    point, normal, gap = right(*args)
    return point, -normal, gap


def vertex(**wrong):
    """Wrong image, weight or share of a vertex."""

    def stage(right, *args):
        names = ("point", "image", "weight", "share")
        pairs = zip(names, right(*args), strict=True)
        return tuple(wrong.get(name, lambda v: v)(v) for name, v in pairs)

    return Fault({VERTEX: stage})


def row(change):
    """Wrong terms of the joint, or matrix and wrench of the link, of a row of the hull."""
    return Fault({ROW: lambda right, *args: change(*right(*args))})


def node(*fields):
    """A row adds nothing to these fields of the elimination."""

    def stage(right, before, *rest):
        return right(before, *rest)._replace(**{f: getattr(before, f) for f in fields})

    return Fault({ADD_ROW: stage})


def one_area(right, place, *rest):
    """In the line search all vertices, whose last field is their share, are of one area."""
    return right((*place[:-1], 0 * place[-1] + 1) if len(place) in (2, 5) else place, *rest)


def alike(right, sums, mine, other):
    """Vertices in a section push alike, however deep they are."""
    point, normal, gap, lever, share = mine
    return right(sums, (point, normal, jnp.where(gap < 0, -1e-3, gap), lever, share), other)


def of_parts(right, sums):
    """The depth of a resultant is that of forces that all point the same way."""
    found = right(sums)
    depth = sums[1] / jnp.where(sums[0] > 0, sums[0], 1.0)
    return tuple((*p[:2], jnp.where(p[2] < 0, -depth, p[2]), *p[3:]) for p in found)


def unwanted(right, *args):
    """Of accelerations (..., motion, velocity) over what is wanted: as if nothing were."""
    *place, motion, velocity = args
    resting = right(*place, jax.tree.map(lambda m: 0 * m, motion), velocity)
    return jax.tree.map(jnp.subtract, right(*args), resting)


def eliminated(change):
    """Other forces of contacts between fingers on links and joints."""
    return Fault({ELIMINATE: lambda right, *args: right(*args[:-1], change(*args[-1]))})


def first_only(right, mine, self, row, which, fields, lane):
    right(self, row, which & ~(mine & (self.read("count", row).lane > 0)), fields, lane)


def not_emptied(right, mine, self, row):
    """The first of the hull's slots stays as it was in the step before."""
    before = self.read("count", row).lane
    right(self, row)
    if self.set.name.startswith("hull_"):
        kept = jnp.where(mine, jnp.minimum(before, 1.0), 0.0).astype(before.dtype)
        self.write("count", lanes([kept], (), wide=True), row)


def no_flag(name):
    """Too few slots of some contacts are not told."""

    def overflow(right, mine, self):
        found = right(self)
        return jnp.where(mine, 0 * found, found) if self.set.name.startswith(name) else found

    return Fault({}, f"overflow {name}", methods={(BoundSlots, "overflow"): overflow})


def without_grip(right, one, other, cone, held, *moves):
    """Contacts between fingers as if these held nothing on one another."""
    return right(one, other, cone, [0 * g for g in held], *moves)


def own_half(right, mine, self, item, pairing):
    """A relative motion without the other finger's part."""
    moved = right(self, item, pairing)
    return chosen(mine, lanewise(lambda m: 0.5 * m, moved), moved)


def passed_over(right, mine, self, busy):
    """Contacts of a world that still iterates are passed over."""
    return right(self, busy & ~mine)


def on_parent(right, mine, self, row, which, owner, one, other, numbers):
    """Contacts between fingers act on the link before theirs."""
    behind = lanewise(lambda r: jnp.maximum(r - 1, 0), numbers["row"])
    numbers = numbers | {"row": chosen(mine, behind, numbers["row"])}
    right(self, row, which, owner, one, other, numbers)


def without_last(right, *args):
    """The last argument, velocities or forces, counts nothing."""
    return right(*args[:-1], jax.tree.map(lambda v: 0 * v, args[-1]))


BOTH = {
    "both fingers are pushed the same way": partial(ends, _normal=jnp.negative),
    "normals between fingers point inwards": partial(
        ends, normal=jnp.negative, _normal=jnp.negative
    ),
}
PAIRS = {
    # contacts between fingers, with spheres and with the hull
    "the other finger does not feel the contact": Fault(
        {LOAD: lambda f, *a: jnp.zeros_like(f(*a))}, finger=1
    ),
    "no reference acceleration between fingers": Fault({ENTER: unwanted}),
    "contacts between fingers without velocity": Fault({ENTER: without_last}),
    "relative motion of one finger": Fault({}, methods={(BoundPairs, "relative"): own_half}),
    "half the Hessian between fingers": Fault({TIMES: lambda f, *a: 0.5 * f(*a)}),
    "conjugate gradients without forces on the object": Fault({PALM_AGAIN: without_last}),
}
HULL = {
    # wrong sign
    "normals of the hull point inwards": Fault({SURFACE: inwards}),
    "joints turn against the hull's forces": row(lambda t, m, w: (t._replace(y=-t.y), m, w)),
    # dropped terms
    "joints do not feel the hull": row(lambda t, m, w: (t._replace(y=0 * t.y), m, w)),
    "links do not feel the hull": row(lambda t, m, w: (t, m, 0 * w)),
    "the object does not feel the hull": node("r_object"),
    "no reference acceleration of the hull": Fault({JAR: unwanted}),
    "hull contacts without velocity": Fault({JAR: without_last}),
    "the hull's rows leave the object's matrix": node("q"),
    "the hull's rows leave link and object apart": node("c"),
    "joint and object apart": row(lambda t, m, w: (t._replace(h=0 * t.h), m, w)),
    # wrong weight, wrong reference point
    "vertices of one area": vertex(share=lambda v: 0 * v + 0.1),
    "a line search of one area": Fault({RAY: one_area, SLOPES: one_area}),
    "vertices follow the link before them": vertex(weight=jnp.zeros_like),
    "levers end at the vertex": Fault({LEVER: lambda f, w, i, c, x: w * i}),
    "levers without weight": Fault({LEVER: lambda f, w, i, c, x: i + c - x}),
    "sections push on one link": ends(INSIDE, _lever=jnp.zeros_like),
    "sections push beside the vertices": ends(PRESSURE, _lever=lambda v: 0.9 * v),
    "vertices in sections have all their area": ends(INSIDE, share=lambda v: 2 * v),
    "vertices in sections push alike": Fault({SUM: alike}),
    "a resultant as long as its parts": Fault({PRESSURE: of_parts}),
    # wrong cone
    "the table rubs the hull as the object does": cone_of("hull_table", "hull_object"),
    "fingers rub each other as the object": cone_of("finger_finger", "hull_object"),
    # state
    "fingers hold nothing": Fault({ENTER: without_grip}, later=True),
    "fingers hold the other way": Fault({KEEP: lambda f, sums: -f(sums)}, NEXT),
    "fingers hold by one contact": Fault({HOLD: lambda f, sums, *rest: f(0 * sums, *rest)}, NEXT),
    # slots
    "a row has one slot": Fault({}, methods={(BoundSlots, "add"): first_only}),
    "a slot of the step before": Fault(
        {}, methods={(BoundSlots, "clear"): not_emptied}, later=True
    ),
    # where lanes gather; others pass through the slots of their block's other worlds as well
    "a world that iterates is passed over": Fault({}, methods={(Counts, "masked"): passed_over}),
    "no flag for too few slots of the hull": no_flag("hull"),
    "no flag for too few slots between fingers": no_flag("finger_finger"),
    # elimination
    "joints do not feel contacts between fingers": eliminated(lambda w, turned: (w, 0 * turned)),
    "links do not feel contacts between fingers": eliminated(lambda w, turned: (0 * w, turned)),
    "conjugate gradients without forces on joints": Fault({AGAIN: without_last}),
    **{name: make(PRESSURE) for name, make in BOTH.items()},
    **PAIRS,
}
SPHERES = {
    "contacts between spheres in the centre": ends(BETWEEN, point=lambda v: 0.9 * v),
    "spheres half as deep": ends(BETWEEN, gap=lambda v: 0.5 * v, _gap=lambda v: 0.5 * v),
    "contacts act on the link before": Fault({}, methods={(BoundPairs, "enter"): on_parent}),
    "spheres rub each other as the object": cone_of("finger_finger", "finger_object"),
    "links do not feel contacts between spheres": eliminated(lambda w, turned: (0 * w, turned)),
    **{name: make(BETWEEN) for name, make in BOTH.items()},
    **PAIRS,
}
SURFACES = {"hull": HULL, "spheres": SPHERES}
MAIN = {"hull": (27, 1.2, 0.06), "spheres": (1, 1.2, 0.06)}
STATES = {"main": MAIN["hull"], "overflow hull": (0, 0.1, 0.04)}
STATES |= {"overflow finger_finger": (0, 1.2, 0.06)}
"""Arguments of `curled`: seed, bend and height [m]. Contacts of every kind, with the hull more than
`SLOTS` of one kind in the others."""


class Worlds(NamedTuple):
    """What the kernel made of the faults' worlds and of those that are sound.

    Attributes:
      faults: The faults by name; a sound world of each of `STATES` follows.
      found: The kernel's trace with its states.
      solve: Accelerations of the oracle, of qpos and qvel.
      start: The same of the state in which the worlds start, and what its fingers hold then.
      timestep: Of the scene [s].
    """

    faults: dict[str, Fault]
    found: dict[str, np.ndarray]
    solve: Callable
    start: tuple
    timestep: float

    def error(self, world, step=0):
        """Relative error of a step's accelerations."""
        qpos, qvel = (self.found[name][world, step:] for name in ("qpos", "qvel"))
        expected = self.solve(qpos[0], qvel[0], self.start[1])[0] if step else self.start[0]
        acc = (qvel[1] - qvel[0]) / self.timestep
        return np.linalg.norm(acc - expected) / np.linalg.norm(expected)


def scene_of(surface):
    settings = {"effects__finger_finger": True, "effects__surface": surface}
    settings |= {"effects__palm_object": False, "effects__palm_table": False}
    settings |= {"contact__finger_finger_friction": 0.6}  # not the object's
    if surface == "hull":
        settings |= {"discretization__hull_rings": 2, "discretization__hull_points": 4}
        settings |= {"effects__friction_memory": True}
    return grasps.pinch("sphere", links=2, **settings)


@functools.cache
def simulated(surface):
    """The worlds of a surface."""
    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        scene, faults = scene_of(surface), SURFACES[surface]
        patch.setattr(tables, "hull_slots", lambda _: SLOTS)
        patch.setattr(tables, "pair_slots", lambda _: SLOTS)
        if surface == "hull":  # as on a GPU; spheres, and the slow tests' hulls, as on this CPU
            patch.setattr(tables, "GATHERING", ("cpu", "gpu"))
        chosen = STATES | {"main": MAIN[scene.effects.surface]}
        states = {name: curled(scene, *state) for name, state in chosen.items()}
        kinds = [f.check if f.check in states else "main" for f in faults.values()]
        each = [states[kind] for kind in [*kinds, *states]]
        fields, qpos, qvel, ctrl = curled_hands.batched(each)
        with planted(faults):
            run = jax.jit(partial(simulate, scene, iterations=ITERATIONS))
            ctrl = jnp.asarray(np.repeat(ctrl[:, None], 3, 1))
            found = run(fields, (qpos, qvel), ctrl, np.arange(len(each)))
    solve = partial(solved, scene, *states["main"][:2])
    found, start = jax.tree.map(np.asarray, found), len(faults)
    start = solve(found["qpos"][start, 0], found["qvel"][start, 0], np.zeros(3))
    return Worlds(faults, found, solve, start, scene.discretization.timestep)


def solved(scene, model, data, qpos, qvel, grip):
    """Accelerations by MuJoCo C, with the hull by a dense solve; and what its fingers hold then."""
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    if scene.effects.surface != "hull":
        assert min(kinds(model, data)) > 0
        return data.qacc.copy(), None
    with jax.enable_x64(True):
        hand, _ = grasps.hand_world(scene, length=0.1)
    dense = dense_steps.DensePairs(scene, model, data, hand, grip)
    assert dense.num_hull > 20 and dense.pairs > 4 and dense.merged > 4
    return dense.solve(), dense.next_grip()


@pytest.mark.parametrize("surface", SURFACES)
def test_sound_worlds_equal_the_oracle(surface):
    """Two steps, and flags in the hull's states that have too many contacts, and in no other."""
    worlds = simulated(surface)
    sound = len(worlds.faults)
    assert worlds.error(sound) < BOUND
    assert worlds.error(sound, 1) < 2 * BOUND  # see `ITERATIONS`
    assert not worlds.found["overflow"][sound].any()
    if surface == "hull":
        assert (worlds.found["overflow"][sound + 1 :, 0] == 1).all()


@pytest.mark.parametrize(
    ("surface", "name"), [(surface, name) for surface in SURFACES for name in SURFACES[surface]]
)
def test_a_planted_fault_is_noticed(surface, name):
    """By a hundred times the bound, because nothing is left but NaN, or by a flag that lacks."""
    worlds = simulated(surface)
    fault, world = worlds.faults[name], [*worlds.faults].index(name)
    if fault.check in ("acceleration", NEXT):
        step = int(fault.later or fault.check == NEXT)
        assert not worlds.error(world, step) < 100 * BOUND
    else:
        assert worlds.found["overflow"][world, 0] == 0
