"""The whole rollout as one GPU kernel: a block simulates a few worlds from start to end.

A lane is a finger of a world, a block one warp.  Blocks do not wait for each other: each does the
Newton iterations that its own worlds need, and stops when they are all decided.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl

from codesign_jax.engines.structured import collision, inertia
from codesign_jax.engines.structured import kinematics as kin
from codesign_jax.engines.structured.engine import _turn
from codesign_jax.engines.structured.fused.contacts import (
    ContactSet,
    sphere_on_object,
    sphere_on_table,
    zeros,
)
from codesign_jax.engines.structured.fused.launch import launch
from codesign_jax.engines.structured.fused.newton import (
    Iterate,
    Memory,
    Newton,
    Palm,
    loop,
    relative,
    triangle,
)
from codesign_jax.engines.structured.fused.ptx import LANES
from codesign_jax.engines.structured.fused.tables import Block, Table, anywhere
from codesign_jax.engines.structured.hand import HandLanes, apply_columns
from codesign_jax.engines.structured.inertia import Body
from codesign_jax.engines.structured.kinematics import State
from codesign_jax.engines.structured.lanes import cross, spatial, total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.model import layout
from codesign_jax.model.layout import palm_points
from codesign_jax.scene import Scene

TRACE = ("distance", "height", "speed", "residual", "iterations")


class Limits(NamedTuple):
    """How hard each step is solved.

    Attributes:
      iterations: Largest number of Newton iterations.
      evaluations: Largest number of line-search evaluations of an iteration.
      tolerance: Relative Newton decrement at which a world has converged.
    """

    iterations: int
    evaluations: int
    tolerance: float


class Program:
    """Tables and kernel of a scene's rollout for one size of block."""

    def __init__(self, scene: Scene, limits: Limits, *, block: int | None = None):
        """Lays out the memory.

        Args:
          scene: The scene.
          limits: How hard each step is solved.
          block: Worlds of a block, a power of two; by default as many as fill a warp.
        """
        self.scene, self.limits, self.lay = scene, limits, layout(scene)
        n, self.links, self.axes = self.lay.dofs.shape
        self.fingers = 1 << (n - 1).bit_length()
        self.num_fingers, self.block = n, block or LANES // self.fingers
        self.size = self.fingers * self.block
        self.k = self.lay.spheres.shape[-1] if self.lay.spheres.size else 0
        self.palm_groups = -(-len(palm_points(scene)) // self.fingers)
        self.sets = self._sets()
        self._tables()

    def _sets(self) -> list[ContactSet]:
        e, k = self.scene.effects, self.k
        make = partial(ContactSet, self.scene, size=self.size)
        sets = []
        if k and e.finger_object:
            sets.append(make("finger_object", self.links, k))
        if k and e.finger_table:
            sets.append(make("finger_table", self.links, k))
        if e.palm_contact:
            sets += [make(n, self.palm_groups, 1) for n in ("palm_object", "palm_table")]
        return [*sets, make("object_table", -(-4 // self.fingers), 1)]

    def _tables(self) -> None:
        n, a = self.links, self.axes
        one: tuple[int, ...] = ()
        spheres = {"sphere": (n, (3, self.k)), "radius": (n, (self.k,))} if self.k else {}
        if self.scene.effects.palm_contact:
            spheres |= {
                "palm_point": (self.palm_groups, (3, 1)),
                "palm_radius": (self.palm_groups, (1,)),
            }
        self.hand = Table(
            True,
            mount=(1, (3, 3)),
            base=(1, (3,)),
            stub_centre=(1, (3,)),
            share=(n + 1, one),
            gain=(1, one),
            offset=(n, one),
            mass=(n, one),
            centre=(n, (3,)),
            inertia=(n, (3,)),
            stiffness=(n, (a,)),
            damping=(n, (a,)),
            armature=(n, (a,)),
            **spheres,
        )
        self.world = Table(
            False,
            palm_mass=(1, one),
            palm_centre=(1, (3,)),
            palm_inertia=(1, (3, 3)),
            wrist_damping=(1, (6,)),
            wrist_armature=(1, (6,)),
            object_mass=(1, one),
            object_inertia=(1, (3,)),
            object_size=(1, (3,)),
            shape=(1, one),
            alive=(1, one),
        )
        self.fine = Table(True, finger=(n, (a,)), finger_vel=(n, (a,)), acc=(n, (a,)))
        rest = dict(wrist=6, position=3, quat=4, wrist_vel=6, linear_vel=3, angular_vel=3)
        rest |= dict(acc_wrist=6, acc_object=6)
        self.rest = Table(False, **{name: (1, (size,)) for name, size in rest.items()})
        fields: dict[str, tuple[int, tuple[int, ...]]] = {
            "axes": (n, (a, 6)),
            "body_centre": (n, (3,)),
            "tensor": (n, (6,)),
            "motion": (n, (6,)),
            "smooth": (n, (6,)),
            "tau": (n, (a,)),
            "w": (n, (a, 6)),
            "g": (n, (a, 6)),
            "z": (n, (a,)),
            "step_acc": (n, (a,)),
            "step_motion": (n, (6,)),
            "sums": (1, (96,)),
            "new_finger": (n, (a,)),
            "new_finger_vel": (n, (a,)),
        }
        for contacts in self.sets:
            fields |= contacts.groups()
        self.scratch = Table(True, **fields)

    def pack_hand(self, hand: HandLanes) -> tuple[jax.Array, jax.Array]:
        """The hand's tables; padded worlds are not alive, padded fingers have no mass."""
        worlds, n = hand.shape.shape[1], self.num_fingers
        dtype, lane = hand.mass.dtype, (n, worlds)
        links_first = ("centre", "inertia", "sphere")
        arrays = {
            k: jnp.moveaxis(v, 1, 0) if k in links_first and v.size else v
            for k, v in hand._asdict().items()
        }
        # Weights of the segments in the hand's centre: half segments at the palm and at the tip.
        share = jnp.ones((self.links + 1, *lane), dtype)
        arrays["share"] = share.at[jnp.array([0, self.links])].set(0.5)
        if self.scene.effects.palm_contact:
            arrays |= self._palm_slots(worlds, dtype)
        extra = self.fingers - n
        if extra:
            for name in ("share", "mass", "inertia", "gain"):
                pad = [(0, 0)] * (arrays[name].ndim - 2) + [(0, extra), (0, 0)]
                arrays[name] = jnp.pad(arrays[name], pad)
            if self.k:
                pad = [(0, 0)] * (hand.radius.ndim - 2) + [(0, extra), (0, 0)]
                arrays["radius"] = jnp.pad(hand.radius, pad, constant_values=-1e3)
        wide = {k: self._widen(arrays[k]) for k in self.hand.groups}
        arrays["alive"] = jnp.ones((1, worlds), dtype)
        arrays["shape"] = hand.shape.astype(dtype)
        narrow = {k: arrays[k] for k in self.world.groups}
        packed = self.world.pack(1, self.block, **narrow)
        ids = jnp.arange(packed.shape[0] * self.block).reshape(-1, self.block)
        alive = self.world.offset["alive"]
        packed = packed.at[:, alive].multiply(ids < worlds)
        return self.hand.pack(self.fingers, self.block, **wide), packed

    def _widen(self, array: jax.Array) -> jax.Array:
        """Fingers up to a power of two."""
        pad = [(0, 0)] * (array.ndim - 2) + [(0, self.fingers - array.shape[-2]), (0, 0)]
        return jnp.pad(array, pad, mode="edge")

    def _palm_slots(self, worlds: int, dtype: Any) -> dict[str, jax.Array]:
        """The palm's contact spheres, shared out among the lanes."""
        points, f, g = palm_points(self.scene), self.fingers, self.palm_groups
        padded = np.zeros((g * f, 3))
        padded[: len(points)] = points
        radius = np.full(g * f, -1e3)
        radius[: len(points)] = self.scene.hand.palm.contact_radius
        place = jnp.asarray(padded.reshape(g, f, 3).transpose(0, 2, 1), dtype)[:, :, None, :, None]
        size = jnp.asarray(radius.reshape(g, 1, f, 1), dtype)
        return {
            "palm_point": jnp.broadcast_to(place, (g, 3, 1, f, worlds)),
            "palm_radius": jnp.broadcast_to(size, (g, 1, f, worlds)),
        }

    def pack_state(self, state: State) -> tuple[jax.Array, jax.Array]:
        """The state's tables."""
        arrays = state._asdict() | {"acc_wrist": state.acc.wrist, "acc_object": state.acc.object}
        fine = {"finger": state.finger, "finger_vel": state.finger_vel, "acc": state.acc.finger}
        wide = {k: self._widen(v) for k, v in fine.items()}
        narrow = {k: arrays[k] for k in self.rest.groups}
        return self.fine.pack(self.fingers, self.block, **wide), self.rest.pack(
            1, self.block, **narrow
        )

    def pack_controls(self, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Commands: arm (block, time, 6, world) and pressure (block, time, lane)."""
        worlds, steps, _ = ctrl.shape
        ctrl = jnp.pad(ctrl, [(0, -worlds % self.block), (0, 0), (0, 0)], mode="edge")
        blocks = jnp.moveaxis(ctrl.reshape(-1, self.block, steps, ctrl.shape[2]), 1, 3)
        arm, pressure = blocks[:, :, :6], blocks[:, :, 6:]
        pad = [(0, 0)] * 2 + [(0, self.fingers - self.num_fingers), (0, 0)]
        return arm, jnp.pad(pressure, pad).reshape(*arm.shape[:2], self.size)

    def run(
        self, hand: HandLanes, state: State, ctrl: jax.Array, *, interpret: bool = False
    ) -> dict[str, jax.Array]:
        """Runs a rollout; returns `TRACE` by name, shape (world, time)."""
        inputs = (*self.pack_hand(hand), *self.pack_state(state), *self.pack_controls(ctrl))
        blocks, steps, dtype = inputs[0].shape[0], ctrl.shape[1], ctrl.dtype
        shapes = [
            (blocks, self.fine.rows, self.size),
            (blocks, self.rest.rows, self.block),
            (blocks, self.scratch.rows, self.size),
            (blocks, steps, len(TRACE), self.block),
        ]

        def spec(shape: tuple[int, ...]) -> pl.BlockSpec:
            return pl.BlockSpec((None, *shape[1:]), lambda i: (i, *[0] * (len(shape) - 1)))

        outputs = [jax.ShapeDtypeStruct(s, dtype) for s in shapes]
        call = pl.pallas_call(
            partial(self._kernel, steps, interpret),
            grid=(blocks,),
            in_specs=[spec(x.shape) for x in inputs],
            out_specs=[spec(s) for s in shapes],
            out_shape=outputs,
            interpret=interpret,
            name="grasp",
        )
        out = call(*inputs) if interpret else launch(call, inputs, outputs)
        trace = jnp.moveaxis(out[3], 3, 1)  # (block, world, time, entry)
        trace = trace.reshape(-1, steps, len(TRACE))[: ctrl.shape[0]]
        return {name: trace[..., k] for k, name in enumerate(TRACE)}

    def _kernel(self, steps: int, interpret: bool, *refs: Any) -> None:
        hand, world, fine0, rest0, arm, pressure, fine, rest, scratch, trace = refs
        block = Block(self.fingers, self.block, barrier=not interpret)
        step = Step(self, block, hand, world, fine, rest, scratch)
        own = block.world
        _copy(fine0, fine, self.fine.rows)
        _copy(rest0, rest, self.rest.rows, own)
        start, end = (round(t / self.scene.discretization.timestep) for t in self.scene.window)
        limits, far = self.scene.limits, self.scene.cost.lost_distance
        alive = self.world.read(world, "alive", 0, own).lane

        def body(carry: tuple) -> tuple:
            t, alive, speed = carry
            commands = lanes([arm[t, k, own] for k in range(6)], (6,), wide=False)
            chamber = lanes([pressure[t]], (), wide=True)
            entry, new_speed, good = step.advance(commands, chamber, alive > 0, speed)
            for k, value in enumerate((*entry[:2], speed, *entry[2:])):
                trace[t, k, own] = value
            lost = (entry[0] >= far) & (t >= start) & (t < end)
            failed = ~good | (entry[1] < -limits.penetration)
            alive = jnp.where(lost | failed, 0.0, alive)
            return t + 1, alive, jnp.where(speed <= limits.speed, new_speed, speed)

        def going(carry: tuple) -> jax.Array:
            return (carry[0] < steps) & anywhere(carry[1] > 0)

        done, _, speed = jax.lax.while_loop(
            going, body, (jnp.int32(0), alive, jnp.zeros_like(alive))
        )

        def repeat(t: jax.Array, x: jax.Array) -> jax.Array:
            for k in range(len(TRACE)):
                last = trace[jnp.maximum(done - 1, 0), k, own]
                trace[t, k, own] = speed if k == 2 else last
            return x

        jax.lax.fori_loop(done, steps, repeat, jnp.int32(0))


def _copy(source: Any, target: Any, rows: int, *where: jax.Array) -> None:
    def one(k: jax.Array, x: jax.Array) -> jax.Array:
        target[(k, *where)] = source[(k, *where)]
        return x

    jax.lax.fori_loop(0, rows, one, jnp.int32(0))


class Step:
    """One time step of a block."""

    def __init__(
        self,
        program: Program,
        block: Block,
        hand: Any,
        world: Any,
        fine: Any,
        rest: Any,
        scratch: Any,
    ):
        """Takes the kernel's lanes and memory."""
        self.p, self.block, self.hand, self.world = program, block, hand, world
        self.fine, self.rest, self.scratch = fine, rest, scratch

    def constants(self, *names: str) -> list[Lanes]:
        """Constants of worlds."""
        return [self.p.world.read(self.world, n, 0, self.block.world) for n in names]

    def advance(self, arm: Lanes, pressure: Lanes, waiting: Any, speed: Any):
        """Advances the block.

        Args:
          arm: Commands of the arm frame, shape (6, 1, world).
          pressure: Chamber pressures, lanes.
          waiting: Worlds whose convergence is waited for.
          speed: Largest velocity before the step.

        Returns:
          Trace entries distance, height, residual and iterations; speed after the step; whether
          the step is good.
        """
        p, scene = self.p, self.p.scene
        state = {n: p.rest.read(self.rest, n, 0, self.block.world) for n in p.rest.groups}
        geometry = self._palm(state, arm)
        size, shape = self.constants("object_size", "shape")
        friction = lanewise(
            lambda s: collision.object_friction(scene, s.astype(jnp.int32)).astype(s.dtype), shape
        )
        bound = {c.name: c.bind(p.scratch, self.scratch, friction) for c in p.sets}
        memory = Memory(p.hand, self.hand, p.fine, self.fine, p.scratch, self.scratch, bound)
        now, centre = self._forward(state, geometry, pressure, memory, (size, shape))
        newton = Newton(p.links, self.block, memory, geometry["palm"])
        now, quality = newton.solve(now, waiting, *p.limits)
        distance = lanewise(_distance, state["position"], state["wrist"], centre).lane
        height = state["position"][2].lane
        new_speed, good = self._integrate(state, geometry, now, height, speed)
        count = jnp.full_like(height, quality.count)
        return (distance, height, quality.residual.lane, count), new_speed, good

    def _palm(self, state: dict, arm: Lanes) -> dict[str, Any]:
        """Kinematics, inertia and smooth forces of palm, wrist and object."""
        w, g = self.p.scene.hand.wrist, self.p.scene.gravity
        names = ("palm_mass", "palm_centre", "palm_inertia", "wrist_damping", "wrist_armature")
        constants = self.constants(*names, "object_mass", "object_inertia")

        def compute(state: dict, arm, mass, centre, tensor, damping, armature, obj, principal):
            frame, axes, vel, bias = kin._wrist(state["wrist"], state["wrist_vel"])
            s = State(**{k: state.get(k) for k in State._fields})
            columns, position, object_vel = kin._object(s)
            half = jnp.stack([apply_columns(frame, tensor[i]) for i in range(3)], 1)
            turned = jnp.stack([apply_columns(frame, half[j]) for j in range(3)])
            palm = Body(mass, apply_columns(frame, centre), turned)
            thing = Body(obj, position, inertia.principal_tensor(columns, principal))
            spin = jnp.concatenate([jnp.zeros_like(object_vel[:3])] * 2)
            turning = spatial(object_vel[:3], -cross(object_vel[:3], position))
            stiffness = [w.linear_stiffness] * 3 + [w.angular_stiffness] * 3
            error = arm - state["wrist"]
            spring = jnp.stack([stiffness[i] * error[i] for i in range(6)])
            start = State(**{k: None for k in State._fields})._replace(wrist=state["acc_wrist"])
            moving = spatial(jnp.zeros_like(start.wrist[:3]), start.wrist[:3])
            palm_motion = moving + total([axes[k] * start.wrist[3 + k] for k in range(3)])
            a = state["acc_object"]
            object_motion = spatial(a[:3], a[3:] + cross(position, a[:3]))
            return {
                "frame": frame,
                "vel": vel,
                "bias": bias,
                "columns": columns,
                "object_vel": object_vel,
                "now": Iterate(state["acc_wrist"], a, palm_motion, object_motion),
                "palm": Palm(
                    palm,
                    thing,
                    palm.smooth_force(vel, bias, g),
                    thing.smooth_force(turning, spin, g),
                    spring - damping * state["wrist_vel"],
                    armature,
                    axes,
                    position,
                ),
            }

        return lanewise(compute, state, arm, *constants)

    def _forward(self, state: dict, at: dict, pressure: Lanes, m: Memory, shape: tuple):
        """Bodies, forces and contacts from the palm to the tips, left in the scratch table.

        Returns:
          The warm start and the hand's centre in the palm's frame.
        """
        p, now = self.p, at["now"]
        like = jnp.zeros((p.size,), self.fine.dtype)
        mount, base, share, stub = (
            p.hand.read(self.hand, n) for n in ("mount", "base", "share", "stub_centre")
        )
        frame, origin = lanewise(kin._mount, at["frame"], mount, base)
        weight = lanewise(lambda f, s, share: share * apply_columns(f, s), at["frame"], stub, share)
        wide = zeros((6,), like)
        vel, bias, motion = (
            lanewise(jnp.add, v, wide) for v in (at["vel"], at["bias"], now.palm_motion)
        )

        def link(i: Any, carry: tuple) -> tuple:
            origin, frame, vel, bias, motion, middle = carry
            names = ("offset", "mass", "centre", "inertia", "stiffness", "damping")
            constants = [p.hand.read(self.hand, n, i) for n in names]
            gain = p.hand.read(self.hand, "gain")
            joint = [p.fine.read(self.fine, n, i) for n in ("finger", "finger_vel", "acc")]
            out = lanewise(
                partial(_link, p.scene, self.p.lay.axes),
                (origin, frame, vel, bias, motion),
                constants,
                joint,
                gain,
                pressure,
            )
            carry, stored = out
            for name, value in stored.items():
                m.scratch.write(self.scratch, name, value, i)
            share = p.hand.read(self.hand, "share", i + 1)
            middle = lanewise(lambda m, c, s: m + s * c, middle, stored["body_centre"], share)
            self._finger_contacts(i, carry, at, m, shape)
            return (*carry, middle)

        start = (origin, frame, vel, bias, motion, weight)
        middle = loop(p.links, link, start, p.size)[-1]
        self._slot_contacts(state, at, m, shape)
        count = p.num_fingers * p.links
        middle = self.block.sum(middle, self.scratch, p.scratch.offset["sums"])
        return now, lanewise(lambda c: c / count, middle)

    def _finger_contacts(self, i: Any, carry: tuple, at: dict, m: Memory, shape: tuple) -> None:
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
                geometry = self._geometry(name, centre, radius, at, shape)
                moves = (
                    relative(name, motion, now.palm_motion, now.object_motion),
                    relative(name, vel, at["vel"], at["object_vel"]),
                )
                m.contacts[name].create(i, geometry, *moves)

    def _geometry(self, name: str, centre: Lanes, radius: Lanes, at: dict, shape: tuple):
        scene = self.p.scene
        if name.endswith("_object"):
            function = partial(sphere_on_object, scene)
            return lanewise(function, *shape, at["columns"], at["palm"].position, centre, radius)
        height = self.p.rest.read(self.rest, "wrist", 0, self.block.world)[2]
        return lanewise(partial(sphere_on_table, scene), height, centre, radius)

    def _slot_contacts(self, state: dict, at: dict, m: Memory, shape: tuple) -> None:
        p, now = self.p, at["now"]

        def create(name: str, i: Any, geometry: Any) -> None:
            moves = (
                relative(name, None, now.palm_motion, now.object_motion),
                relative(name, None, at["vel"], at["object_vel"]),
            )
            m.contacts[name].create(i, geometry, *moves)

        for i in range(p.palm_groups if "palm_object" in m.contacts else 0):
            point, radius = (p.hand.read(self.hand, n, i) for n in ("palm_point", "palm_radius"))
            centre = lanewise(lambda f, s: apply_columns(f[:, :, None], s), at["frame"], point)
            for name in ("palm_object", "palm_table"):
                create(name, i, self._geometry(name, centre, radius, at, shape))
        slots = self._table_points(state, at, shape)
        for i in range(m.contacts["object_table"].set.count):
            part = [slots[k] for k in range(i * p.fingers, min((i + 1) * p.fingers, len(slots)))]
            create("object_table", i, self._deal(part))

    def _table_points(self, state: dict, at: dict, shape: tuple) -> list[tuple]:
        """Point, normal and gap of each slot of the object on the table, lanes of a world."""

        def compute(size, kind, columns, position, height):
            from types import SimpleNamespace

            hand = SimpleNamespace(object_size=size, shape=kind.astype(jnp.int32), mesh=None)
            frame = SimpleNamespace(object=columns, object_pos=position)
            run = lambda f, *a: f(*a)  # noqa: E731
            c = collision.object_on_table(run, self.p.scene, hand, frame, height)  # type: ignore[arg-type]
            return [
                (c.point[:, k : k + 1], c.normal[:, k : k + 1], c.distance[None, k : k + 1])
                for k in range(c.distance.shape[0])
            ]

        height = state["wrist"][2]
        return lanewise(compute, *shape, at["columns"], at["palm"].position, height)

    def _deal(self, slots: list[tuple]) -> tuple[Lanes, Lanes, Lanes]:
        """Deals the slots (component, 1, world) out to the finger lanes."""
        p = self.p
        away = jnp.full((p.size,), 1e3, self.fine.dtype)
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

    def _integrate(self, state: dict, at: dict, now: Iterate, height: Any, speed: Any):
        """Semi-implicit Euler; a step that fails leaves the state as it was.

        Returns:
          Largest velocity after the step, and whether the step is good, shapes (1, world).
        """
        p, h = self.p, self.p.scene.discretization.timestep
        new = lanewise(partial(_moved, h), state, at["columns"], now.wrist, now.object)
        size = lanewise(_largest, new)

        def link(i: Any, largest: Lanes) -> Lanes:
            q, rate, acc = (p.fine.read(self.fine, n, i) for n in ("finger", "finger_vel", "acc"))
            rate, q, top = lanewise(partial(_turned, h), q, rate, acc)
            p.scratch.write(self.scratch, "new_finger", q, i)
            p.scratch.write(self.scratch, "new_finger_vel", rate, i)
            return lanewise(_worse, largest, top)

        like = jnp.zeros((p.size,), self.fine.dtype)
        fingers = loop(p.links, link, zeros((), like), p.size).lane
        largest = size.lane
        row = p.scratch.offset["sums"]
        for mine in self.block.share([fingers], self.scratch, row)[0]:
            largest = _worse(largest, mine)
        limit = p.scene.limits
        good = (speed <= limit.speed) & (largest <= limit.speed)
        good = good & (height >= -limit.penetration)
        acc = {"acc_wrist": now.wrist, "acc_object": now.object}
        for name, value in {**new, **acc}.items():
            kept = lanewise(jnp.where, lanes([good], (), wide=False), value, state[name])
            p.rest.write(self.rest, name, kept, 0, self.block.world)

        def store(i: Any, x: Any) -> Any:
            for name in ("finger", "finger_vel"):
                value = p.scratch.read(self.scratch, f"new_{name}", i)
                old = p.fine.read(self.fine, name, i)
                kept = lanewise(jnp.where, lanes([good], (), wide=False), value, old)
                p.fine.write(self.fine, name, kept, i)
            return x

        jax.lax.fori_loop(0, p.links, store, jnp.int32(0))
        return largest, good


def _link(scene: Scene, names: tuple[str, ...], parent, constants, joint, gain, pressure):
    """A link's kinematics, inertia and forces."""
    origin, frame, vel, bias, motion = parent
    offset, mass, centre, principal, stiffness, damping = constants
    q, rate, acc = joint
    cos, sin = jnp.cos(q), jnp.sin(q)
    origin, frame, axes = kin._turn_link(names, origin, frame, offset, cos, sin)
    vel, bias = kin._link_velocity(vel, bias, axes, rate)
    motion = motion + total([axes[k] * acc[k] for k in range(axes.shape[0])])
    body = Body(
        mass,
        origin + apply_columns(frame, centre),
        inertia.principal_tensor(frame, principal),
    )
    tau = -stiffness * q - damping * rate
    tau = jnp.concatenate([tau[:1] + gain * pressure, tau[1:]])
    stored = {
        "axes": axes,
        "body_centre": body.centre,
        "tensor": triangle(body.tensor),
        "motion": motion,
        "smooth": body.smooth_force(vel, bias, scene.gravity),
        "tau": tau,
    }
    return (origin, frame, vel, bias, motion), stored


def _distance(position, wrist, centre):
    away = position - wrist[:3] - centre
    return jnp.sqrt(total([away[i] ** 2 for i in range(3)]))


def _moved(h: float, state: dict, columns, wrist, obj) -> dict:
    """Wrist and object after the step; see `engine.integrate`."""
    local = jnp.stack([total([columns[k, i] * obj[i] for i in range(3)]) for k in range(3)])
    wrist_vel = state["wrist_vel"] + h * wrist
    linear, angular = state["linear_vel"] + h * obj[3:], state["angular_vel"] + h * local
    return {
        "wrist": state["wrist"] + h * wrist_vel,
        "position": state["position"] + h * linear,
        "quat": _turn(state["quat"], angular, h),
        "wrist_vel": wrist_vel,
        "linear_vel": linear,
        "angular_vel": angular,
    }


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
