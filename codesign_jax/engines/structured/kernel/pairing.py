"""Pairs of fingers, whose lanes process their contact at the same time."""

from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel.memory import Block, solid
from codesign_jax.engines.structured.lanewise import lanes


class FingerPairing:
    """Fingers in pairs: those whose numbers differ by an exclusive or with the pairing's number.

    Each finger is its own partner in the pairing 0, for contacts with itself and with the palm.

    Attributes:
      lane: Lane of the finger that each lane's finger is paired with, shape (lane,).
      itself: Whether a lane's finger is its own partner, shape (lane,); None if it never is.
      half: The fraction of a contact that a lane counts: two fingers' is on two lanes.
    """

    def __init__(self, block: Block, number: Any, dtype: Any, *, with_itself: bool):
        self.block = block
        self.number = (jnp.zeros_like(block.finger) + number).astype(jnp.int32)
        same = self.number == 0
        ones = jnp.ones_like(block.finger, dtype)
        self.itself = same if with_itself else None
        self.half = lanes(
            [jnp.where(same, ones, 0.5 * ones) if with_itself else 0.5 * ones], (), wide=True
        )
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
            distance = block.worlds * block.team << digit
            chosen = jax.lax.bitwise_and(self.number, jnp.int32(1 << digit)) > 0
            arrays = [
                jnp.where(chosen, jax.lax.rev(a.reshape(-1, 2, distance), (1,)).reshape(-1), a)
                for a in arrays
            ]
        return rebuild(arrays)
