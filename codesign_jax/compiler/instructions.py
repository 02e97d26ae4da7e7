"""Instructions of a block in LLVM's assembly language, whose operands are `Value`.

A value over the lanes of a block is either one vector (`vector`) or a scalar of each thread
(`thread`), which have what CPUs and GPUs do differently; what is the same on all lanes, such as
indices and conditions, is a scalar on both.  Source: LLVM Language Reference Manual.
"""

import struct
from typing import Any

import numpy as np

from codesign_jax.compiler.values import Ref, Value, is_float, kind_of, numpy_type


class Instructions:
    """Writes instructions of one block.

    Attributes:
      lanes: Number of lanes of a block.
      lines: The instructions written so far.
      declared: Declarations of the functions that they call.
      exchanged: Names of values that other lanes have computed.
    """

    def __init__(self, lanes: int):
        self.lanes = lanes
        self.lines: list[str] = []
        self.declared: set[str] = set()
        self.count = 0
        self.here = "entry"
        self.scalar_of: dict[str, Value] = {}  # splatted scalars, by vector
        self.exchanged: set[str | None] = set()

    # What vectors and threads do differently

    def type(self, kind: str, wide: bool) -> str:
        raise NotImplementedError

    def lane_index(self) -> Value:
        raise NotImplementedError

    def splat(self, value: Value) -> Value:
        """A scalar on all lanes."""
        raise NotImplementedError

    def swap_lanes(self, value: Value, source: np.ndarray) -> Value:
        """The value that lane source[i] has, on lane i."""
        raise NotImplementedError

    def over_lanes(self, name: str, value: Value) -> Value:
        """The largest ("max") or smallest ("min") value of all lanes, a scalar."""
        raise NotImplementedError

    def load(self, ref: Ref, indices: list[Value]) -> Value:
        """Reads an element, or one for each lane.

        Nothing checks that an index lies within the array: a kernel clamps what it computes.
        """
        raise NotImplementedError

    def store(self, ref: Ref, indices: list[Value], value: Value) -> None:
        """Writes an element, or one for each lane; where lanes share one they write the same."""
        raise NotImplementedError

    def divide(self, a: Value, b: Value) -> Value:
        return self.compute("fdiv contract", a, b)

    def square_root(self, x: Value) -> Value:
        return self.intrinsic("sqrt", x)

    def inverse_square_root(self, x: Value) -> Value:
        return self.divide(self.constant(numpy_type(x.kind)(1)), self.square_root(x))

    def note_growth(self, name: str, a: Value, b: Value, result: Value) -> Value:
        """Called with each sum, difference or product of integers; returns the result."""
        return result

    # Text

    def name(self, prefix: str = "v") -> str:
        self.count += 1
        return f"{prefix}{self.count}"

    def emit(self, text: str) -> str:
        """Adds an instruction; returns the name of its result."""
        name = "%" + self.name()
        self.lines.append(f"{name} = {text}")
        return name

    def start(self, label: str) -> None:
        self.lines.append(f"{label}:")
        self.here = label

    def number(self, kind: str, value: Any) -> str:
        if is_float(kind):  # the bits of a double, also for a float
            return "0x" + struct.pack(">d", float(numpy_type(kind)(value))).hex().upper()
        return str(int(value))

    def operand(self, value: Value) -> str:
        """A value as an operand, without its type."""
        if value.text is None:
            return self.number(value.kind, value.known)
        if isinstance(value.known, np.ndarray) or value.known:
            return self._plain(value).text  # type: ignore[return-value]
        return value.text

    def _plain(self, value: Value) -> Value:
        """A value whose number to be added is added."""
        base = value._replace(known=0)
        text = self.emit(
            f"add {self.typed(base)}, {self._known(value.kind, value.wide, value.known)}"
        )
        return Value(value.kind, value.wide, text)

    def _known(self, kind: str, wide: bool, number: Any) -> str:
        return self.operand(Value(kind, wide, None, number))

    def typed(self, value: Value) -> str:
        operand = self.operand(value)  # may add an instruction
        return f"{self.type(value.kind, value.wide)} {operand}"

    def narrow(self, value: Value) -> Value:
        """The scalar of a value that is known to be the same on all lanes."""
        if value.text is not None:
            scalar = self.scalar_of.get(value.text)
            return value if scalar is None else scalar._replace(known=scalar.known + value.known)
        if value.wide and np.min(value.known) == np.max(value.known):
            return Value(value.kind, False, None, np.min(value.known))
        return value

    def same_width(self, *values: Value) -> list[Value]:
        if any(v.wide for v in values):
            return [self.splat(v) for v in values]
        return list(values)

    # Arithmetic

    def constant(self, array: Any) -> Value:
        """The value of a literal or captured array."""
        array = np.asarray(array)
        return Value(kind_of(array.dtype), bool(array.shape), None, array[()])

    def like(self, value: Value, number: float) -> Value:
        return Value(value.kind, False, None, numpy_type(value.kind)(number))

    def compute(self, operation: str, *args: Value, kind: str | None = None) -> Value:
        args = tuple(self.same_width(*args))
        first = args[0]
        wide = args[0].wide
        operands = ", ".join([self.operand(a) for a in args])
        text = self.emit(f"{operation} {self.type(first.kind, wide)} {operands}")
        return Value(kind or first.kind, wide, text)

    def intrinsic(
        self, name: str, *args: Value, flags: str = "contract ", extra: str = ""
    ) -> Value:
        """The result of one of LLVM's overloaded functions on floats or integers."""
        args = tuple(self.same_width(*args))
        kind = args[0].kind
        wide = args[0].wide
        full = f"llvm.{name}.{self.suffix(kind, wide)}"
        operand_type = self.type(kind, wide)
        extra_types = [part.rsplit(" ", 1)[0] for part in extra.split(", ") if part]
        self.declared.add(
            f"declare {operand_type} @{full}({', '.join([operand_type] * len(args) + extra_types)})"
        )
        operands = ", ".join([self.typed(a) for a in args] + ([extra] if extra else []))
        flags = flags if is_float(kind) else ""
        return Value(kind, wide, self.emit(f"call {flags}{operand_type} @{full}({operands})"))

    def suffix(self, kind: str, wide: bool) -> str:
        scalar = {"b": "i1"}.get(kind, kind)
        vector = self.type(kind, wide).startswith("<")
        return f"v{self.lanes}{scalar}" if vector else scalar

    def fma(self, a: Value, b: Value, c: Value) -> Value:
        """The product plus c, rounded once."""
        return self.intrinsic("fma", a, b, c)

    def convert(self, operation: str, value: Value, kind: str) -> Value:
        text = self.emit(f"{operation} {self.typed(value)} to {self.type(kind, value.wide)}")
        return Value(kind, value.wide, text)

    def to_integer(self, x: Value, kind: str = "i32") -> Value:
        """A float without its fraction; 0 for what is not a number, the nearest integer beyond."""
        source = self.suffix(x.kind, x.wide)
        target = self.suffix(kind, x.wide)
        full = f"llvm.fptosi.sat.{target}.{source}"
        result = self.type(kind, x.wide)
        self.declared.add(f"declare {result} @{full}({self.type(x.kind, x.wide)})")
        return Value(kind, x.wide, self.emit(f"call {result} @{full}({self.typed(x)})"))

    def select(self, which: Value, yes: Value, no: Value) -> Value:
        """One of two values, lane by lane if `which` differs between the lanes."""
        if which.is_known and not which.wide:
            return yes if which.known else no
        yes, no = self.same_width(yes, no)
        if which.wide:
            yes = self.splat(yes)
            no = self.splat(no)
        parts = [self.typed(v) for v in (which, yes, no)]
        return Value(yes.kind, yes.wide, self.emit(f"select {', '.join(parts)}"))
