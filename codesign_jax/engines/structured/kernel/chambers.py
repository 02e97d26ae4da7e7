"""Chambers with a mass of air inside the kernel: a stiffness of rank one for each finger.

The pressure at a step's end is linear in the accelerations a, see `laws.air`, so that a finger adds
c/2 (g'a)^2 to the objective, g the moments per pressure of its bend hinges.  That is the largest
value of l g'a - l^2/(2 c) over a pressure l.  What the elimination of the joints leaves is linear
in l: forces r - l r_1 on the palm and r_o - l r_o1 on the object, where a pressure of one is a
further right side.  With its forces y_1 on the joints, D^-1 of `elimination`, s = sum y_1'z and
e = sum y_1'D^-1 y_1 the best pressure is l = w (s + r_1'v + r_o1'v_o), w = c / (1 + c e), for
accelerations v and v_o of palm and object.  These two get the square of the sum, times w/2, and
once they are known the joints get z - l D^-1 y_1.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import elimination as el
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables, pull
from codesign_jax.engines.structured.kernel.memory import loop, upper, zeros
from codesign_jax.engines.structured.kernel.rows import (
    Again,
    Air,
    Field,
    FingerState,
    Hand,
    Scratch,
    StepBar,
    WorldOptions,
)
from codesign_jax.engines.structured.kernel.step_memory import StepMemory
from codesign_jax.engines.structured.lanes import contract, dot
from codesign_jax.engines.structured.lanewise import Lanes, lanewise
from codesign_jax.engines.structured.laws.air import LEAST, end_pressure, power
from codesign_jax.engines.structured.laws.inertia import softening_moment
from codesign_jax.engines.structured.world_model import WorldModel
from codesign_jax.scene import Scene

ROUNDS = 8
"""Newton iterations for the bend of a free neo-Hookean finger. They come from below, as the moment
is concave in the angle."""
JOINT = FingerState.finger, FingerState.finger_vel, FingerState.acc
"""Angles of a joint and their derivatives by time, which move the volume and its derivatives."""


def end_pressures(step: StepMemory, charge: Lanes) -> Lanes:
    """Pressures at a step's end by the accelerations of its warm start; leaves c behind."""
    pressure, stiffness = lanewise(_law(step), *_given(step, charge))
    step.scratch.write(Air.air_stiffness, stiffness)
    step.scratch.write(Air.air_step, lanewise(jnp.zeros_like, stiffness))
    return pressure


def reverse(step: StepMemory, bars: CotangentTables, charge: Lanes) -> None:
    """Makes the cotangents of the pressures at a step's end those of the charges."""
    layout = step.layout
    law = _law(step)
    given = _given(step, charge)
    bar = bars.of_step("pressure")
    charge, volume, air, grown = pull(lambda *v: law(*v)[0], given, (), bar)
    bars.add({Hand.volume: volume, WorldOptions.air: air})
    step.scratch.write(StepBar.pressure, charge)

    def moments(gain, joint, grown):
        turned = [jnp.stack([gain * v] + [0 * v] * (layout.axes - 1)) for v in grown[:2]]
        return turned, sum(joint[n][0] * v for n, v in zip(JOINT, grown, strict=True))

    def link(i: Any, x: jax.Array) -> jax.Array:
        row = i if layout.tapered else 0
        gain = step.hand.read(Hand.gain, row)
        turned, gain_bar = lanewise(moments, gain, step.joint(i), grown)
        bars.add_joint(dict(zip(JOINT[:2], turned, strict=True)), i)
        bars.add({Hand.gain: gain_bar}, row)
        return x

    jax.lax.fori_loop(0, layout.links, link, jnp.int32(0))


def _law(step: StepMemory) -> Callable:
    return partial(end_pressure, step.layout.scene.discretization.timestep)


def _given(step: StepMemory, charge: Lanes) -> tuple:
    layout = step.layout
    like = step.like

    def add(sums, gain, joint):
        return [v + gain * joint[n][0] for v, n in zip(sums, JOINT, strict=True)]

    def link(i: Any, sums: list[Lanes]) -> list[Lanes]:
        gain = step.hand.read(Hand.gain, i if layout.tapered else 0)
        return lanewise(add, sums, gain, step.joint(i))

    grown = loop(layout.links, link, [zeros((), like)] * 3, layout.size)
    return charge, step.hand.read(Hand.volume), step.constant(WorldOptions.air), grown


class Chambers:
    """The chambers' part of a step's problem."""

    def __init__(self, step: StepMemory):
        self.step = step
        self.links = step.layout.links
        self.size = step.block.size

    def move(self, alpha: Lanes) -> None:
        """Moves the pressures, which are part of "tau", by the last step, and forgets that step."""
        fall = lanewise(
            lambda c, a, t: c * a * t, *self._of_finger(Air.air_stiffness, Air.air_step), alpha
        )

        def push(tau, gain, fall):
            return jnp.concatenate([tau[:1] - gain * fall, tau[1:]])

        self._change(Scratch.tau, push, Hand.gain, fall)
        self.step.write(Air.air_step, lanewise(jnp.zeros_like, fall))

    def close(self, node: el.Quadratic, work: Lanes) -> tuple[el.Quadratic, Lanes]:
        """Adds the chambers to eliminated fingers.

        Args:
          node: What is left of each finger, P and Q as their upper triangles.
          work: Product of the fingers' forces with the step so far.
        """
        none = zeros((6,), self.step.like)

        def again(carry, gain, axes, w, g, inverse):
            r, ro, give = carry
            tau = jnp.stack([gain] + [jnp.zeros_like(gain)] * (len(axes) - 1))
            y = contract(axes, r[None], 1) + tau
            r, ro, new = el.eliminate_again(axes, el.Kept(el.Factors(w, g, y), inverse), r, ro, tau)
            return (r, ro, give + dot(y, new.z)), y

        names = Hand.gain, Scratch.axes, Scratch.w, Scratch.g, Again.inverse

        def link(i: Any, carry: tuple) -> tuple:
            carry, y = lanewise(again, carry, *self._read(i, *names))
            self.step.write(Air.air_joint, y, i)
            return carry

        start = none, none, zeros((), self.step.like)
        palm, obj, give = loop(self.links, link, start, self.size, reverse=True)
        # Stiffness of the air in series with the finger's compliance `give`
        series = lanewise(lambda c, e: c / (1 + c * e), *self._of_finger(Air.air_stiffness), give)
        solved = {Air.air_palm: palm, Air.air_object: obj, Air.air_series: series}
        for name, value in solved.items():
            self.step.write(name, value)

        def square(series, a, b):
            return series * a[:, None] * b[None]

        pp, po, oo = (lanewise(square, series, *v) for v in ((palm, palm), (palm, obj), (obj, obj)))
        r, ro, less = self.close_again(Scratch.z, node.r, node.r_object)
        p = lanewise(jnp.add, node.p, upper(pp))
        q = lanewise(jnp.add, node.q, upper(oo))
        c = lanewise(jnp.subtract, node.c, po)
        work = lanewise(jnp.subtract, work, less)
        return el.Quadratic(p, c, q, r, ro), work

    def close_again(self, z: str, r: Lanes, ro: Lanes) -> tuple[Lanes, Lanes, Lanes]:
        """Adds the chambers to another right side; z: name of the joints' factors.

        Returns:
          The forces that the fingers leave to palm and object, and what the chambers take of the
          product of all forces with the step.
        """
        total = self._sum(dot, Air.air_joint, z)
        self.step.write(Air.air_sum, total)

        def less(r, ro, total, series, palm, obj):
            return r - series * total * palm, ro - series * total * obj, series * total * total

        return lanewise(
            less, r, ro, total, *self._of_finger(Air.air_series, Air.air_palm, Air.air_object)
        )

    def substitute(self, z: str, palm_acc: Lanes, object_acc: Lanes) -> None:
        """Takes the chambers' part from the joints' factors, once palm and object are known."""

        def pressure(series, total, palm, obj, palm_acc, object_acc):
            return series * (total + dot(palm, palm_acc) + dot(obj, object_acc))

        known = self._of_finger(Air.air_series, Air.air_sum, Air.air_palm, Air.air_object)
        change = lanewise(pressure, *known, palm_acc, object_acc)

        def take(z, y, inverse, change):
            return z - change * contract(inverse, y[None], 1)

        self._change(z, take, Air.air_joint, Again.inverse, change)

    def curvature(self) -> Lanes:
        """Curvature along the joints' step, on each finger's lanes; leaves g'a behind."""
        moved = self._sum(lambda gain, a: gain * a[0], Hand.gain, Scratch.step_acc)
        self.step.write(Air.air_step, moved)
        return lanewise(lambda c, a: c * a * a, *self._of_finger(Air.air_stiffness), moved)

    def _of_finger(self, *names: Field) -> list[Lanes]:
        return [self.step.read(n) for n in names]

    def _read(self, i: Any, *names: Any) -> list[Lanes]:
        row = {Hand.gain: i if self.step.layout.tapered else 0}
        read = self.step.read
        return [read(n, row.get(n, i)) if isinstance(n, Field) else n for n in names]

    def _change(self, name: str, function: Callable, *names: Any) -> None:
        """Replaces what is kept of each joint by a function of it and of more."""

        def link(i: Any, x: jax.Array) -> jax.Array:
            self.step.write(name, lanewise(function, *self._read(i, name, *names)), i)
            return x

        jax.lax.fori_loop(0, self.links, link, jnp.int32(0))

    def _sum(self, function: Callable, *names: str) -> Lanes:
        """Sum over the joints of a function of what is kept of each."""

        def link(i: Any, total: Lanes) -> Lanes:
            return lanewise(lambda t, *v: t + function(*v), total, *self._read(i, *names))

        return loop(self.links, link, zeros((), self.step.like), self.size)


def charged(scene: Scene, hand: WorldModel, ctrl: jax.Array) -> jax.Array:
    """Controls (world, time, nu) with charges, see `end_pressure`, in the place of pressures.

    A chamber gets the mass of air that has the wanted pressure while the finger bends freely.
    """
    assert hand.air is not None and hand.section is not None and hand.volume is not None
    # (time, finger, world)
    wanted = jnp.moveaxis(ctrl[..., 6:], 0, -1)
    links = len(hand.stiffness)
    alike = links // len(hand.gain)  # joints that one number stands for
    grown = jnp.zeros_like(wanted)
    for gain, stiffness, section in zip(
        hand.gain, hand.stiffness[:, 0], hand.section, strict=False
    ):
        softening = section if scene.effects.neo_hookean else None
        grown += alike * gain * _free_angle(gain * wanted, stiffness, softening)
    ratio = 1 + grown / hand.volume
    absolute = jnp.maximum(wanted + hand.air[1], 0.0)
    charge = absolute * power(jnp.maximum(ratio, LEAST), hand.air[0])
    return jnp.concatenate([ctrl[..., :6], jnp.moveaxis(charge, -1, 0)], -1)


def _free_angle(moment: jax.Array, stiffness: jax.Array, section: jax.Array | None) -> jax.Array:
    """Bend angle of a joint under a moment; `section` as in `softening_moment`, or None."""
    angle = moment / stiffness
    if section is None:
        return angle

    def carried(angle: jax.Array) -> jax.Array:
        return stiffness * angle - softening_moment(section, stiffness, angle)

    for _ in range(ROUNDS):
        value, slope = jax.jvp(carried, (angle,), (jnp.ones_like(angle),))
        angle = angle + (moment - value) / slope
    return angle
