"""Writes a Pallas kernel as LLVM's assembly language, for CPUs.

A value over the lanes of a block is one vector, and every operation one vector instruction: XLA's
own code for the CPU slices and copies small arrays for most of the time.  What is the same on all
lanes (indices, conditions) is a scalar.  LLVM allocates registers and fuses multiplications with
additions.  Source of the instructions: LLVM Language Reference Manual.
"""

import struct
from typing import Any

import numpy as np

from codesign_jax.compiler import llvm_memory
from codesign_jax.compiler.llvm_memory import Ref
from codesign_jax.compiler.llvm_rules import RULES, Value, kind_of
from codesign_jax.compiler.walker import Walker

_FLOAT = {4: "float", 8: "double"}


class Writer(Walker):
    """Writes the instructions of one block."""

    language = "LLVM"
    rules = RULES

    def __init__(self, lanes: int, itemsize: int = 4):
        """Starts empty.

        Args:
          lanes: Lanes of a block.
          itemsize: Bytes of a float.
        """
        self.lanes, self.itemsize = lanes, itemsize
        self.scalars = {"f": _FLOAT[itemsize], "i": "i32", "b": "i1"}
        self.lines: list[str] = []
        self.count, self.here = 0, "entry"
        self.declared: set[str] = set()
        self.spread_from: dict[
            str, Value
        ] = {}  # the scalar that was spread to a vector, by its name

    # Text

    def type(self, kind: str, wide: bool, lanes: int | None = None) -> str:
        """Name of a type."""
        scalar = self.scalars[kind]
        return f"<{lanes or self.lanes} x {scalar}>" if wide else scalar

    def name(self, prefix: str = "v") -> str:
        """A new name."""
        self.count += 1
        return f"{prefix}{self.count}"

    def emit(self, text: str) -> str:
        """Adds an instruction; returns the name of its result."""
        name = "%" + self.name()
        self.lines.append(f"{name} = {text}")
        return name

    def start(self, label: str) -> None:
        """Begins a basic block."""
        self.lines.append(f"{label}:")
        self.here = label

    def number(self, kind: str, value: Any) -> str:
        """A number as an operand."""
        if kind == "f":
            exact = np.float32(value) if self.itemsize == 4 else np.float64(value)
            return "0x" + struct.pack(">d", float(exact)).hex().upper()
        return str(int(value))

    def operand(self, value: Value) -> str:
        """A value as an operand, without its type."""
        if value.text is not None:
            return value.text
        if not value.wide:
            return self.number(value.kind, value.known)
        each = np.broadcast_to(np.asarray(value.known), (self.lanes,))
        scalar = self.scalars[value.kind]
        return "<" + ", ".join(f"{scalar} {self.number(value.kind, v)}" for v in each) + ">"

    def typed(self, value: Value) -> str:
        """A value as an operand with its type."""
        return f"{self.type(value.kind, value.wide)} {self.operand(value)}"

    def spread(self, value: Value) -> Value:
        """A scalar on all lanes."""
        if value.wide:
            return value
        if value.text is None:
            return value._replace(wide=True)
        kind = self.type(value.kind, True)
        first = self.emit(f"insertelement {kind} poison, {self.typed(value)}, i32 0")
        zeros = f"<{self.lanes} x i32> zeroinitializer"
        text = self.emit(f"shufflevector {kind} {first}, {kind} poison, {zeros}")
        self.spread_from[text] = value
        return Value(value.kind, True, text)

    def narrow(self, value: Value) -> Value:
        """The scalar of a vector that is known to be the same on all lanes."""
        if value.text is not None:
            return self.spread_from.get(value.text, value)
        if value.wide and np.min(value.known) == np.max(value.known):
            return Value(value.kind, False, None, np.min(value.known))
        return value

    def alike(self, *values: Value) -> list[Value]:
        """All wide if one is."""
        if any(v.wide for v in values):
            return [self.spread(v) for v in values]
        return list(values)

    def compute(self, operation: str, *args: Value, kind: str | None = None) -> Value:
        """The result of an instruction whose operands have one type."""
        args = tuple(self.alike(*args))
        first, wide = args[0], args[0].wide
        operands = ", ".join(self.operand(a) for a in args)
        text = self.emit(f"{operation} {self.type(first.kind, wide)} {operands}")
        return Value(kind or first.kind, wide, text)

    def intrinsic(self, name: str, *args: Value) -> Value:
        """The result of one of LLVM's functions on floats."""
        args = tuple(self.alike(*args))
        kind = self.type("f", args[0].wide)
        scalar = f"f{8 * self.itemsize}"
        full = f"llvm.{name}.{f'v{self.lanes}' if args[0].wide else ''}{scalar}"
        self.declared.add(f"declare {kind} @{full}({', '.join([kind] * len(args))})")
        operands = ", ".join(self.typed(a) for a in args)
        return Value("f", args[0].wide, self.emit(f"call contract {kind} @{full}({operands})"))

    def fma(self, a: Value, b: Value, c: Value) -> Value:
        """See `Walker`."""
        return self.intrinsic("fma", a, b, c)

    def nearest(self, x: Value) -> Value:
        """See `Walker`."""
        return self.intrinsic("rint", x)

    def whole(self, x: Value) -> Value:
        """See `Walker`."""
        text = self.emit(f"fptosi {self.typed(x)} to {self.type('i', x.wide)}")
        return Value("i", x.wide, text)

    def select(self, which: Value, yes: Value, no: Value) -> Value:
        """Lane by lane one of two values."""
        yes, no = self.alike(yes, no)
        if which.wide:
            yes, no = self.spread(yes), self.spread(no)
        text = self.emit(f"select {self.typed(which)}, {self.typed(yes)}, {self.typed(no)}")
        return Value(yes.kind, yes.wide, text)

    def shuffle(self, kind: str, value: str, pattern: np.ndarray) -> str:
        """A vector whose lane i is the value's lane pattern[i]."""
        mask = ", ".join(f"i32 {int(p)}" for p in pattern)
        return self.emit(
            f"shufflevector {kind} {value}, {kind} poison, <{len(pattern)} x i32> <{mask}>"
        )

    # Control

    def _phis(self, values: list[Value], source: str) -> tuple[list[Value], list[int]]:
        """Values that a loop changes, and the lines to which their new values will be added."""
        found, lines = [], []
        for value in values:
            name = "%" + self.name()
            lines.append(len(self.lines))
            kind = self.type(value.kind, value.wide)
            self.lines.append(f"{name} = phi {kind} [ {self.operand(value)}, %{source} ]")
            found.append(Value(value.kind, value.wide, name))
        return found, lines

    def _close(self, lines: list[int], values: list[Value], source: str) -> None:
        for line, value in zip(lines, values, strict=True):
            self.lines[line] += f", [ {self.operand(value)}, %{source} ]"

    def loop(self, equation: Any, args: list) -> list:
        """A scan without inputs and outputs: a loop of fixed length."""
        p = equation.params
        split = len(args) - len(equation.outvars)  # every result is carried
        consts, start = args[:split], self._carried(equation.outvars, args[split:])
        assert not p["reverse"]
        label, end, source = self.name("L"), self.name("L"), self.here
        self.lines.append(f"br label %{label}")
        self.start(label)
        values, lines = self._phis([Value("i", False, None, 0), *start], source)
        inner = p["jaxpr"]
        new = self.run(inner.jaxpr, inner.consts, [*consts, *values[1:]])
        new = self._carried(equation.outvars, new)
        following = self.emit(f"add nsw i32 {values[0].text}, 1")
        going = self.emit(f"icmp slt i32 {following}, {p['length']}")
        self._close(lines, [Value("i", False, following), *new], self.here)
        self.lines.append(f"br i1 {going}, label %{label}, label %{end}")
        self.start(end)
        return new

    def _carried(self, variables: Any, values: list[Value]) -> list[Value]:
        """Values as wide as the variables that hold them."""
        return [
            self.spread(v) if var.aval.shape else v
            for var, v in zip(variables, values, strict=True)
        ]

    def while_loop(self, equation: Any, args: list) -> list:
        """A while loop; its condition is a scalar."""
        p = equation.params
        a, b = p["cond_nconsts"], p["body_nconsts"]
        cond_consts, body_consts = args[:a], args[a : a + b]
        start = self._carried(equation.outvars, args[a + b :])
        top, inside, end, source = self.name("L"), self.name("L"), self.name("L"), self.here
        self.lines.append(f"br label %{top}")
        self.start(top)
        values, lines = self._phis(start, source)
        cond, body = p["cond_jaxpr"], p["body_jaxpr"]
        (going,) = self.run(cond.jaxpr, cond.consts, [*cond_consts, *values])
        self.lines.append(f"br {self.typed(going)}, label %{inside}, label %{end}")
        self.start(inside)
        new = self.run(body.jaxpr, body.consts, [*body_consts, *values])
        self._close(lines, self._carried(equation.outvars, new), self.here)
        self.lines.append(f"br label %{top}")
        self.start(end)
        return values

    def branch(self, equation: Any, args: list) -> list:
        """A conditional of two branches; its predicate is a scalar."""
        which, operands = args[0], args[1:]
        no, yes = equation.params["branches"]
        if which.kind != "b":
            which = self.compute("icmp ne", which, Value("i", False, None, 0), kind="b")
        labels, end = (self.name("L"), self.name("L")), self.name("L")
        self.lines.append(f"br {self.typed(which)}, label %{labels[0]}, label %{labels[1]}")
        found, sources = [], []
        for branch, label in zip((yes, no), labels, strict=True):
            self.start(label)
            values = self.run(branch.jaxpr, branch.consts, operands)
            found.append(self._carried(equation.outvars, values))
            sources.append(self.here)
            self.lines.append(f"br label %{end}")
        self.start(end)
        results, lines = self._phis(found[0], sources[0])
        self._close(lines, found[1], sources[1])
        return results

    # What a walk asks for

    def constant(self, array: np.ndarray) -> Value:
        """See `Walker`."""
        return Value(kind_of(array.dtype), bool(array.shape), None, array[()])

    def same(self, equation: Any, value: Value) -> Value:
        """See `Walker`."""
        return self.spread(value) if equation.outvars[0].aval.shape else value

    def get(self, equation: Any, ref: Ref, leaves: list[Value]) -> Value:
        """See `Walker`."""
        value = llvm_memory.load(self, ref, llvm_memory.indices(self, ref, equation, leaves))
        return self.same(equation, value)

    def swap(self, equation: Any, ref: Ref, value: Value, leaves: list[Value]) -> None:
        """See `Walker`."""
        llvm_memory.store(self, ref, llvm_memory.indices(self, ref, equation, leaves), value)


def write(jaxpr: Any, shapes: list[tuple[int, ...]], lanes: int, itemsize: int = 4) -> str:
    """A function `block` of LLVM's language that runs a kernel on one block.

    Args:
      jaxpr: The kernel's jaxpr; its arguments are references to a block of each array.
      shapes: Shapes of the blocks.
      lanes: Lanes of a block.
      itemsize: Bytes of a computed float; arrays have the types of the jaxpr's references.

    Raises:
      NotImplementedError: If the kernel does something that has no rule here.
    """
    writer = Writer(lanes, itemsize)
    types = [np.dtype(v.aval.dtype) for v in jaxpr.invars]
    arrays = [Ref(f"%a{k}", *of) for k, of in enumerate(zip(shapes, types, strict=True))]
    writer.run(jaxpr, [], arrays)
    params = ", ".join(f"ptr noalias %a{k}" for k in range(len(shapes)))
    body = "\n".join(writer.lines)
    declarations = "\n".join(sorted(writer.declared))
    return (
        f"define internal void @block({params}) nounwind {{\nentry:\n{body}\nret void\n}}\n"
        f"{declarations}\n"
    )
