"""Instructions of LLVM for the operations of a kernel."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from codesign_jax.compiler.walker import SHARED, swapped_lanes

if TYPE_CHECKING:
    from codesign_jax.compiler.llvm import Writer

_INT_OPS: dict[str, Callable] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": lambda a, b: np.trunc(a / b).astype(np.int32),
    "rem": np.fmod,
    "max": np.maximum,
    "min": np.minimum,
}
_COMPARE: dict[str, Callable] = {
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
}


class Value(NamedTuple):
    """An operand.

    Attributes:
      kind: "f" for a float, "i" for an int32, "b" for a truth value.
      wide: Whether it has a value for each lane.
      text: Its name; None if its value is known.
      known: A number, or an array over the lanes.
    """

    kind: str
    wide: bool
    text: str | None
    known: Any = None


def kind_of(dtype: Any) -> str:
    """Kind of an array's elements."""
    if dtype == np.bool_:
        return "b"
    return "i" if np.issubdtype(dtype, np.integer) else "f"


def _arithmetic(name: str) -> Callable:
    def rule(w: "Writer", equation: Any, a: Value, b: Value) -> Value:
        if a.kind == "f":
            return w.compute(f"f{name} contract", a, b)
        if a.text is None and b.text is None:
            known = np.asarray(_INT_OPS[name](a.known, b.known), np.int32)
            return Value("i", a.wide or b.wide, None, known)
        signed = {"div": "sdiv", "rem": "srem"}.get(name, f"{name} nsw")
        return w.compute(signed, a, b)

    return rule


def _compare(name: str) -> Callable:
    def rule(w: "Writer", equation: Any, a: Value, b: Value) -> Value:
        if a.text is None and b.text is None:
            wide = a.wide or b.wide
            return Value("b", wide, None, np.asarray(_COMPARE[name](a.known, b.known)))
        if a.kind == "f":
            # A comparison with what is not a number is false, but "not equal" is true.
            test = "fcmp une" if name == "ne" else f"fcmp o{name}"
        else:
            signed = a.kind == "i" and name not in ("eq", "ne")
            test = f"icmp {'s' if signed else ''}{name}"
        return w.compute(test, a, b, kind="b")

    return rule


def _extreme(test: str) -> Callable:
    def rule(w: "Writer", equation: Any, a: Value, b: Value) -> Value:
        if a.kind == "i" and a.text is None and b.text is None:
            return _arithmetic("max" if test == "gt" else "min")(w, equation, a, b)
        a, b = w.alike(a, b)
        order = f"fcmp o{test}" if a.kind == "f" else f"icmp s{test}"
        return w.select(w.compute(order, a, b, kind="b"), a, b)

    return rule


def _logic(name: str) -> Callable:
    def rule(w: "Writer", equation: Any, a: Value, b: Value) -> Value:
        return w.compute(name, a, b)

    return rule


def _not(w: "Writer", equation: Any, a: Value) -> Value:
    return w.compute("xor", a, Value(a.kind, a.wide, None, 1 if a.kind == "b" else -1))


def _select_n(w: "Writer", equation: Any, which: Value, no: Value, yes: Value) -> Value:
    return w.select(which, yes, no)


def _convert(w: "Writer", equation: Any, x: Value) -> Value:
    kind = kind_of(equation.outvars[0].aval.dtype)
    if kind == x.kind:
        return x
    if x.text is None:
        return Value(kind, x.wide, None, x.known)
    if kind == "b":
        test = "fcmp une" if x.kind == "f" else "icmp ne"
        return w.compute(test, x, Value(x.kind, x.wide, None, 0), kind="b")
    operation = {"bi": "zext", "bf": "uitofp", "if": "sitofp", "fi": "fptosi"}[x.kind + kind]
    text = w.emit(f"{operation} {w.typed(x)} to {w.type(kind, x.wide)}")
    return Value(kind, x.wide, text)


def _rsqrt(w: "Writer", equation: Any, x: Value) -> Value:
    return w.apply("div", w.constant(np.asarray(1.0)), w.intrinsic("sqrt", x))


def _angle(name: str) -> Callable:
    def rule(w: "Writer", equation: Any, x: Value) -> Value:
        return w.intrinsic(name, x) if w.itemsize == 8 else SHARED[name](w, equation, x)

    return rule


def _iota(w: "Writer", equation: Any, *args: Value) -> Value:
    return Value("i", True, None, np.arange(w.lanes, dtype=np.int32))


def _reverse(w: "Writer", equation: Any, x: Value) -> Value:
    pattern = swapped_lanes(equation.invars[0].aval.shape, equation.params["dimensions"])
    if x.text is None:
        return x._replace(known=np.broadcast_to(np.asarray(x.known), (w.lanes,))[pattern])
    return Value(x.kind, True, w.shuffle(w.type(x.kind, True), w.operand(w.spread(x)), pattern))


def _over_lanes(w: "Writer", equation: Any, x: Value) -> Value:
    kind, full = w.type("i", True), f"llvm.vector.reduce.smax.v{w.lanes}i32"
    w.declared.add(f"declare i32 @{full}({kind})")
    return Value("i", False, w.emit(f"call i32 @{full}({w.typed(x)})"))


RULES: dict[str, Callable] = {
    **SHARED,
    "add": _arithmetic("add"),
    "add_any": _arithmetic("add"),
    "sub": _arithmetic("sub"),
    "mul": _arithmetic("mul"),
    "div": _arithmetic("div"),
    "rem": _arithmetic("rem"),
    "neg": lambda w, e, x: w.compute("fneg", x),
    "abs": lambda w, e, x: w.intrinsic("fabs", x),
    "max": _extreme("gt"),
    "min": _extreme("lt"),
    "sqrt": lambda w, e, x: w.intrinsic("sqrt", x),
    "rsqrt": _rsqrt,
    "sin": _angle("sin"),
    "cos": _angle("cos"),
    **{name: _compare(name) for name in _COMPARE},
    "and": _logic("and"),
    "or": _logic("or"),
    "xor": _logic("xor"),
    "not": _not,
    "select_n": _select_n,
    "convert_element_type": _convert,
    "iota": _iota,
    "rev": _reverse,
    "reduce_max": _over_lanes,
}
