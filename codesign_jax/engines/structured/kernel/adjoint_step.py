"""One time step of a block of worlds in reverse: cotangents of its end to those of its start.

Virtual accelerations lambda solve the one linear system of a step's derivative, H lambda = v, with
v the cotangent of the step's accelerations and H the matrix of a Newton step at the solution,
contacts as they are there: one elimination, however many iterations found it (`AdjointSolve`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import chambers, friction_memory, residual
from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel.contact_list import ContactList
from codesign_jax.engines.structured.kernel.contacts_vjp import ContactsVjp
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables, only_on, plus, pull
from codesign_jax.engines.structured.kernel.coupling import Coupling
from codesign_jax.engines.structured.kernel.linear_system import Elimination
from codesign_jax.engines.structured.kernel.memory import Block, any_of, choose, loop, zeros
from codesign_jax.engines.structured.kernel.placement import Item
from codesign_jax.engines.structured.kernel.problem import Iterate, Problem
from codesign_jax.engines.structured.kernel.residual import Before, LinkMotion
from codesign_jax.engines.structured.kernel.residual_vjp import ResidualVjp
from codesign_jax.engines.structured.kernel.rows import (
    Chain,
    ChainBefore,
    FingerState,
    Scratch,
    Virtual,
    WorldState,
)
from codesign_jax.engines.structured.kernel.sides import Sides
from codesign_jax.engines.structured.kernel.step import Step, body_after_step, joint_after_step
from codesign_jax.engines.structured.kernel.step_memory import (
    KernelLayout,
    References,
    StepMemory,
)
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

MOVED = (
    WorldState.wrist,
    WorldState.position,
    WorldState.quat,
    WorldState.wrist_vel,
    WorldState.linear_vel,
    WorldState.angular_vel,
)
"""Positions and velocities of wrist and object."""
JOINT = FingerState.finger, FingerState.finger_vel, FingerState.acc
"""Angles, velocities and accelerations of the fingers' joints."""


class TraceCotangents(NamedTuple):
    """Cotangents of what the trace shows of the state before a step, numbers of a world."""

    distance: jax.Array
    height: jax.Array
    speed: jax.Array


class ReverseStep(Step):
    """A step in reverse.

    It goes from the step's start, with the accelerations that solve it as warm start, to the tips
    as the forward pass does, solves for the virtual accelerations, and goes back to the palm.
    """

    def __init__(
        self, layout: KernelLayout, block: Block, references: References, bars: CotangentTables
    ):
        """Binds the tables; bars: those of the cotangents."""
        super().__init__(layout, block, references)
        self.bars = bars

    def store_chain(self, i: Any, chain: tuple) -> None:
        """Stores how a body moves, for the reverse sweep over the links.

        Args:
          i: Row of the body: 0 is the palm, then the links.
          chain: Values of `residual.LinkMotion`, or of its first fields: vectors (3, ...), frames
            as columns (3, 3, ...), spatial vectors (6, ...), lanes of a finger.
        """
        for name, value in zip(LinkMotion._fields, chain, strict=False):
            self.scratch.write(getattr(Chain, name), value, i)

    def store_before(self, i: Any, chain: tuple) -> None:
        """Stores how a link moved as the last step ended.

        Args:
          i: Number of the link.
          chain: Values of `residual.Before`, shaped as `store_chain` takes them.
        """
        for name, value in zip(Before._fields, chain, strict=True):
            self.scratch.write(getattr(ChainBefore, name), value, i)

    def reverse(
        self, arm: Lanes, pressure: Lanes, moved: jax.Array, shown: TraceCotangents
    ) -> Lanes:
        """Makes the cotangents of the state after the step those of the state before it.

        Args:
          arm: Commands of the arm; `pressure`: of the chambers, whose cotangents stay behind as
            "pressure".
          moved: Worlds that took the step; the state of the others is the same before and after.
          shown: Cotangents of the trace's entries.

        Returns:
          Cotangents of the arm's commands.
        """
        layout = self.layout
        bars = self.bars
        bars.begin()
        assembly = self.assemble(arm, pressure)
        state = assembly.state
        bodies = assembly.bodies
        now = bodies["now"]
        go = lanes([moved], (), wide=False)
        before, acc_bar = self._integration(state, bodies, now, go)
        if layout.held:
            friction_memory.reverse(self, assembly.contacts, bars, go)
        # The right side of wrist and object stands in the place of their only forces.
        right = {"smooth_wrist": acc_bar[0], "smooth_object": acc_bar[1]}
        right["smooth_palm"] = _none(bodies["palm"].smooth_palm)
        problem = Problem(self, assembly.contacts, bodies["palm"]._replace(**right))
        virtual = AdjointSolve(problem).solve()
        ContactsVjp(self, assembly, virtual, bars).run(pressure)
        sweep = ResidualVjp(self, assembly, bars)
        metered = layout.scene.effects.air_mass
        end = chambers.end_pressures(self, pressure) if metered else pressure
        base, wrist = sweep.fingers(end, self._centre_bar(assembly.centre, shown.distance))
        if metered:
            chambers.reverse(self, bars, pressure)
        base = sweep.with_contacts(base, layout.links + 1)
        before = before | plus({n: before[n] for n in wrist}, wrist)
        return self._palm_bars(state, arm, base, before, (now, virtual, acc_bar[0]), shown)

    def _integration(
        self, state: dict, bodies: dict, now: Iterate, go: Lanes
    ) -> tuple[dict, tuple]:
        """Cotangents of the state that the integration starts at, and of the accelerations.

        Of wrist and object; those of the fingers' accelerations go to the scratch table, "acc_bar".
        """
        layout = self.layout
        h = self.layout.scene.discretization.timestep
        old = {n: state[n] for n in MOVED}
        after = {n: self.bars.world_state.read(n) for n in MOVED}
        given = old, bodies["columns"], now.wrist, now.object_acc
        run = partial(body_after_step, h)
        state_bars, columns, wrist, obj = pull(run, given, (), only_on(go, after))
        self.bars.add_once({"columns": columns})

        def joint(i: Any, x: Any) -> Any:
            given = tuple(self.joint(i).values())
            bars = [self.bars.finger_state.read(n, i) for n in JOINT[:2]]
            *new, acc = pull(partial(_joint_after_step, h), given, (), only_on(go, bars))
            for name, new_bar, bar in zip(JOINT, new, bars, strict=False):
                value = lanewise(jnp.where, go, new_bar, bar)
                self.bars.finger_state.write(name, value, i)
            self.scratch.write(Virtual.acc_bar, acc, i)
            return x

        jax.lax.fori_loop(0, layout.links, joint, jnp.int32(0))
        before = {n: lanewise(jnp.where, go, state_bars[n], after[n]) for n in MOVED}
        return before, (wrist, obj)

    def _centre_bar(self, centre: Lanes, bar: jax.Array) -> Lanes:
        """Cotangent of the sum of the segments' weighted centres, of that of the distance."""
        count = self.layout.num_fingers * self.layout.links

        def slope(centre, bar):
            square = dot(centre, centre)
            apart = square > 0
            length = jnp.sqrt(jnp.where(apart, square, 1.0))
            return jnp.where(apart, bar / (count * length), 0.0) * centre

        return lanewise(slope, centre, lanes([bar], (), wide=False))

    def _palm_bars(
        self,
        state: dict,
        arm: Lanes,
        base: LinkMotion,
        before: dict,
        accelerations: tuple,
        shown: TraceCotangents,
    ) -> Lanes:
        """Adds palm, wrist and object; stores their cotangents and returns those of the arm."""
        layout = self.layout
        now, virtual, wrist_bar = accelerations
        fixed = {"acc_wrist": now.wrist, "acc_object": now.object_acc}
        fixed |= {"virtual_wrist": virtual.wrist, "object_along": virtual.object_acc}
        of_fingers = "pressure", "grown"
        step_bars = {n: self.bars.of_step(n) for n in self.bars.names if n not in of_fingers}
        base, step_bars = self.block.sum((base, step_bars))
        unit = lanes([self.like + 1.0], (), wide=False)
        given = {n: state[n] for n in MOVED}, arm, self.palm_constants()
        run = partial(residual.of_palm, layout.scene.discretization.timestep)
        acc = wrist_bar if not layout.scene.effects.wrist else lanewise(jnp.zeros_like, wrist_bar)
        height = lanes([shown.height], (), wide=False)
        bars = base, step_bars["columns"], step_bars["object_vel"], height, acc, unit
        state_bars, arm_bar, constant_bars = pull(run, given, (fixed,), bars)
        self.bars.add_once(constant_bars)
        state_bars["position"] = plus(state_bars["position"], step_bars["position"])
        for name, value in plus(state_bars, before).items():
            self.bars.world_state.write(name, value)
        any_of(shown.speed != 0, lambda: add_speed_cotangent(self, self.bars, state, shown.speed))
        return arm_bar


def _joint_after_step(h: float, q, rate, acc):
    rate, q, _ = joint_after_step(h, q, rate, acc)
    return q, rate


ITERATIONS = 300
"""Largest number of conjugate gradients: more than Newton's method needs, whose steps may err."""


class AdjointSolve(Elimination):
    """The elimination with right sides in the place of forces; contacts give their stiffness alone.

    The right side of the fingers' joints is read from the scratch table, "acc_bar"; that of wrist
    and object stands in the place of their smooth forces.
    """

    def accelerations(self, i: Any, alpha: Lanes) -> list[Lanes]:
        return [_none(v) for v in self.problem.read(Virtual.acc_bar, Scratch.link_acc, item=i)]

    def smooth(self, i: Any) -> list[Lanes]:
        smooth, right = self.problem.read(Scratch.smooth, Virtual.acc_bar, item=i)
        return [_none(smooth), right]

    def of_contacts(self, contacts: ContactList, item: Item, alpha: Lanes) -> tuple[Lanes, Lanes]:
        matrix, wrench = contacts.inertia_and_wrench(item, alpha)
        if contacts.layout.holds:
            return matrix, friction_memory.wrench_of_cotangents(self.problem, contacts, item)
        return matrix, _none(wrench)

    def between_fingers(self, sides: Sides, between: ContactList, alpha: Lanes) -> None:
        sides.update_constraints(between, alpha)
        if friction_memory.pairings(self.problem.memory):
            friction_memory.load_cotangents(self.problem, sides, between)
        else:
            sides.clear()

    def solve(self) -> Iterate:
        """Virtual accelerations of the wrist, and those of palm and object.

        Those of the fingers stay behind as "virtual" of the joints and "chain.along" of the links.
        """
        problem = self.problem
        size = self.block.size
        no_step = zeros((), self.like)
        node, work = self.backward(no_step, problem.self_contacts)
        palm = problem.palm
        none = Iterate(*(_none(v) for v in (palm.smooth_wrist, *[palm.smooth_object] * 2)))
        step, done = self.at_palm(none, node, self.of_dealt_contacts(no_step))
        if (self_contacts := problem.self_contacts) is not None:
            done = done._replace(work=lanewise(jnp.add, done.work, work))
            exact = float(jnp.finfo(self.like.dtype).eps) ** 1.5
            coupling = Coupling(
                problem, self_contacts, done, tolerance=exact, iterations=ITERATIONS
            )
            idle = jnp.zeros_like(self.like) > 0
            touching = self_contacts.touching_now()
            step = choose(touching, lambda: coupling.correct(step, idle), step, size)
        self._substitute(step)
        return step

    def _substitute(self, step: Iterate) -> None:
        problem = self.problem

        def link(i: Any, parent: Lanes) -> Lanes:
            axes, *factors = problem.read(Scratch.axes, Scratch.w, Scratch.g, Scratch.z, item=i)

            def move(axes, factors, parent, obj):
                return el.substitute(axes, el.Factors(*factors), parent, obj)

            virtual, along = lanewise(move, axes, factors, parent, step.object_acc)
            problem.write(Virtual.virtual, virtual, i)
            problem.write(Chain.along, along, i + 1)
            return along

        parent = problem.widened(step.palm_acc)
        problem.write(Chain.along, parent, 0)
        loop(self.links, link, parent, self.block.size)


def _none(value: Lanes) -> Lanes:
    return lanewise(jnp.zeros_like, value)


VELOCITIES = ("wrist_vel", "linear_vel", "angular_vel")


def add_speed_cotangent(
    step: StepMemory, bars: CotangentTables, state: dict[str, Lanes], bar: jax.Array
) -> None:
    """Adds the cotangent of the trace's speed; equal velocities share it."""
    layout = step.layout
    top = _folded(step, state, _largest, jnp.maximum)
    number = _folded(step, state, _count, jnp.add, top)
    each = lanewise(_divided, lanes([bar], (), wide=False), number)

    def link(i: Any, x: Any) -> Any:
        bars.add_joint({"finger_vel": lanewise(_slope, _rates(step, i), top, each)}, i)
        return x

    jax.lax.fori_loop(0, layout.links, link, jnp.int32(0))
    for name in VELOCITIES:
        old = bars.world_state.read(name)
        bars.world_state.write(name, plus(old, lanewise(_slope, state[name], top, each)))


def _rates(step: StepMemory, i: Any) -> Lanes:
    return step.finger_state.read(FingerState.finger_vel, i)


def _folded(
    step: StepMemory, state: dict[str, Lanes], function: Callable, combine: Callable, *more: Lanes
) -> Lanes:
    """function(x, velocities, *more) folded over all velocities of a world."""
    layout = step.layout

    def link(i: Any, x: Lanes) -> Lanes:
        return lanewise(function, x, _rates(step, i), *more)

    first = zeros((), step.like)
    result = lanes(
        [step.block.fold(loop(layout.links, link, first, layout.size).lane, combine)],
        (),
        wide=False,
    )
    for name in VELOCITIES:
        result = lanewise(function, result, state[name], *more)
    return result


def _largest(x, velocities):
    for k in range(velocities.shape[0]):
        x = jnp.maximum(x, jnp.abs(velocities[k]))
    return x


def _count(x, velocities, top):
    for k in range(velocities.shape[0]):
        x = x + jnp.where(jnp.abs(velocities[k]) == top, 1.0, 0.0)
    return x


def _divided(bar, number):
    return bar / jnp.maximum(number, 1.0)


def _slope(velocities, top, each):
    sign = jnp.where(velocities > 0, 1.0, jnp.where(velocities < 0, -1.0, 0.0))
    return jnp.where(jnp.abs(velocities) == top, sign * each, 0.0)
