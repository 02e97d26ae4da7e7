"""A kernel's arrays, and the operands of the instructions that it is written as."""

from typing import Any, NamedTuple

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


LLVM_TYPES = {"f32": "float", "f64": "double", "i32": "i32", "i64": "i64", "b": "i1"}
"""LLVM's scalar types by kind."""

_KINDS = {"float32": "f32", "float64": "f64", "int32": "i32", "int64": "i64", "bool": "b"}
SIZES = {"f32": 4, "f64": 8, "i32": 4, "i64": 8}
"""Bytes of an element in memory, by kind; truth values are not stored."""


class Value(NamedTuple):
    """An operand of an instruction.

    Attributes:
      kind: "f32", "f64", "i32", "i64", or "b" for a truth value.
      wide: Whether it may differ between the lanes.
      text: Its LLVM name; None if its value is known when the kernel is written.
      known: Without a name its value: a number, or an array over the lanes. With a name a number
        that is to be added to what the name holds (i32 only), so that addresses get constant
        offsets.
    """

    kind: str
    wide: bool
    text: str | None
    known: Any = 0

    @property
    def is_known(self) -> bool:
        """Whether the value is a number or an array of numbers."""
        return self.text is None


class Ref(NamedTuple):
    """A block's part of an array in memory.

    Attributes:
      address: LLVM name of its address.
      shape: Its shape.
      kind: Kind of its elements.
      space: LLVM's address space: on a GPU 1 is global and 3 shared memory.
      exchanged: Whether lanes read there what other lanes write.
    """

    address: str
    shape: tuple[int, ...]
    kind: str
    space: int = 1
    exchanged: bool = False


def kind_of(dtype: Any) -> str:
    """Kind of a dtype's elements.

    Raises:
      NotImplementedError: If kernels have no such dtype.
    """
    name = np.dtype(dtype).name
    if name not in _KINDS:
        raise NotImplementedError(
            f"kernels have no dtype {name}; convert to one of {', '.join(_KINDS)}"
        )
    return _KINDS[name]


def numpy_type(kind: str) -> Any:
    """NumPy's scalar type of a kind."""
    return next(np.dtype(name).type for name, k in _KINDS.items() if k == kind)


def is_float(kind: str) -> bool:
    """Whether a kind is a floating-point one."""
    return kind[0] == "f"
