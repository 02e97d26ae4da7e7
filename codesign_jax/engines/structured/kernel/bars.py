"""Cotangents of a block's tables, to which the reverse pass adds."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.memory import Block
from codesign_jax.engines.structured.kernel.pull import only_on, plus
from codesign_jax.engines.structured.lanewise import Lanes, lanes
from codesign_jax.scene import Scene

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.adjoint import AdjointProgram

STEP = {"columns": (3, 3), "object_vel": (6,), "height": (), "pressure": ()}
"""What several parts of a step add to, beside constants: names and shapes."""


def of_step(scene: Scene) -> dict[str, tuple[int, ...]]:
    """`STEP`, with the object's place where fixtures are touched."""
    return STEP | ({"position": (3,)} if scene.fixture else {})


class Bars:
    """Cotangents by the name of what they belong to.

    Attributes:
      hand: Memory of the hand's constants, laid out as those.
      world: That of the worlds' constants, with a value for each finger, to be summed.
      finger_state: Of the fingers' state after the step, then before it.
      world_state: Likewise of wrist and object.
    """

    def __init__(self, program: "AdjointProgram", block: Block, refs: tuple, scratch: Any):
        """Takes the kernel's memory: refs in the order of the attributes, and scratch memory."""
        self.p, self.block, self.scratch = program, block, scratch
        self.hand, self.world, self.finger_state, self.world_state = refs
        self.like = jnp.zeros((program.size,), scratch.dtype)
        self.names = of_step(program.scene)

    def begin(self) -> None:
        """Sets to zero what belongs to one step."""
        for name, shape in self.names.items():
            self.p.scratch.write(self.scratch, f"bar.{name}", zeros(shape, self.like))

    def of_step(self, name: str) -> Lanes:
        """What was added to a name of `STEP`, on each lane."""
        return self.p.scratch.read(self.scratch, f"bar.{name}")

    def add(self, values: dict[str, Lanes], item: Any = 0, lane: jax.Array | None = None) -> None:
        """Adds to the cotangents of constants and of what `STEP` names.

        Args:
          values: What to add, by name.
          item: Item of each name, such as the number of a link.
          lane: The lanes, if items differ from lane to lane.
        """
        for name, value in values.items():
            table, ref, name = self._place(name)
            if lane is None:
                table.write(ref, name, plus(table.read(ref, name, item), value), item)
            else:
                old = table.gather(ref, name, item, lane)
                table.scatter(ref, name, plus(old, value), item, lane)

    def add_once(self, values: dict[str, Lanes]) -> None:
        """`add` of what all lanes of a world have alike."""
        first = lanes([self.block.finger == 0], (), wide=True)
        self.add({name: only_on(first, value) for name, value in values.items()})

    def add_joint(self, values: dict[str, Lanes], i: Any) -> None:
        """Adds to the cotangents of a joint's angles or velocities."""
        table, ref = self.p.finger_state, self.finger_state
        for name, value in values.items():
            table.write(ref, name, plus(table.read(ref, name, i), value), i)

    def _place(self, name: str) -> tuple:
        if name in self.names:
            return self.p.scratch, self.scratch, f"bar.{name}"
        if name in self.p.hand.groups:
            return self.p.hand, self.hand, name
        return self.p.world_bars, self.world, name
