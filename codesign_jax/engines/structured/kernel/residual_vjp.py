"""The reverse pass of a step through `residual`: fingers from the tips inwards, and their mounts.

Cotangents of bodies by their contacts have been left by `contacts_vjp` before.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import residual
from codesign_jax.engines.structured.kernel.body_motion import WRIST, bases_before
from codesign_jax.engines.structured.kernel.cotangents import CotangentTables, plus, pull
from codesign_jax.engines.structured.kernel.kinds import BodyMotion
from codesign_jax.engines.structured.kernel.memory import choose, loop, zeros
from codesign_jax.engines.structured.kernel.residual import Before, FastMotion, LinkMotion
from codesign_jax.engines.structured.kernel.rows import (
    BodyBar,
    Chain,
    ChainBefore,
    Hand,
    Virtual,
)
from codesign_jax.engines.structured.kernel.step import Assembly, Step
from codesign_jax.engines.structured.kernel.step_memory import FINGER_CONSTANTS, LINK_CONSTANTS
from codesign_jax.engines.structured.lanes import apply_columns
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws.kinematics import mounted

SHAPES = LinkMotion(*(getattr(Chain, name).shape for name in LinkMotion._fields))


class ResidualVjp:
    """Adds a step's part of the cotangents, given its virtual accelerations."""

    def __init__(
        self,
        step: Step,
        assembly: Assembly,
        bars: CotangentTables,
    ):
        """Prepares the sweep.

        Args:
          step: The step's memory, with its virtual accelerations.
          assembly: What `Step.assemble` returns.
          bars: The tables of cotangents.
        """
        self.step = step
        self.layout = step.layout
        self.bodies = assembly.bodies
        self.fast = assembly.fast
        self.scratch = step.scratch
        self.bars = bars
        self.block = step.block
        self.like = step.like
        self.power_bar = lanes([self.like + 1.0], (), wide=True)
        self.wrist = {n: assembly.state[n] for n in WRIST}

    def chain(self, i: Any) -> LinkMotion:
        """What the link before joint i hands on."""
        names = (getattr(Chain, n) for n in LinkMotion._fields)
        return LinkMotion(*(self.scratch.read(n, i) for n in names))

    def fingers(self, pressure: Lanes, centre_bar: Lanes) -> tuple[LinkMotion, dict[str, Lanes]]:
        """From the tips inwards; cotangents of what the palm hands on, on each lane.

        Also returns those of `WRIST` by the momenta that fast links carry over.
        """
        layout = self.layout
        tips = self.layout.links

        def link(i: Any, after: LinkMotion) -> LinkMotion:
            return self.with_contacts(self._link(i, after, pressure, centre_bar), i)

        after = LinkMotion(*(zeros(shape, self.like) for shape in SHAPES))
        after = self.with_contacts(after, tips)
        base = loop(tips, link, after, layout.size, reverse=True)
        base, wrist = self._fast_links(base)
        return self._mount(base, centre_bar), wrist

    def none(self, name: str) -> Lanes:
        """A cotangent of zero of a field of `LinkMotion`."""
        return zeros(getattr(SHAPES, name), self.like)

    def with_contacts(self, bars: LinkMotion, row: Any) -> LinkMotion:
        """Adds what contacts have left for a body, see `rows.BodyBar`."""
        names = BodyMotion._fields
        return _add(bars, **{n: self.scratch.read(getattr(BodyBar, n), row) for n in names})

    def _link(self, i: Any, after: LinkMotion, pressure: Lanes, centre_bar: Lanes) -> LinkMotion:
        numbers = self.step.link_constants(i)
        joint = self.step.joint(i)
        fixed = {"acc": joint.pop("acc"), "order": self.step.order(i)}
        fixed["virtual"] = self.scratch.read(Virtual.virtual, i)
        weight = self.step.hand.read(Hand.centre_weight, i + 1)
        fixed["centre_bar"] = lanewise(jnp.multiply, centre_bar, weight)
        run = partial(residual.of_link, self.layout.scene)
        joint = joint | {"pressure": pressure}
        before, bars, moved = pull(
            run, (self.chain(i), numbers, joint), (fixed,), (after, self.power_bar)
        )
        self.bars.add({n: bars.pop(n) for n in LINK_CONSTANTS}, i)
        sections = {n: bars.pop(n) for n in FINGER_CONSTANTS if n in bars}
        self.bars.add(sections, i if self.layout.tapered else 0)
        self.bars.add(bars | {"pressure": moved.pop("pressure")})
        self.bars.add_joint(moved, i)
        return before

    def _fast_links(self, base: LinkMotion) -> tuple[LinkMotion, dict[str, Lanes]]:
        """Adds the momenta that links carry over to what the fingers' bases hand on.

        Also returns their cotangents of `WRIST`.
        """
        wrist = {n: zeros(value.shape[:1], self.like) for n, value in self.wrist.items()}
        empty = FastMotion(*(self.none(n) for n in FastMotion._fields)), wrist
        bars, wrist = choose(self.fast, self._carried_momenta, empty, self.layout.size)
        return _add(base, **bars._asdict()), self.block.sum(wrist)

    def _carried_momenta(self) -> tuple[FastMotion, dict[str, Lanes]]:
        run = partial(residual.of_fast_link, self.layout.scene)

        def link(i: Any, after: tuple) -> tuple:
            chain = self.chain(i)
            now = FastMotion(*(getattr(chain, n) for n in FastMotion._fields))
            before = Before(
                *(self.scratch.read(getattr(ChainBefore, n), i) for n in Before._fields)
            )
            constants = self.step.link_constants(i)
            numbers = {n: constants[n] for n in ("offset", "mass", "centre", "inertia")}
            joint = self.step.joint(i)
            fixed = {"order": self.step.order(i), "virtual": self.scratch.read(Virtual.virtual, i)}
            del joint["acc"]
            given = now, before, numbers, joint
            *bars, numbers, joint = pull(run, given, (fixed,), (*after, self.power_bar))
            self.bars.add(numbers, i)
            self.bars.add_joint(joint, i)
            return tuple(bars)

        tips = (t(*(self.none(n) for n in t._fields)) for t in (FastMotion, Before))
        now, before = loop(self.layout.links, link, tuple(tips), self.layout.size, reverse=True)
        names = ("mount", "base")
        given = *self.wrist.values(), *(self.step.hand.read(n) for n in names)
        run = partial(bases_before, self.layout.scene.discretization.timestep)
        *wrist, mount, place = pull(run, given, (), tuple(before))
        self.bars.add({"mount": mount, "base": place})
        return now, dict(zip(self.wrist, wrist, strict=True))

    def _mount(self, base: LinkMotion, centre_bar: Lanes) -> LinkMotion:
        read = self.step.hand.read
        names = ("mount", "base", "stub_centre")
        palm = self.bodies["place"], self.bodies["frame"]

        def run(palm, mount, base, stub, weight):
            place, frame = palm
            turned, origin = mounted(place, frame, mount, base)
            middle = place + apply_columns(frame, stub)
            return turned, origin, sum(weight[k] * middle[k] for k in range(3))

        weight = lanewise(jnp.multiply, centre_bar, read(Hand.centre_weight))
        given = (palm, *(read(n) for n in names))
        (place, frame), *bars = pull(
            run, given, (weight,), (base.frame, base.origin, self.power_bar)
        )
        self.bars.add(dict(zip(names, bars, strict=True)))
        return base._replace(origin=place, frame=frame)


def _add(bars: LinkMotion, **more: Lanes) -> LinkMotion:
    old = {n: getattr(bars, n) for n in more}
    return bars._replace(**plus(old, more))
