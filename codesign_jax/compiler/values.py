"""A kernel's arrays, and the operands of the instructions that it is written as."""

from typing import Any, NamedTuple

import numpy as np

INPUT = "input"
OUTPUT = "output"
SCRATCH = "scratch"
ONCHIP = "onchip"


class Array(NamedTuple):
    """One array of a kernel."""

    # Shape of the block that the kernel sees; the array has one axis more, in front
    shape: tuple[int, ...]
    dtype: str  # Name of its type, such as "float32"
    # `INPUT`; `OUTPUT`; `SCRATCH`, memory of a block that nobody reads afterwards; or `ONCHIP`, the
    # same in a GPU's shared memory
    role: str = INPUT
    shared: bool = False  # Whether all blocks read the same block (an input's leading axis is 1)
    # Whether lanes read there what other lanes write, at places that differ
    exchanged: bool = False

    @property
    def bytes(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64)) * np.dtype(self.dtype).itemsize

    def __str__(self) -> str:
        axes = ", ".join(str(n) for n in ("1" if self.shared else "blocks", *self.shape))
        return f"{self.role} {self.dtype}[{axes}]"


class Layout(NamedTuple):
    """All arrays of a kernel; nothing here depends on the number of blocks."""

    arrays: tuple[Array, ...]  # The arrays, inputs first, in the order of the kernel's arguments
    lanes: int  # Lanes of a block

    @property
    def blocks(self) -> list[tuple[tuple[int, ...], np.dtype]]:
        return [(a.shape, np.dtype(a.dtype)) for a in self.arrays]

    def of(self, *roles: str) -> list[int]:
        return [k for k, a in enumerate(self.arrays) if a.role in roles]


LLVM_TYPES = {"f32": "float", "f64": "double", "i32": "i32", "i64": "i64", "b": "i1"}
"""LLVM's scalar types by kind."""

_KINDS = {"float32": "f32", "float64": "f64", "int32": "i32", "int64": "i64", "bool": "b"}
SIZES = {"f32": 4, "f64": 8, "i32": 4, "i64": 8}
"""Bytes of an element in memory, by kind; truth values are not stored."""


class Value(NamedTuple):
    """An operand of an instruction."""

    kind: str  # "f32", "f64", "i32", "i64", or "b" for a truth value
    wide: bool  # Whether it may differ between the lanes
    text: str | None  # Its LLVM name; None if its value is known when the kernel is written
    # Without a name its value: a number, or an array over the lanes. With a name a number that is
    # to be added to what the name holds (i32 only), so that addresses get constant offsets.
    known: Any = 0

    @property
    def is_known(self) -> bool:
        return self.text is None


class Ref(NamedTuple):
    """A block's part of an array in memory."""

    address: str  # LLVM name of its address
    shape: tuple[int, ...]  # Its shape
    kind: str  # Kind of its elements
    space: int = 1  # LLVM's address space: on a GPU 1 is global and 3 shared memory
    exchanged: bool = False  # Whether lanes read there what other lanes write


def kind_of(dtype: Any) -> str:
    name = np.dtype(dtype).name
    if name not in _KINDS:
        raise NotImplementedError(
            f"kernels have no dtype {name}; convert to one of {', '.join(_KINDS)}"
        )
    return _KINDS[name]


def numpy_type(kind: str) -> Any:
    return next(np.dtype(name).type for name, k in _KINDS.items() if k == kind)


def is_float(kind: str) -> bool:
    return kind[0] == "f"
