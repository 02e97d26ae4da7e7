"""Fingers of a block in pairs, and how their lanes exchange numbers."""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.memory import Block, solid


class Pairing:
    """Fingers in pairs: those whose numbers differ by an exclusive or with the row's number + 1.

    Attributes:
      lane: Lane of the finger that each lane's finger is paired with, shape (lane,).
    """

    def __init__(self, block: Block, row: Any):
        """Takes the row, a scalar."""
        self.block = block
        self.number = (jnp.zeros_like(block.finger) + (row + 1)).astype(jnp.int32)
        other = jax.lax.bitwise_xor(block.finger, self.number)
        self.lane = other * block.worlds + block.world

    def swap(self, tree: Any) -> Any:
        """What the lanes that the lanes are paired with have, of a tree of lanes.

        Lanes exchange registers, once for each binary digit of the pairing's number: through memory
        a lane would have to wait until its partner has written.
        """
        block = self.block
        arrays, rebuild = solid(tree, block.size)
        for digit in range(block.fingers.bit_length() - 1):
            distance = block.worlds << digit
            chosen = jax.lax.bitwise_and(self.number, jnp.int32(1 << digit)) > 0
            arrays = [
                jnp.where(chosen, jax.lax.rev(a.reshape(-1, 2, distance), (1,)).reshape(-1), a)
                for a in arrays
            ]
        return rebuild(arrays)
