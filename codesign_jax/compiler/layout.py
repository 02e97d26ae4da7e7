"""What a kernel's arrays are: shape and type of a block, direction, and whether blocks share it."""

from typing import NamedTuple

import numpy as np

INPUT, OUTPUT, SCRATCH, ONCHIP = "input", "output", "scratch", "onchip"


class Array(NamedTuple):
    """One array of a kernel.

    Attributes:
      shape: Shape of the block that the kernel sees; the array has one axis more, in front.
      dtype: Name of its type, such as "float32".
      role: `INPUT`; `OUTPUT`; `SCRATCH`, memory of a block that nobody reads afterwards; or
        `ONCHIP`, the same in a GPU's shared memory.
      shared: Whether all blocks read the same block (an input's leading axis is 1).
      exchanged: Whether lanes read there what other lanes write, at places that differ.
    """

    shape: tuple[int, ...]
    dtype: str
    role: str = INPUT
    shared: bool = False
    exchanged: bool = False

    @property
    def bytes(self) -> int:
        """Size of a block."""
        return int(np.prod(self.shape, dtype=np.int64)) * np.dtype(self.dtype).itemsize

    def __str__(self) -> str:
        """Type and shape as a message names them."""
        axes = ", ".join(str(n) for n in ("1" if self.shared else "blocks", *self.shape))
        return f"{self.role} {self.dtype}[{axes}]"


class Layout(NamedTuple):
    """All arrays of a kernel; nothing here depends on the number of blocks.

    Attributes:
      arrays: The arrays, inputs first, in the order of the kernel's arguments.
      lanes: Lanes of a block.
    """

    arrays: tuple[Array, ...]
    lanes: int

    @property
    def blocks(self) -> list[tuple[tuple[int, ...], np.dtype]]:
        """Shape and type of a block of each array."""
        return [(a.shape, np.dtype(a.dtype)) for a in self.arrays]

    def of(self, *roles: str) -> list[int]:
        """Places of the arrays of these roles."""
        return [k for k, a in enumerate(self.arrays) if a.role in roles]
