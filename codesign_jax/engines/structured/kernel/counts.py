"""How many slots the lanes of a block have filled, in registers."""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.lanes import total


class Counts:
    """Numbers of the slots that lanes have filled: those of all rows in a few integers a lane.

    Every pass through the contacts asks for them. Read from memory, a GPU's thread would wait for
    each of them before it knows whether a row has any contact.

    Attributes:
      words: The integers, int32 of shape (lane,) each.
    """

    def __init__(self, words: list[jax.Array], most: int):
        """Takes the integers and the largest number that a row may have."""
        self.words, self._most = words, most
        self._bits, self._each = _sizes(most)

    @classmethod
    def of_rows(cls, counts: list[jax.Array], most: int) -> "Counts":
        """Packs the rows' numbers, from 0 to `most`, int32 of shape (lane,) each."""
        bits, each = _sizes(most)
        parts = [counts[start : start + each] for start in range(0, len(counts), each)]
        words = [total([n * (1 << bits * k) for k, n in enumerate(part)]) for part in parts]
        return cls(words, most)

    def masked(self, chosen: jax.Array) -> "Counts":
        """The numbers of some lanes, and zero for all others."""
        return Counts([jnp.where(chosen, word, 0) for word in self.words], self._most)

    def of(self, row: jax.typing.ArrayLike) -> jax.Array:
        """A row's numbers, shape (lane,); `row` is a scalar."""
        row, each = jnp.asarray(row, jnp.int32), jnp.int32(self._each)
        which, place = jax.lax.div(row, each), jax.lax.rem(row, each)
        word = self.words[0]
        for k, other in enumerate(self.words[1:], 1):
            word = jnp.where(which == k, other, word)
        distance = jnp.full_like(word, self._bits * place)
        return jax.lax.shift_right_logical(word, distance) & ((1 << self._bits) - 1)


def _sizes(most: int) -> tuple[int, int]:
    """Bits of a row's number, and rows of an integer, whose sign stays free."""
    bits = most.bit_length()
    return bits, 31 // bits
