"""One time step of a block of worlds in reverse: cotangents of its end to those of its start."""

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import advance, chambers, grip_sweep, powers, speed
from codesign_jax.engines.structured.kernel.bars import Bars
from codesign_jax.engines.structured.kernel.memory import Block
from codesign_jax.engines.structured.kernel.pair_sweep import PairSweep
from codesign_jax.engines.structured.kernel.powers import Chain
from codesign_jax.engines.structured.kernel.problem import Iterate, Problem
from codesign_jax.engines.structured.kernel.pull import only_on, plus, pull
from codesign_jax.engines.structured.kernel.slots import any_of
from codesign_jax.engines.structured.kernel.step import Step
from codesign_jax.engines.structured.kernel.sweep import Sweep
from codesign_jax.engines.structured.kernel.virtual import Virtual, palm_problem
from codesign_jax.engines.structured.lanes import dot
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.adjoint import AdjointProgram

MOVED = ("wrist", "position", "quat", "wrist_vel", "linear_vel", "angular_vel")
"""Positions and velocities of wrist and object."""
JOINT = ("finger", "finger_vel", "acc")
"""Angles, velocities and accelerations of the fingers' joints."""


class Shown(NamedTuple):
    """Cotangents of what the trace shows of the state before a step, numbers of a world."""

    distance: jax.Array
    height: jax.Array
    speed: jax.Array


class ReverseStep(Step):
    """A step in reverse.

    It goes from the step's start, with the accelerations that solve it as warm start, to the tips
    as the forward pass does, solves for the virtual accelerations, and goes back to the palm.
    """

    def __init__(self, program: "AdjointProgram", block: Block, refs: tuple, bars: Bars):
        """Takes the kernel's memory, see `Step`, and the cotangents."""
        super().__init__(program, block, *refs)  # type: ignore[misc]
        self.bars, self.like = bars, jnp.zeros((program.size,), bars.scratch.dtype)

    def keep(self, i: Any, chain: tuple) -> None:
        """See `Step`."""
        for name, value in zip(Chain._fields, chain, strict=False):
            self.p.scratch.write(self.scratch, f"chain.{name}", value, i)

    def reverse(self, arm: Lanes, pressure: Lanes, moved: jax.Array, shown: Shown) -> Lanes:
        """Makes the cotangents of the state after the step those of the state before it.

        The cotangents of the pressures stay behind as the bars' "pressure".

        Args:
          arm: As in `Step.advance`.
          pressure: As in `Step.advance`.
          moved: Worlds that took the step; the state of the others is the same before and after.
          shown: Cotangents of the trace's entries.

        Returns:
          Cotangents of the arm's commands.
        """
        p, block, bars = self.p, self.block, self.bars
        bars.begin()
        state, at, thing, m, now, centre = self.assemble(arm, pressure)
        go = lanes([moved], (), wide=False)
        before, acc_bar = self._integration(state, at, now, go)
        if p.held:
            grip_sweep.reverse(self, m.contacts["finger_finger"], go)
        forces = palm_problem(at["palm"], *acc_bar)
        problem = Problem(p.links, block, m, forces, rigid=not p.scene.effects.wrist)
        virtual = Virtual(problem).solve()
        sweep = Sweep(self, m, state, at, thing, virtual, bars)
        if problem.pairs:
            PairSweep(sweep, problem.pairs).run()
        metered = p.scene.effects.air_mass
        end = chambers.end_pressures(self, pressure) if metered else pressure
        base = sweep.fingers(end, self._centre_bar(centre, shown.distance))
        if metered:
            chambers.reverse(self, pressure)
        base = sweep.palm_and_table(base)
        return self._palm_bars(state, arm, base, before, (now, virtual, acc_bar[0]), shown)

    def _integration(self, state: dict, at: dict, now: Iterate, go: Lanes) -> tuple[dict, tuple]:
        """Cotangents of the accelerations, and of the state that the integration starts at.

        Those of the fingers' accelerations go to the scratch table, "acc_bar".

        Returns:
          Cotangents of positions and velocities of wrist and object, and those of the wrist's and
          the object's accelerations.
        """
        p, h = self.p, self.p.scene.discretization.timestep
        old = {n: state[n] for n in MOVED}
        after = {
            n: p.world_state.read(self.bars.world_state, n, 0, self.block.world) for n in MOVED
        }
        given = old, at["columns"], now.wrist, now.object_motion
        run = partial(advance.moved, h)
        own, columns, wrist, obj = pull(run, given, (), only_on(go, after))
        self.bars.add_once({"columns": columns})

        def joint(i: Any, x: Any) -> Any:
            given = tuple(p.finger_state.read(self.finger_state, n, i) for n in JOINT)
            bars = [p.finger_state.read(self.bars.finger_state, n, i) for n in JOINT[:2]]
            *new, acc = pull(partial(_turned, h), given, (), only_on(go, bars))
            for name, one, other in zip(JOINT, new, bars, strict=False):
                value = lanewise(jnp.where, go, one, other)
                p.finger_state.write(self.bars.finger_state, name, value, i)
            p.scratch.write(self.scratch, "acc_bar", acc, i)
            return x

        jax.lax.fori_loop(0, p.links, joint, jnp.int32(0))
        before = {n: lanewise(jnp.where, go, own[n], after[n]) for n in MOVED}
        return before, (wrist, obj)

    def _centre_bar(self, centre: Lanes, bar: jax.Array) -> Lanes:
        """Cotangent of the sum of the segments' weighted centres, of that of the distance."""
        count = self.p.num_fingers * self.p.links

        def slope(centre, bar):
            square = dot(centre, centre)
            apart = square > 0
            length = jnp.sqrt(jnp.where(apart, square, 1.0))
            return jnp.where(apart, bar / (count * length), 0.0) * centre

        return lanewise(slope, centre, lanes([bar], (), wide=False))

    def _palm_bars(
        self, state: dict, arm: Lanes, base: Chain, before: dict, accelerations: tuple, shown: Shown
    ) -> Lanes:
        """Adds palm, wrist and object; stores their cotangents and returns those of the arm."""
        p, (now, virtual, wrist_bar) = self.p, accelerations
        still = {"acc_wrist": now.wrist, "acc_object": now.object_motion}
        still |= {"virtual_wrist": virtual.wrist, "object_along": virtual.object_motion}
        own = {n: self.bars.of_step(n) for n in self.bars.names if n != "pressure"}
        base, own = self.block.sum((base, own))
        one = lanes([self.like + 1.0], (), wide=False)
        given = {n: state[n] for n in MOVED}, arm, self.palm_constants()
        run = partial(powers.of_palm, p.scene.discretization.timestep)
        acc = wrist_bar if not p.scene.effects.wrist else lanewise(jnp.zeros_like, wrist_bar)
        height = plus(own["height"], lanes([shown.height], (), wide=False))
        bars = base, own["columns"], own["object_vel"], height, acc, one
        found, arm_bar, constant_bars = pull(run, given, (still,), bars)
        self.bars.add_once(constant_bars)
        if p.scene.fixture:
            found["position"] = plus(found["position"], own["position"])
        for name, value in plus(found, before).items():
            p.world_state.write(self.bars.world_state, name, value, 0, self.block.world)
        any_of(shown.speed != 0, lambda: speed.add(self, state, shown.speed))
        return arm_bar


def _turned(h: float, q, rate, acc):
    rate, q, _ = advance.turned(h, q, rate, acc)
    return q, rate
