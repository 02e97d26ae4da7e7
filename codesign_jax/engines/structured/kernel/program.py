"""The whole rollout as one kernel: a block simulates a few worlds from start to end.

A lane is a finger of a world; a block is one warp of a GPU or one vector of a CPU.  Blocks are
independent: each does as many Newton iterations as its own worlds need, and stops when all of its
worlds are decided.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl

from codesign_jax import verdict
from codesign_jax.compiler import cache
from codesign_jax.compiler.launch import Kernel, block_lanes, kernel_jaxpr, launch
from codesign_jax.engines.structured import collision, coordinates
from codesign_jax.engines.structured.constants import WorldConstants
from codesign_jax.engines.structured.kernel import fingers, hull, objects
from codesign_jax.engines.structured.kernel.contacts import ContactSet
from codesign_jax.engines.structured.kernel.memory import Block, MemoryLayout, anywhere
from codesign_jax.engines.structured.kernel.pairs import PairSet, pair_slots
from codesign_jax.engines.structured.kernel.slots import HullSet, SlotSet, hull_slots
from codesign_jax.engines.structured.kernel.step import Step
from codesign_jax.engines.structured.kinematics import Acc, State
from codesign_jax.engines.structured.lanewise import lanes
from codesign_jax.model import layout
from codesign_jax.model.layout import palm_touches
from codesign_jax.scene import Scene

PACKAGE = Path(__file__).parents[3]
UNRELATED = ("accuracy", "benchmark", "commands", "experiments", "optimize", "report", "runs")
"""The package's folders that no kernel depends on: they import engines, never the other way."""
TRACE = ("distance", "height", "speed", "residual", "iterations", "moved")


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

    def __init__(self, scene: Scene, limits: Limits, *, backend: str = "gpu", width: int = 32):
        """Lays out the memory.

        Args:
          scene: The scene.
          limits: How hard each step is solved.
          backend: "gpu", "cpu", or "interpreter", which is Pallas' own and slow.
          width: Lanes of a block, a power of two; more if a world has more fingers. By default
            those of a warp.
        """
        self.backend = backend
        self.scene, self.limits, self.lay = scene, limits, layout(scene)
        n, self.links, self.axes = self.lay.dofs.shape
        self.fingers = 1 << (n - 1).bit_length()
        self.num_fingers, self.block = n, max(1, width // self.fingers)
        self.size = self.fingers * self.block
        self.k = self.lay.spheres.shape[-1] if self.lay.spheres.size else 0
        self.palm_groups = -(-self.lay.palm.size // self.fingers)
        self.meshes = bool(collision.mesh_indices(scene))
        self.sets = self._sets()
        self.slotted = any(isinstance(s, SlotSet) for s in self.sets)
        self.trace = (*TRACE, "overflow") if self.slotted else TRACE
        self._tables()

    @classmethod
    def here(cls, scene: Scene, limits: Limits, dtype: Any, worlds: int | None = None) -> "Program":
        """The program for this device, type and number of worlds, see `launch.block_lanes`."""
        backend, fingers = jax.default_backend(), layout(scene).dofs.shape[0]
        total = None if worlds is None else worlds << (fingers - 1).bit_length()
        return cls(scene, limits, backend=backend, width=block_lanes(backend, dtype, total))

    def _sets(self) -> list[ContactSet]:
        e, k = self.scene.effects, self.k
        make = partial(ContactSet, self.scene, size=self.size)
        sets = []
        if k and e.finger_object:
            sets.append(make("finger_object", self.links, k))
        if k and e.finger_table:
            sets.append(make("finger_table", self.links, k))
        on = {"hull_object": e.finger_object, "hull_table": e.finger_table}
        if e.surface == "hull":
            sets += [self._skin(name) for name in on if on[name]]
        if e.finger_finger and self.num_fingers > 1:
            block, slots = (self.fingers, self.block), pair_slots(self.scene)
            gathers = self.backend == "gpu"
            sets.append(PairSet(self.scene, block, self.links, slots, gathers=gathers))
        on = {"palm_object": e.palm_object, "palm_table": e.palm_table}
        sets += [make(name, self.palm_groups, 1) for name in on if on[name]]
        on_table = [make("object_table", -(-4 // self.fingers), 1)] if e.object_table else []
        return [*sets, *on_table]

    def _skin(self, name: str) -> HullSet:
        slots = hull_slots(self.scene)
        return HullSet(self.scene, name, rows=self.links + 1, slots=slots, size=self.size)

    def _tables(self) -> None:
        n, a = self.links, self.axes
        one: tuple[int, ...] = ()
        more = {"sphere": (n, (3, self.k)), "radius": (n, (self.k,))} if self.k else {}
        if palm_touches(self.scene):
            more |= {
                "palm_point": (self.palm_groups, (3, 1)),
                "palm_radius": (self.palm_groups, (1,)),
            }
        if self.scene.effects.neo_hookean:
            more |= {"section": (1, (4,))}
        if self.scene.effects.surface == "hull":
            more |= hull.fields(self.scene)
        support, grid = objects.tables(self.scene, self.fingers)
        self.hand = MemoryLayout(
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
            **more,
            **support,
        )
        some: dict[str, tuple[int, tuple[int, ...]]] = {}
        for contacts in self.sets:
            some |= contacts.cone_rows()
        if self.scene.effects.gravity:
            some |= {"gravity": (1, one)}
        if self.scene.effects.wrist:
            some |= {"wrist_stiffness": (1, (6,))}
        self.world = MemoryLayout(
            False,
            palm_mass=(1, one),
            palm_centre=(1, (3,)),
            palm_inertia=(1, (3, 3)),
            wrist_damping=(1, (6,)),
            wrist_armature=(1, (6,)),
            object_mass=(1, one),
            object_inertia=(1, (3,)),
            object_size=(1, (3,)),
            object_id=(1, one),
            alive=(1, one),
            **grid,
            **dict.fromkeys(verdict.Bounds._fields, (1, one)),
            **some,
        )
        self.finger_state = MemoryLayout(
            True, finger=(n, (a,)), finger_vel=(n, (a,)), acc=(n, (a,))
        )
        world_state = dict(wrist=6, position=3, quat=4, wrist_vel=6, linear_vel=3, angular_vel=3)
        world_state |= dict(acc_wrist=6, acc_object=6)
        self.world_state = MemoryLayout(
            False, **{name: (1, (size,)) for name, size in world_state.items()}
        )
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
            "new_finger": (n, (a,)),
            "new_finger_vel": (n, (a,)),
        }
        for contacts in self.sets:
            fields |= contacts.groups()
        if any(isinstance(s, PairSet) for s in self.sets):
            fields |= {"inverse": (n, (a, a)), "z_again": (n, (a,))} | fingers.fields(n, self.k)
        self.scratch = MemoryLayout(True, **fields)

    def pack_hand(self, hand: WorldConstants) -> tuple[jax.Array, jax.Array]:
        """The hand's tables; padded worlds are not alive, padded fingers have no mass."""
        worlds, n = hand.object_id.shape[1], self.num_fingers
        dtype, lane = hand.mass.dtype, (n, worlds)
        links_first = ("centre", "inertia", "sphere")
        arrays = {
            k: jnp.moveaxis(v, 1, 0) if k in links_first and v.size else v
            for k, v in hand._asdict().items()
        }
        arrays |= hand.bounds._asdict()
        for name, cone in hand.cones._asdict().items():
            if cone is None:
                continue
            arrays[f"cone.{name}"] = jnp.stack([v for v in cone if v is not None])
        # Weights of the segments in the hand's centre: half segments at the palm and at the tip.
        share = jnp.ones((self.links + 1, *lane), dtype)
        arrays["share"] = share.at[jnp.array([0, self.links])].set(0.5)
        if palm_touches(self.scene):
            arrays |= self._palm_slots(hand)
        if hand.section is not None:
            arrays["section"] = hand.section[None]
        if self.scene.effects.surface == "hull":
            arrays |= hull.pack(self.scene, hand)
        if hand.mesh is not None:
            arrays |= objects.rows(hand.mesh, self.fingers, dtype)
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
        arrays["object_id"] = hand.object_id.astype(dtype)
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

    def _palm_slots(self, hand: WorldConstants) -> dict[str, jax.Array]:
        """The palm's contact spheres, shared out among the lanes."""
        f, g, worlds = self.fingers, self.palm_groups, hand.palm_radius.shape[1]
        missing = (0, g * f - len(hand.palm_radius))
        place = jnp.pad(hand.palm_point, [(0, 0), missing, (0, 0)]).reshape(3, g, 1, f, worlds)
        size = jnp.pad(hand.palm_radius, [missing, (0, 0)], constant_values=-1e3)
        return {
            "palm_point": jnp.moveaxis(place, 0, 1),
            "palm_radius": size.reshape(g, 1, f, worlds),
        }

    def pack_state(self, state: State) -> tuple[jax.Array, jax.Array]:
        """The state's tables."""
        arrays = state._asdict() | {"acc_wrist": state.acc.wrist, "acc_object": state.acc.object}
        finger_state = {
            "finger": state.finger,
            "finger_vel": state.finger_vel,
            "acc": state.acc.finger,
        }
        wide = {k: self._widen(v) for k, v in finger_state.items()}
        narrow = {k: arrays[k] for k in self.world_state.groups}
        return self.finger_state.pack(self.fingers, self.block, **wide), self.world_state.pack(
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

    def run(self, hand: WorldConstants, state: State, ctrl: jax.Array) -> dict[str, jax.Array]:
        """Runs a rollout; returns `trace` by name, shape (world, time)."""
        return self.simulate(hand, state, ctrl)[0]

    def simulate(
        self,
        hand: WorldConstants,
        state: State,
        ctrl: jax.Array,
        *,
        trajectory: bool = False,
        states: bool = False,
    ) -> tuple[dict[str, jax.Array], State]:
        """Runs a rollout.

        Args:
          hand: Constants of the worlds.
          state: Their start states.
          ctrl: Controls, shape (world, time, nu).
          trajectory: Whether to record qpos, and to simulate worlds that lost their object to the
            end.
          states: Whether to record qpos, qvel and the accelerations of every step.

        Returns:
          `trace` by name, shape (world, time), with "qpos", "qvel" and "acc", shape (world, time,
          nq or nv), of what is recorded; and the last states.
        """
        inputs = self.inputs(hand, state, ctrl)
        out = self.execute(inputs, trajectory=trajectory, states=states)
        return self.outputs(out, ctrl.shape[0], trajectory=trajectory, states=states)

    def execute(
        self, inputs: tuple, *, trajectory: bool = False, states: bool = False
    ) -> list[jax.Array | None]:
        """Runs the blocks, which do not depend on each other; None in the place of scratch memory.

        Args:
          inputs: See `inputs`.
          trajectory: As in `simulate`.
          states: As in `simulate`.
        """
        call, outputs = self._call(inputs, trajectory, states)
        if self.backend == "interpreter":
            return call(*inputs)
        code = cache.sources(PACKAGE, UNRELATED)
        origin = repr((self.scene.structure, self.limits, trajectory, states, code))
        shared = (len(inputs) - 1,) if self.meshes else ()
        kernel = Kernel(origin, self.backend, self.size, shared, scratch=(2,))
        return launch(call, inputs, outputs, kernel)

    def outputs(
        self, out: Any, worlds: int, *, trajectory: bool = False, states: bool = False
    ) -> tuple[dict[str, jax.Array], State]:
        """What `simulate` returns, from what the blocks of so many worlds wrote."""
        # (block, world, time, entry)
        trace = jnp.moveaxis(out[3], 3, 1)
        trace = trace.reshape(-1, trace.shape[2], len(self.trace))[:worlds]
        found = {name: trace[..., k] for k, name in enumerate(self.trace)}
        if trajectory or states:
            found |= {k: v[:worlds] for k, v in self._path(out[4], out[5], states).items()}
        last = self.unpack_state(out[0], out[1], worlds)
        if states:
            # A row holds the acceleration of the step before it, the solver's warm start.
            end = coordinates.flat_acc(last.acc)[:, None]
            found["acc"] = jnp.concatenate([found["acc"][:, 1:], end], 1)
        return found, last

    def jaxpr(self, hand: WorldConstants, state: State, ctrl: jax.Array) -> Any:
        """The jaxpr of a block of a rollout's kernel; arguments may be `jax.ShapeDtypeStruct`."""
        inputs = jax.eval_shape(self.inputs, hand, state, ctrl)
        return kernel_jaxpr(self._call(inputs, False, False)[0], list(inputs))

    def inputs(self, hand: WorldConstants, state: State, ctrl: jax.Array) -> tuple:
        """The kernel's arguments, which have a leading axis of blocks; the last may be shared."""
        inputs = (*self.pack_hand(hand), *self.pack_state(state), *self.pack_controls(ctrl))
        return inputs if hand.mesh is None else (*inputs, hand.mesh.values[None])

    def _call(
        self, inputs: tuple, trajectory: bool, states: bool
    ) -> tuple[Callable, list[jax.ShapeDtypeStruct]]:
        """The kernel of arguments as a function of them, and its outputs."""
        blocks, steps, dtype = inputs[0].shape[0], inputs[4].shape[1], inputs[4].dtype
        shapes = [
            (blocks, self.finger_state.rows, self.size),
            (blocks, self.world_state.rows, self.block),
            (blocks, self.scratch.rows, self.size),
            (blocks, steps, len(self.trace), self.block),
        ]
        if trajectory or states:
            angles, places = self._path_rows(states)
            shapes += [(blocks, steps, angles, self.size), (blocks, steps, places, self.block)]

        def spec(shape: tuple[int, ...]) -> pl.BlockSpec:
            own = shape[0] == blocks
            return pl.BlockSpec((None, *shape[1:]), lambda i: (i * own, *[0] * (len(shape) - 1)))

        outputs = [jax.ShapeDtypeStruct(s, dtype) for s in shapes]
        call = pl.pallas_call(
            partial(self._kernel, steps, trajectory, states),
            grid=(blocks,),
            in_specs=[spec(x.shape) for x in inputs],
            out_specs=[spec(s) for s in shapes],
            out_shape=outputs,
            interpret=self.backend == "interpreter",
            name="grasp",
        )
        return call, outputs

    def _path_rows(self, states: bool) -> tuple[int, int]:
        """Numbers of rows of the state's tables that are recorded: all, or the positions."""
        if states:
            return self.finger_state.rows, self.world_state.rows
        return self.finger_state.offset["finger_vel"], self.world_state.offset["wrist_vel"]

    def _path(self, fingers: jax.Array, worlds: jax.Array, states: bool) -> dict[str, jax.Array]:
        """Coordinates of recorded rows (block, time, row, lane or world)."""
        steps, size = fingers.shape[1], self.links * self.axes
        names = [("qpos", "finger", ("wrist", "position", "quat"))]
        if states:
            names += [("qvel", "finger_vel", ("wrist_vel", "linear_vel", "angular_vel"))]
            names += [("acc", "acc", ("acc_wrist", "acc_object"))]
        found = {}
        for name, joint, others in names:
            rows = self.finger_state.offset[joint] + np.arange(size)
            split = (-1, steps, size, self.fingers, self.block)
            joints = fingers[:, :, rows].reshape(split)[..., : self.num_fingers, :]
            joints = joints.transpose(0, 4, 1, 3, 2)  # (block, world, time, finger, link and axis)
            joints = joints.reshape(-1, steps, self.num_fingers * size)
            where = [(self.world_state.offset[o], self.world_state.groups[o][1][0]) for o in others]
            rows = np.concatenate([np.arange(first, first + count) for first, count in where])
            rest = jnp.moveaxis(worlds[:, :, rows], 3, 1).reshape(-1, steps, rows.size)
            found[name] = jnp.concatenate([rest[..., :6], joints, rest[..., 6:]], -1)
        return found

    def unpack_state(self, finger_state: jax.Array, world_state: jax.Array, worlds: int) -> State:
        """Inverse of `pack_state`."""
        wide = self.finger_state.unpack(finger_state, self.fingers, self.num_fingers, worlds)
        narrow = self.world_state.unpack(world_state, 1, 1, worlds)
        acc = Acc(narrow.pop("acc_wrist"), wide.pop("acc"), narrow.pop("acc_object"))
        return State(**wide, **narrow, acc=acc)

    def _kernel(self, steps: int, to_end: bool, states: bool, *refs: Any) -> None:
        (
            hand,
            world,
            finger_state0,
            world_state0,
            arm,
            pressure,
            *rest,
        ) = refs
        grid = rest.pop(0) if self.meshes else None
        (
            finger_state,
            world_state,
            scratch,
            trace,
            *path,
        ) = rest
        block = Block(self.fingers, self.block)
        step = Step(self, block, hand, world, finger_state, world_state, scratch, grid)
        own = block.world
        _copy(finger_state0, finger_state, self.finger_state.rows)
        _copy(world_state0, world_state, self.world_state.rows, own)
        bounds = verdict.Bounds(
            *(self.world.read(world, n, 0, own).lane for n in verdict.Bounds._fields)
        )
        start, end = (v.astype(jnp.int32) for v in (bounds.start, bounds.end))
        bounds = bounds._replace(start=start, end=end)
        alive = self.world.read(world, "alive", 0, own).lane

        def record(t: jax.Array) -> None:
            if path:
                angles, places = self._path_rows(states)
                _copy(finger_state, path[0], angles, at=(t,))
                _copy(world_state, path[1], places, own, at=(t,))

        def body(carry: tuple) -> tuple:
            t, alive, speed = carry

            def undecided(distance: jax.Array, height: jax.Array) -> jax.Array:
                return verdict.goes_on(bounds, distance, height, speed, t, to_end=to_end)

            record(t)
            commands = lanes([arm[t, k, own] for k in range(6)], (6,), wide=False)
            chamber = lanes([pressure[t]], (), wide=True)
            entry, new_speed, moved = step.advance(commands, chamber, undecided, alive > 0, speed)
            alive = jnp.where(moved, alive, 0.0)
            for k, value in enumerate((*entry[:2], speed, *entry[2:4], alive, *entry[4:])):
                trace[t, k, own] = value
            return t + 1, alive, new_speed

        def going(carry: tuple) -> jax.Array:
            return (carry[0] < steps) & anywhere(carry[1] > 0)

        done, _, speed = jax.lax.while_loop(
            going, body, (jnp.int32(0), alive, jnp.zeros_like(alive))
        )

        def repeat(t: jax.Array, x: jax.Array) -> jax.Array:
            record(t)
            for k in range(len(self.trace)):
                last = trace[jnp.maximum(done - 1, 0), k, own]
                trace[t, k, own] = speed if k == 2 else last
            return x

        jax.lax.fori_loop(done, steps, repeat, jnp.int32(0))


def _copy(source: Any, target: Any, rows: int, *where: jax.Array, at: tuple = ()) -> None:
    """Copies the first rows; `at`: what comes before the row in the target."""

    def one(k: jax.Array, x: jax.Array) -> jax.Array:
        target[(*at, k, *where)] = source[(k, *where)]
        return x

    jax.lax.fori_loop(0, rows, one, jnp.int32(0))
