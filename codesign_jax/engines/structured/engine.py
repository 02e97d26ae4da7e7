"""Step and rollout of the structured engine behind the common interface."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax import effects, verdict
from codesign_jax.compiler import launch
from codesign_jax.engines.base import Equal
from codesign_jax.engines.structured import (
    collision,
    finger_pairs,
    hull,
    implicit,
    mesh,
    transforms,
)
from codesign_jax.engines.structured.constants import WorldConstants, apply_columns, world_constants
from codesign_jax.engines.structured.contact import Contacts
from codesign_jax.engines.structured.inertia import Bodies, bodies, smooth_forces
from codesign_jax.engines.structured.integration import integrate, rigid_arm
from codesign_jax.engines.structured.kinematics import Acc, Kinematics, State, kinematics
from codesign_jax.engines.structured.lanes import Stages, total
from codesign_jax.engines.structured.problem import Matrices, Problem, Spatial
from codesign_jax.engines.structured.transforms import Path
from codesign_jax.model import ModelFields, layout
from codesign_jax.model.layout import palm_touches
from codesign_jax.scene import Scene
from codesign_jax.schema import SceneError
from codesign_jax.types import Status, Trace, failed


class StepInfo(NamedTuple):
    """What a step reports but does not carry.

    Attributes:
      acc: Accelerations of the step.
      residual: Relative Newton decrement of each world, shape (1, world).
      iterations: Newton iterations of the batch, shape ().
      centre: Hand centre, world frame, shape (3, 1, world).
      overflow: Whether more pairs of spheres of different fingers touch than there are slots, shape
        (1, world); None without such contacts.
    """

    acc: Acc
    residual: jax.Array
    iterations: jax.Array
    centre: jax.Array
    overflow: jax.Array | None = None


class StructuredEngine(Equal):
    """Newton on MuJoCo's own problem by elimination along the fingers; cost linear in the links."""

    name = "structured"

    def __init__(
        self,
        scene: Scene,
        *,
        iterations: int | None = None,
        evaluations: int | None = None,
        tolerance: float | None = None,
        kernel: bool | None = None,
    ):
        """Prepares the engine.

        Args:
          scene: The scene.
          iterations: Largest number of Newton iterations a step instead of the scene's, see
            `scene.Newton`.
          evaluations: Line-search evaluations an iteration; 14 at least in the kernel.
          tolerance: Relative Newton decrement below which a world needs no further iteration.
          kernel: Whether one kernel runs a rollout. Without it all worlds step in unison. By
            default where kernels can run; elsewhere a warning says why not.

        Raises:
          KernelUnavailable: If `kernel` is true and kernels cannot run here.
          SceneError: If a mesh's distance cannot be put on a grid.
        """
        effects.refuse(scene.effects, self.name)
        mesh.tables(scene)
        self.scene = scene
        newton = scene.newton
        self.iterations = newton.iterations if iterations is None else iterations
        self.tolerance = newton.decrement if tolerance is None else tolerance
        # The kernel's line search ends when it is exact: more evaluations are a cap, not a cost.
        most, few = newton.evaluations, min(newton.evaluations, 6)
        self.evaluations = few if evaluations is None else evaluations
        self.kernel_evaluations = most if evaluations is None else max(evaluations, 14)
        self.conditional = jax.default_backend() == "cpu"  # see Stages
        self.demanded = bool(kernel)
        wanted = kernel is not False
        self.kernel = wanted and _has_kernel(self.demanded)

    def _key(self) -> tuple:
        limits = self.iterations, self.tolerance, self.evaluations, self.kernel_evaluations
        return self.scene.structure, limits, self.kernel, self.demanded

    def reset(self, fields: ModelFields) -> State:
        """Start states of a batch, fields with leading axis (world,)."""
        lay = layout(self.scene)
        start = fields.start.T[:, None]
        n, links, axes = lay.dofs.shape
        zero = jnp.zeros_like
        angles = start[6 : 6 + lay.dofs.size].reshape(n, links, axes, -1)
        finger = jnp.moveaxis(angles, 0, 2)
        free = start[6 + lay.dofs.size :]
        acc = Acc(zero(start[:6]), zero(finger), zero(start[:6]))
        return State(
            start[:6],
            finger,
            free[:3],
            free[3:],
            zero(start[:6]),
            zero(finger),
            zero(free[:3]),
            zero(free[:3]),
            acc,
        )

    def place(
        self, state: State, qpos: jax.Array, qvel: jax.Array, acc: jax.Array | None = None
    ) -> State:
        """The state at MuJoCo's qpos (world, nq) and qvel (world, nv); see `qpos` and `qvel`.

        The warm start is the given one, see `flat_acc`, or the state's own.
        """
        lay, end = layout(self.scene), 6 + layout(self.scene).dofs.size
        q, v = qpos.T[:, None], qvel.T[:, None]

        def finger(x: jax.Array) -> jax.Array:
            return jnp.moveaxis(x[6:end, 0].reshape(*lay.dofs.shape, -1), 0, 2)

        if acc is not None:
            a = acc.T[:, None]
            state = state._replace(acc=Acc(a[:6], finger(a), a[end:]))
        return state._replace(
            wrist=q[:6],
            finger=finger(q),
            position=q[end : end + 3],
            quat=q[end + 3 :],
            wrist_vel=v[:6],
            finger_vel=finger(v),
            linear_vel=v[end : end + 3],
            angular_vel=v[end + 3 :],
        )

    def qpos(self, state: State) -> jax.Array:
        """MuJoCo's qpos, shape (world, nq)."""
        finger = jnp.moveaxis(state.finger, 2, 0).reshape(-1, state.finger.shape[-1])
        parts = [state.wrist[:, 0], finger, state.position[:, 0], state.quat[:, 0]]
        return jnp.concatenate(parts).T

    def qvel(self, state: State) -> jax.Array:
        """MuJoCo's qvel, shape (world, nv)."""
        finger = jnp.moveaxis(state.finger_vel, 2, 0).reshape(-1, state.finger.shape[-1])
        parts = [state.wrist_vel[:, 0], finger, state.linear_vel[:, 0], state.angular_vel[:, 0]]
        return jnp.concatenate(parts).T

    def problem(
        self, run: Stages, hand: WorldConstants, state: State, ctrl: jax.Array
    ) -> tuple[Problem, Spatial]:
        """Assembles a step's problem and the bodies' velocities; ctrl has shape (nu, world)."""
        kin = kinematics(run, hand, layout(self.scene).axes, state)
        body = bodies(run, hand, kin)
        smooth = smooth_forces(run, hand, kin, body, state, ctrl, self.scene)
        matrix = Matrices(*(run(lambda b: b.matrix(), b) for b in body))
        contacts = self.contacts(run, hand, kin, state.wrist[2])
        velocity = Spatial(kin.palm_vel, kin.vel, kin.object_vel)
        h, arm = self.scene.discretization.timestep, None
        if not self.scene.effects.wrist:
            arm = rigid_arm(ctrl[:6, None], state.wrist, state.wrist_vel, h)
        return Problem(hand, kin, body, matrix, smooth, contacts, arm), velocity

    def contacts(
        self, run: Stages, hand: WorldConstants, kin: Kinematics, height: jax.Array
    ) -> dict[str, Contacts]:
        """Contacts that the scene's effects call for, by pair of bodies."""
        scene, e, found = self.scene, self.scene.effects, {}
        on_object = partial(collision.spheres_on_object, scene, hand, kin)
        on_table = partial(collision.spheres_on_table, hand.cones.hand_table, height)
        if hand.sphere.size:
            spheres = run(collision.finger_spheres, hand, kin)
            if e.finger_object:
                found["finger_object"] = on_object(run, spheres, hand.radius)
            if e.finger_table:
                found["finger_table"] = on_table(spheres, hand.radius)
            if e.finger_finger and self.scene.num_fingers > 1:
                found["finger_finger"] = finger_pairs.contacts(
                    run, hand.cones.finger_finger, spheres, hand.radius
                )
        if e.surface == "hull" and (e.finger_object or e.finger_table):
            skin = run(lambda h, k: hull.vertices(scene, h, k), hand, kin)
            if e.finger_object:
                found["hull_object"] = hull.attach(run, on_object(run, skin.point, 0.0), skin)
            if e.finger_table:
                found["hull_table"] = hull.attach(run, on_table(skin.point, 0.0), skin)
        if palm_touches(scene):
            palm, radius = collision.palm_spheres(hand, kin), hand.palm_radius
            if e.palm_object:
                found["palm_object"] = on_object(run, palm, radius)
            if e.palm_table:
                found["palm_table"] = on_table(palm, radius)
        if e.object_table:
            found["object_table"] = collision.object_on_table(run, scene, hand, kin, height)
        return found

    def step(
        self, hand: WorldConstants, state: State, ctrl: jax.Array, *, iterations: int | None = None
    ) -> tuple[State, StepInfo]:
        """Advances a batch by one time step under controls of shape (nu, world).

        Args:
          hand: Constants of the worlds.
          state: Their states.
          ctrl: Controls, shape (nu, world).
          iterations: As in the engine, by default its own; 0 takes the warm start for the solution.

        Raises:
          SceneError: If the batch form cannot do what the scene asks for.
        """
        refuse_batch(self.scene)
        # The compiler does not know that a shape's index is never negative.
        run = Stages(hand.object_id[0, 0] >= 0 if self.conditional else None)
        problem, velocity = self.problem(run, hand, state, ctrl)
        solution = implicit.solve(
            run,
            problem,
            velocity,
            state.acc,
            iterations=self.iterations if iterations is None else iterations,
            evaluations=self.evaluations,
            tolerance=self.tolerance,
        )
        h = self.scene.discretization.timestep
        if problem.arm is not None:
            solution = solution._replace(acc=solution.acc._replace(wrist=problem.arm))
        new = run(lambda s, k, a: integrate(s, k, a, h), state, problem.kin, solution.acc)
        centre = self._centre(hand, problem.kin, problem.body) + state.wrist[:3]
        pairs = problem.contacts.get("finger_finger")
        overflow = None if pairs is None else finger_pairs.overflow(pairs)
        solved = solution.acc, solution.residual, solution.iterations
        return new, StepInfo(*solved, centre, overflow)

    def _centre(self, hand: WorldConstants, kin: Kinematics, body: Bodies) -> jax.Array:
        """Mean position of the segments in the palm's frame: half weight for the half segments."""
        n, links = hand.mount.shape[2], hand.mass.shape[0]
        weights = [1.0] * (links - 1) + [0.5]
        moving = total([w * body.link.centre[:, i] for i, w in enumerate(weights)])
        every = moving + 0.5 * apply_columns(kin.palm, hand.stub_centre)
        return total([every[:, f : f + 1] for f in range(n)]) / (n * links)

    def rollout(self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool = False) -> Trace:
        """See `Engine.rollout`; what JAX's transformations make of it stands in `transforms`."""
        return transforms.rollout(self, fields, ctrl, trajectory=trajectory)

    def simulate(
        self,
        fields: ModelFields,
        ctrl: jax.Array,
        *,
        trajectory: bool = False,
        states: bool = False,
    ) -> tuple[Trace, Path | None]:
        """The rollout itself, in one kernel where there is one, see `kernel`.

        Args:
          fields: As in `Engine.rollout`.
          ctrl: As in `Engine.rollout`.
          trajectory: As in `Engine.rollout`.
          states: Whether to return every step's state and accelerations.

        Returns:
          The trace, and what a derivative reads of it if states are asked for, else None.
        """
        record = {"trajectory": trajectory, "states": states}
        if self.kernel:
            try:
                return self._one_kernel(fields, ctrl, **record)
            except launch.KernelUnavailable as error:
                if self.demanded:
                    raise
                launch.warn(str(error))
        with jax.default_matmul_precision("highest"):
            return self._batch(fields, ctrl, **record)

    def _one_kernel(
        self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool, states: bool
    ) -> tuple[Trace, Path | None]:
        from codesign_jax.engines.structured.kernel import Limits, Program

        limits = Limits(self.iterations, self.kernel_evaluations, self.tolerance)
        program = Program.here(self.scene, limits, ctrl.dtype)
        hand, start = world_constants(self.scene, fields), self.reset(fields)
        found, end = program.simulate(hand, start, ctrl, trajectory=trajectory, states=states)
        qpos = found["qpos"] if trajectory else jnp.zeros((*ctrl.shape[:2], 0), ctrl.dtype)
        overflow = found["overflow"][None] > 0 if "overflow" in found else None
        status, last = self._status(found["residual"], overflow), self.flat(end)
        trace = Trace(found["distance"], found["height"], found["speed"], qpos, status, last)
        if not states:
            return trace, None
        return trace, Path(found["qpos"], found["qvel"], found["acc"], found["moved"] > 0)

    def _batch(
        self, fields: ModelFields, ctrl: jax.Array, *, trajectory: bool, states: bool
    ) -> tuple[Trace, Path | None]:
        hand = world_constants(self.scene, fields)
        bounds = verdict.Bounds(*(v[0] for v in hand.bounds))

        def body(carry, x):
            state, speed, alive = carry
            u, t = x
            new, info = self.step(hand, state, u)
            away, height = state.position - info.centre, state.position[2, 0]
            distance = jnp.sqrt(total([away[i, 0] ** 2 for i in range(3)]))
            status = self._status(jnp.where(alive, info.residual[0], 0.0), info.overflow)
            qpos = self.qpos(state)
            entry = Trace(distance, height, speed, qpos if trajectory else qpos[:, :0], status)
            goes_on = verdict.goes_on(bounds, distance, height, speed, t, to_end=trajectory)
            goes_on &= alive & ~failed(status)
            new_speed = self.speed(new)
            moved = goes_on & verdict.slow(bounds, new_speed)
            path = Path(qpos, self.qvel(state), self.flat_acc(info.acc), moved) if states else None
            state = jax.tree.map(lambda a, b: jnp.where(moved, a, b), new, state)
            return (state, jnp.where(goes_on, new_speed, speed), moved), (entry, path)

        worlds = ctrl[:, 0, 0]
        start = (self.reset(fields), jnp.zeros_like(worlds), worlds == worlds)
        steps = jnp.moveaxis(ctrl, 0, -1), jnp.arange(ctrl.shape[1])
        (end, *_), recorded = jax.lax.scan(body, start, steps)
        trace, path = jax.tree.map(lambda v: jnp.moveaxis(v, 0, 1), recorded)
        return trace._replace(last=self.flat(end)), path

    def _status(self, residual: jax.Array, overflow: jax.Array | None = None) -> jax.Array:
        """SOLVER_CAP above the tolerance, CONTACT_OVERFLOW; int32 of the residual's shape."""
        status = jnp.where(residual > self.tolerance, int(Status.SOLVER_CAP), 0).astype(jnp.int32)
        if overflow is None:
            return status
        return status | jnp.where(overflow[0], int(Status.CONTACT_OVERFLOW), 0)

    def flat_acc(self, acc: Acc) -> jax.Array:
        """Accelerations in the order of qvel, shape (world, nv); the object's as in `Acc`."""
        finger = jnp.moveaxis(acc.finger, 2, 0).reshape(-1, acc.finger.shape[-1])
        return jnp.concatenate([acc.wrist[:, 0], finger, acc.object[:, 0]]).T

    def flat(self, state: State) -> jax.Array:
        """Generalized positions and velocities, shape (world, nq + nv)."""
        return jnp.concatenate([self.qpos(state), self.qvel(state)], 1)

    def speed(self, state: State) -> jax.Array:
        """Largest absolute generalized velocity; not finite if any velocity or position is not."""
        qvel, qpos = self.qvel(state), self.qpos(state)
        return jnp.abs(qvel).max(1) + 0.0 * qpos.sum(1)


def _has_kernel(demanded: bool) -> bool:
    """Whether kernels can run on this device; if not, warns once with the reason, or raises it."""
    reason = launch.available(jax.default_backend())
    if reason is not None and demanded:
        raise launch.KernelUnavailable(reason)
    if reason is not None:
        launch.warn(reason)
    return reason is None


def refuse_batch(scene: Scene) -> None:
    """Checks that the batch form, which has derivatives, can do what a scene asks for.

    Raises:
      SceneError: If it cannot.
    """
    e = scene.effects
    if e.finger_finger and scene.num_fingers > 1 and (e.surface == "hull" or e.friction == "full"):
        raise SceneError(
            [
                "effects.finger_finger with surface = 'hull' or friction = 'full' runs in the "
                "kernel only, which has no derivative: use surface = 'spheres' and friction = "
                "'coulomb' or 'none', or an engine with the kernel"
            ]
        )
