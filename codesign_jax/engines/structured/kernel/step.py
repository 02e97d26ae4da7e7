"""One time step of a block of worlds, inside the kernel."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import collision, inertia
from codesign_jax.engines.structured import kinematics as kin
from codesign_jax.engines.structured.constants import apply_columns
from codesign_jax.engines.structured.inertia import Body
from codesign_jax.engines.structured.integration import integrate, rigid_arm
from codesign_jax.engines.structured.kernel import objects
from codesign_jax.engines.structured.kernel.contacts import (
    sphere_on_object,
    sphere_on_table,
    zeros,
)
from codesign_jax.engines.structured.kernel.fingers import Search
from codesign_jax.engines.structured.kernel.hull import Side, Skin
from codesign_jax.engines.structured.kernel.memory import Block, loop
from codesign_jax.engines.structured.kernel.newton import (
    Iterate,
    Memory,
    Newton,
    Palm,
    relative,
    triangle,
)
from codesign_jax.engines.structured.kernel.objects import WorldObject
from codesign_jax.engines.structured.kernel.pairs import BoundPairs
from codesign_jax.engines.structured.kernel.slots import BoundSlots
from codesign_jax.engines.structured.kinematics import State
from codesign_jax.engines.structured.lanes import total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.problem import next_motion, object_motion, palm_motion

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.program import Program


class Step:
    """One time step of a block."""

    def __init__(
        self,
        program: "Program",
        block: Block,
        hand: Any,
        world: Any,
        finger_state: Any,
        world_state: Any,
        scratch: Any,
        grid: Any = None,
    ):
        """Takes the kernel's lanes and memory; grid: distances of all meshes, if there are any."""
        self.p, self.block, self.hand, self.world = program, block, hand, world
        self.finger_state, self.world_state, self.scratch = finger_state, world_state, scratch
        self.grid = grid

    def constant(self, name: str) -> Lanes:
        """A constant of the worlds."""
        return self.p.world.read(self.world, name, 0, self.block.world)

    def constants(self, *names: str) -> list[Lanes]:
        """Constants of the worlds."""
        return [self.constant(n) for n in names]

    def gravity(self) -> Lanes | None:
        """Magnitude of gravity; None without the effect."""
        return self.constant("gravity") if "gravity" in self.p.world.groups else None

    def advance(self, arm: Lanes, pressure: Lanes, undecided: Callable, waiting: Any, speed: Any):
        """Advances the block.

        Args:
          arm: Commands of the arm frame, shape (6, 1, world).
          pressure: Chamber pressures, lanes.
          undecided: Whether a world takes this step, from distance and height before it.
          waiting: Undecided worlds, which must converge.
          speed: Largest velocity before the step.

        Returns:
          Trace entries distance, height, residual, iterations and, with slots, overflow; speed
          after the step; worlds that have moved, and so go on.
        """
        p, scene = self.p, self.p.scene
        state = {
            n: p.world_state.read(self.world_state, n, 0, self.block.world)
            for n in p.world_state.groups
        }
        geometry = self._palm(state, arm)
        hand, world = (p.hand, self.hand), (p.world, self.world)
        thing = objects.read(scene, self.block, world, hand, self.grid)
        bound = {c.name: c.bind(p.scratch, self.scratch, self.constant) for c in p.sets}
        memory = Memory(
            p.hand, self.hand, p.finger_state, self.finger_state, p.scratch, self.scratch, bound
        )
        now, centre = self._forward(state, geometry, pressure, memory, thing)
        rigid = not scene.effects.wrist
        newton = Newton(p.links, self.block, memory, geometry["palm"], rigid=rigid)
        now, quality = newton.solve(now, waiting, *p.limits)
        distance = lanewise(_distance, state["position"], state["wrist"], centre).lane
        height = state["position"][2].lane
        goes_on, slots = waiting & undecided(distance, height), []
        if p.slotted:
            slots = [self._overflow(bound, waiting)]
            goes_on &= slots[0] == 0
        new_speed, good = self._integrate(state, geometry, now, goes_on, speed)
        count = jnp.full_like(height, quality.count)
        # Residuals of decided worlds are reported as 0; no iterations are spent on them.
        residual = jnp.where(waiting, quality.residual.lane, 0.0)
        return (distance, height, residual, count, *slots), new_speed, good

    def _overflow(self, bound: dict[str, Any], waiting: jax.Array) -> jax.Array:
        """One for worlds that had too few slots for their contacts in this step, else zero."""
        lists = [c.overflow() for c in bound.values() if isinstance(c, BoundSlots)]
        most = self.block.fold(total(lists), jnp.maximum)
        return jnp.where(waiting & (most > 0), 1.0, 0.0).astype(most.dtype)

    def _palm(self, state: dict, arm: Lanes) -> dict[str, Any]:
        """Kinematics, inertia and smooth forces of palm, wrist and object."""
        names = ("palm_mass", "palm_centre", "palm_inertia", "wrist_damping", "wrist_armature")
        constants = self.constants(*names, "object_mass", "object_inertia")
        constants += [self.constant("wrist_stiffness") if self.p.scene.effects.wrist else None]
        constants += [self.gravity()]
        wrist, h = self.p.scene.effects.wrist, self.p.scene.discretization.timestep

        def compute(state, arm, mass, centre, tensor, damping, armature, obj, principal, k, g):
            frame, axes, vel, bias = kin._wrist(state["wrist"], state["wrist_vel"])
            s = State(**{k: state.get(k) for k in State._fields})
            columns, position, object_vel = kin._object(s)
            turned = inertia.turned_tensor(frame, tensor)
            palm = Body(mass, apply_columns(frame, centre), turned)
            thing = Body(obj, position, inertia.principal_tensor(columns, principal))
            spring = -damping * state["wrist_vel"]
            if k is not None:
                spring = k * (arm - state["wrist"]) + spring
            acc = state["acc_wrist"], state["acc_object"]
            if not wrist:
                acc = rigid_arm(arm, state["wrist"], state["wrist_vel"], h), acc[1]
            motions = palm_motion(acc[0], axes), object_motion(acc[1], position)
            return {
                "frame": frame,
                "vel": vel,
                "bias": bias,
                "columns": columns,
                "object_vel": object_vel,
                "now": Iterate(*acc, *motions),
                "palm": Palm(
                    palm,
                    thing,
                    palm.smooth_force(vel, bias, g),
                    inertia.object_force(thing, object_vel, g),
                    spring,
                    armature,
                    axes,
                    position,
                ),
            }

        return lanewise(compute, state, arm, *constants)

    def _forward(self, state: dict, at: dict, pressure: Lanes, m: Memory, thing: WorldObject):
        """Bodies, forces and contacts from the palm to the tips, left in the scratch table.

        Returns:
          The warm start and the hand's centre in the palm's frame.
        """
        p, now = self.p, at["now"]
        like = jnp.zeros((p.size,), self.finger_state.dtype)
        mount, base, share, stub = (
            p.hand.read(self.hand, n) for n in ("mount", "base", "share", "stub_centre")
        )
        frame, origin = lanewise(kin._mount, at["frame"], mount, base)
        weight = lanewise(lambda f, s, share: share * apply_columns(f, s), at["frame"], stub, share)
        wide, gravity = zeros((6,), like), self.gravity()
        vel, bias, motion = (
            lanewise(jnp.add, v, wide) for v in (at["vel"], at["bias"], now.palm_motion)
        )

        pairs = m.contacts.get("finger_finger")
        search = Search(self, pairs) if isinstance(pairs, BoundPairs) else None
        if search:
            search.start(motion, vel, frame, origin)
        skin = Skin(self, at, m, thing) if any(n.startswith("hull_") for n in m.contacts) else None

        def link(i: Any, carry: tuple) -> tuple:
            origin, frame, vel, bias, motion, middle = carry
            before = Side(frame, motion, vel)
            names = ("offset", "mass", "centre", "inertia", "stiffness", "damping")
            constants = [p.hand.read(self.hand, n, i) for n in names]
            gain = p.hand.read(self.hand, "gain")
            soft = p.scene.effects.neo_hookean
            section = p.hand.read(self.hand, "section") if soft else None
            forces = gain, pressure, section, gravity
            joint = [
                p.finger_state.read(self.finger_state, n, i)
                for n in ("finger", "finger_vel", "acc")
            ]
            out = lanewise(
                partial(_link, self.p.lay.axes),
                (origin, frame, vel, bias, motion),
                constants,
                joint,
                forces,
            )
            carry, stored = out
            stored |= {"step_acc": zeros((p.axes,), like), "step_motion": wide}
            for name, value in stored.items():
                m.scratch.write(self.scratch, name, value, i)
            share = p.hand.read(self.hand, "share", i + 1)
            middle = lanewise(lambda m, c, s: m + s * c, middle, stored["body_centre"], share)
            self._finger_contacts(i, carry, at, m, thing)
            if search:
                search.link(i, carry[4], carry[2], carry[1], carry[0])
            if skin:
                skin.row(i, carry[0], before, Side(carry[1], carry[4], carry[2]))
            return (*carry, middle)

        start = (origin, frame, vel, bias, motion, weight)
        origin, frame, vel, _, motion, middle = loop(p.links, link, start, p.size)
        if skin:
            tip = Side(frame, motion, vel)
            skin.row(p.links, origin, tip, tip)
        if search:
            search.find()
        self._slot_contacts(state, at, m, thing)
        count = p.num_fingers * p.links
        middle = self.block.sum(middle)
        return now, lanewise(lambda c: c / count, middle)

    def _finger_contacts(
        self, i: Any, carry: tuple, at: dict, m: Memory, thing: WorldObject
    ) -> None:
        p, now = self.p, at["now"]
        if not p.k:
            return
        origin, frame, vel, _, motion = carry
        sphere, radius = (p.hand.read(self.hand, n, i) for n in ("sphere", "radius"))
        centre = lanewise(
            lambda o, f, s: o[:, None] + apply_columns(f[:, :, None], s), origin, frame, sphere
        )
        for name in ("finger_object", "finger_table"):
            if name in m.contacts:
                geometry = self.geometry(name, centre, radius, at, thing)
                moves = (
                    relative(name, motion, now.palm_motion, now.object_motion),
                    relative(name, vel, at["vel"], at["object_vel"]),
                )
                m.contacts[name].create(i, geometry, *moves)

    def geometry(self, name: str, centre: Lanes, radius: Any, at: dict, thing: WorldObject):
        """Point, normal and gap of spheres of the hand against the object or the table."""
        scene = self.p.scene
        if name.endswith("_object"):
            place = at["columns"], at["palm"].position
            return sphere_on_object(scene, thing, *place, centre, radius)
        height = self.p.world_state.read(self.world_state, "wrist", 0, self.block.world)[2]
        return lanewise(sphere_on_table, height, centre, radius)

    def _slot_contacts(self, state: dict, at: dict, m: Memory, thing: WorldObject) -> None:
        p, now = self.p, at["now"]

        def create(name: str, i: Any, geometry: Any) -> None:
            moves = (
                relative(name, None, now.palm_motion, now.object_motion),
                relative(name, None, at["vel"], at["object_vel"]),
            )
            m.contacts[name].create(i, geometry, *moves)

        palm = [name for name in ("palm_object", "palm_table") if name in m.contacts]
        for i in range(p.palm_groups if palm else 0):
            point, radius = (p.hand.read(self.hand, n, i) for n in ("palm_point", "palm_radius"))
            centre = lanewise(lambda f, s: apply_columns(f[:, :, None], s), at["frame"], point)
            for name in palm:
                create(name, i, self.geometry(name, centre, radius, at, thing))
        on_table = m.contacts.get("object_table")
        slots = self._table_points(state, at, thing) if on_table else []
        for i in range(on_table.set.count if on_table else 0):
            part = [slots[k] for k in range(i * p.fingers, min((i + 1) * p.fingers, len(slots)))]
            create("object_table", i, self._deal(part))

    def _table_points(self, state: dict, at: dict, thing: WorldObject) -> list[tuple]:
        """Point, normal and gap of each slot of the object on the table, lanes of a world."""
        height, position = state["wrist"][2], at["palm"].position
        arms = objects.table_points(self.p.scene, thing, at["columns"], position, height)

        def compute(position, arms, height):
            point, normal, gap = collision.on_table(position, arms, height)
            return [
                (point[:, k : k + 1], normal[:, k : k + 1], gap[None, k : k + 1])
                for k in range(gap.shape[0])
            ]

        return lanewise(compute, position, arms, height)

    def _deal(self, slots: list[tuple]) -> tuple[Lanes, Lanes, Lanes]:
        """Deals the slots (component, 1, world) out to the finger lanes."""
        p = self.p
        away = jnp.full((p.size,), 1e3, self.finger_state.dtype)
        dealt = []
        for field in range(3):
            values = [s[field] for s in slots]
            parts = []
            for c in range(values[0].parts.shape[0]):
                lane = away
                for k, value in enumerate(values):
                    lane = jnp.where(self.block.finger == k, value.parts[c].item(), lane)
                parts.append(lane)
            dealt.append(lanes(parts, (len(parts), 1), wide=True))
        return tuple(dealt)  # type: ignore[return-value]

    def _integrate(self, state: dict, at: dict, now: Iterate, goes_on: Any, speed: Any):
        """Semi-implicit Euler; worlds that are decided or whose step fails stay as they were.

        Returns:
          Largest velocity after the step, and whether the world has moved, shapes (1, world).
        """
        p, h = self.p, self.p.scene.discretization.timestep
        new = lanewise(partial(_moved, h), state, at["columns"], now.wrist, now.object)
        size = lanewise(_largest, new)

        def link(i: Any, largest: Lanes) -> Lanes:
            q, rate, acc = (
                p.finger_state.read(self.finger_state, n, i)
                for n in ("finger", "finger_vel", "acc")
            )
            rate, q, top = lanewise(partial(_turned, h), q, rate, acc)
            p.scratch.write(self.scratch, "new_finger", q, i)
            p.scratch.write(self.scratch, "new_finger_vel", rate, i)
            return lanewise(_worse, largest, top)

        like = jnp.zeros((p.size,), self.finger_state.dtype)
        fingers = loop(p.links, link, zeros((), like), p.size).lane
        largest = _worse(size.lane, self.block.fold(fingers, _worse))
        limit = self.constant("speed").lane
        good = goes_on & (largest <= limit)
        acc = {"acc_wrist": now.wrist, "acc_object": now.object}
        for name, value in {**new, **acc}.items():
            kept = lanewise(jnp.where, lanes([good], (), wide=False), value, state[name])
            p.world_state.write(self.world_state, name, kept, 0, self.block.world)

        def store(i: Any, x: Any) -> Any:
            for name in ("finger", "finger_vel"):
                value = p.scratch.read(self.scratch, f"new_{name}", i)
                old = p.finger_state.read(self.finger_state, name, i)
                kept = lanewise(jnp.where, lanes([good], (), wide=False), value, old)
                p.finger_state.write(self.finger_state, name, kept, i)
            return x

        jax.lax.fori_loop(0, p.links, store, jnp.int32(0))
        return jnp.where(goes_on, largest, speed), good


def _link(names: tuple[str, ...], parent, constants, joint, forces):
    """A link's kinematics, inertia and forces."""
    gain, pressure, section, gravity = forces
    origin, frame, vel, bias, motion = parent
    offset, mass, centre, principal, stiffness, damping = constants
    q, rate, acc = joint
    cos, sin = jnp.cos(q), jnp.sin(q)
    origin, frame, axes = kin._turn_link(names, origin, frame, offset, cos, sin)
    vel, bias = kin._link_velocity(vel, bias, axes, rate)
    motion = next_motion(motion, axes, acc)
    body = Body(
        mass,
        origin + apply_columns(frame, centre),
        inertia.principal_tensor(frame, principal),
    )
    tau = -stiffness * q - damping * rate
    bend = tau[:1] + gain * pressure
    if section is not None:
        bend = bend + inertia.softening_moment(section, stiffness[:1], q[:1])
    tau = jnp.concatenate([bend, tau[1:]])
    stored = {
        "axes": axes,
        "body_centre": body.centre,
        "tensor": triangle(body.tensor),
        "motion": motion,
        "smooth": body.smooth_force(vel, bias, gravity),
        "tau": tau,
    }
    return (origin, frame, vel, bias, motion), stored


def _distance(position, wrist, centre):
    away = position - wrist[:3] - centre
    return jnp.sqrt(total([away[i] ** 2 for i in range(3)]))


def _moved(h: float, state: dict, columns, wrist, obj) -> dict:
    """Wrist and object after the step."""
    names = ("wrist", "position", "quat", "wrist_vel", "linear_vel", "angular_vel")
    # The fingers' joints are moved link by link, see `_turned`.
    old = State(finger=0.0, finger_vel=0.0, acc=None, **{n: state[n] for n in names})  # type: ignore[arg-type]
    new = integrate(old, columns, kin.Acc(wrist, 0.0, obj), h)  # type: ignore[arg-type]
    return {n: getattr(new, n) for n in names}


def _worse(a: jax.Array, b: jax.Array) -> jax.Array:
    """The larger one, or what is not finite."""
    return jnp.where((b > a) | (b != b), b, a)


def _largest(new: dict):
    velocities = [new[n] for n in ("wrist_vel", "linear_vel", "angular_vel")]
    top = jnp.abs(velocities[0][0])
    for value in velocities:
        for i in range(value.shape[0]):
            top = _worse(top, jnp.abs(value[i]))
    places = [new["wrist"][i] for i in range(6)] + [new["position"][i] for i in range(3)]
    place = total(places + [new["quat"][i] for i in range(4)])
    return jnp.where(place == place, top, place)


def _turned(h: float, q, rate, acc):
    rate = rate + h * acc
    q = q + h * rate
    top = jnp.abs(rate[0])
    for k in range(1, rate.shape[0]):
        top = _worse(top, jnp.abs(rate[k]))
    return rate, q, top
