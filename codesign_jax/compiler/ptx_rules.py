"""Instructions of PTX for the operations of a kernel."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from codesign_jax.compiler.walker import COMPARE, SHARED, swapped_lanes

if TYPE_CHECKING:
    from codesign_jax.compiler.ptx import Assembler

LANES = 32
"""Threads of a warp."""


class Value(NamedTuple):
    """A register or number of each thread.

    Attributes:
      kind: "f32", "s32" or "pred".
      name: Register, or None for a number.
      number: The number, or what is to be added to the register (s32).
    """

    kind: str
    name: str | None
    number: Any = 0


def kind_of(aval: Any) -> str:
    """Type of registers for an array."""
    if aval.dtype == np.bool_:
        return "pred"
    return "s32" if np.issubdtype(aval.dtype, np.integer) else "f32"


def _same_kind(name: str) -> Callable:
    def rule(asm: "Assembler", equation: Any, *args: Value) -> Value:
        kind = args[0].kind
        return asm.compute(kind, f"{name}.{kind}", *args)

    return rule


def _add(asm: "Assembler", equation: Any, a: Value, b: Value) -> Value:
    if a.kind == "s32" and (a.name is None or b.name is None):
        return Value("s32", a.name or b.name, int(a.number) + int(b.number))
    return asm.compute(a.kind, f"add.{a.kind}", a, b)


def _sub(asm: "Assembler", equation: Any, a: Value, b: Value) -> Value:
    if a.kind == "s32" and b.name is None:
        return a._replace(number=int(a.number) - int(b.number))
    result = asm.compute(a.kind, f"sub.{a.kind}", a, b)
    if a.name is None and b.name in asm.growth:
        asm.growth[result.name] = -asm.growth[b.name]  # type: ignore[index]
    return result


def _mul(asm: "Assembler", equation: Any, a: Value, b: Value) -> Value:
    if a.kind == "s32":
        if a.name is None and b.name is None:
            return Value("s32", None, int(a.number) * int(b.number))
        for x, y in ((a, b), (b, a)):
            if y.name is None and y.number == 1:
                return x
        result = asm.compute("s32", "mul.lo.s32", a, b)
        for x, y in ((a, b), (b, a)):
            if x.name in asm.growth and y.name is None:
                asm.growth[result.name] = asm.growth[x.name] * int(y.number)  # type: ignore[index]
        return result
    return asm.compute("f32", "mul.f32", a, b)


def _div(asm: "Assembler", equation: Any, a: Value, b: Value) -> Value:
    return asm.compute(a.kind, "div.full.f32" if a.kind == "f32" else "div.s32", a, b)


def _compare(name: str) -> Callable:
    def rule(asm: "Assembler", equation: Any, a: Value, b: Value) -> Value:
        if a.kind == "pred":
            different = asm.compute("pred", "xor.pred", a, b)
            return different if name == "ne" else asm.compute("pred", "not.pred", different)
        # A comparison with what is not a number is false, but "not equal" is true.
        test = "neu" if name == "ne" and a.kind == "f32" else name
        if a.name is None and b.name is not None:
            a, b = b, a
            test = {"lt": "gt", "gt": "lt", "le": "ge", "ge": "le"}.get(test, test)
        return asm.compute("pred", f"setp.{test}.{a.kind}", a, b)

    return rule


def _logic(name: str) -> Callable:
    def rule(asm: "Assembler", equation: Any, *args: Value) -> Value:
        if args[0].kind != "pred":
            return asm.compute("s32", f"{name}.b32", *args)
        return asm.compute("pred", f"{name}.pred", *args)

    return rule


def _select(asm: "Assembler", equation: Any, which: Value, no: Value, yes: Value) -> Value:
    if no.kind == "pred":
        first = asm.compute("pred", "and.pred", which, yes)
        negated = asm.compute("pred", "not.pred", which)
        second = asm.compute("pred", "and.pred", negated, no)
        return asm.compute("pred", "or.pred", first, second)
    return asm.compute(no.kind, f"selp.{no.kind}", yes, no, which)


def _convert(asm: "Assembler", equation: Any, x: Value) -> Value:
    kind = kind_of(equation.outvars[0].aval)
    if kind == x.kind:
        return x
    if x.name is None:
        return Value(kind, None, x.number)
    if x.kind == "pred":
        return asm.compute(kind, f"selp.{kind}", Value(kind, None, 1), Value(kind, None, 0), x)
    if kind == "pred":
        return asm.compute("pred", f"setp.ne.{x.kind}", x, Value(x.kind, None, 0))
    return asm.compute(kind, "cvt.rn.f32.s32" if kind == "f32" else "cvt.rzi.s32.f32", x)


def _lane(asm: "Assembler", equation: Any, *args: Value) -> Value:
    return Value("s32", "%lane")


def _reverse(asm: "Assembler", equation: Any, x: Value) -> Value:
    lanes = swapped_lanes(equation.invars[0].aval.shape, equation.params["dimensions"])
    mask = int(lanes[0])
    assert (lanes == np.arange(LANES) ^ mask).all(), "lanes that do not swap in pairs"
    if x.name is None:
        return x
    result = Value(x.kind, asm.register(x.kind))
    asm.emit(f"shfl.sync.bfly.b32 {result.name}, {x.name}, {mask}, 31, 0xffffffff;")
    return result


def _over_lanes(asm: "Assembler", equation: Any, x: Value) -> Value:
    # Never remembered: a loop's condition is computed anew.
    result = Value("s32", asm.register("s32"))
    asm.emit(f"redux.sync.max.s32 {result.name}, {asm.operand(x)}, 0xffffffff;")
    return result


RULES: dict[str, Callable] = {
    **SHARED,
    "add": _add,
    "add_any": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _same_kind("neg"),
    "abs": _same_kind("abs"),
    "max": _same_kind("max"),
    "min": _same_kind("min"),
    "rem": _same_kind("rem"),
    "sqrt": lambda asm, e, x: asm.compute("f32", "sqrt.approx.f32", x),
    "rsqrt": lambda asm, e, x: asm.compute("f32", "rsqrt.approx.f32", x),
    **{name: _compare(name) for name in COMPARE},
    "and": _logic("and"),
    "or": _logic("or"),
    "xor": _logic("xor"),
    "not": _logic("not"),
    "select_n": _select,
    "convert_element_type": _convert,
    "iota": _lane,
    "rev": _reverse,
    "reduce_max": _over_lanes,
}
