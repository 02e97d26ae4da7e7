"""Instructions for the operations of a kernel: from operands to the result, by JAX's primitive.

Results are those of JAX for every input, also for infinities and what is not a number: a rule that
is cheaper but wrong there would hide a simulation's failure.

Sine and cosine are Taylor's polynomials after the reduction of W. J. Cody, W. Waite, Software
Manual for the Elementary Functions, 1980: a multiple of pi / 2, kept in parts that a fused
multiplication subtracts without loss, is taken off the angle.  The rest is within pi / 4, where the
polynomials are exact to half a unit in the last place of their type.  Angles beyond some 1e5 lose
the digits that the multiple takes.
"""

from collections.abc import Callable
from fractions import Fraction
from math import factorial
from typing import Any

import numpy as np

from codesign_jax.compiler.instructions import Instructions
from codesign_jax.compiler.values import SIZES, Value, is_float, kind_of, numpy_type

_HALF_PI = Fraction("3.14159265358979323846264338327950288419716939937510") / 2
# Terms of each polynomial and bits of the parts of pi / 2, by type.
_TERMS = {"f32": 5, "f64": 9}
_BITS = {"f32": (12, 12, 24), "f64": (33, 33, 53)}


def half_pi_parts(kind: str) -> list[float]:
    """Numbers that add up to pi / 2; all but the last times a small whole number are exact."""
    parts = []
    left = _HALF_PI
    for bits in _BITS[kind]:
        scale = Fraction(2) ** (bits - 1 - int(np.floor(np.log2(float(left)))))
        part = Fraction(int(left * scale), 1) / scale
        left -= part
        parts.append(float(part))
    return parts


def _polynomial(w: Instructions, x: Value, first: int, terms: int) -> Value:
    """Sum of (-x)^k / (2 k + first)!, the last term first."""
    coefficients = [(-1) ** k / factorial(2 * k + first) for k in range(terms)]
    result, *rest = (w.like(x, c) for c in reversed(coefficients))
    for c in rest:
        result = w.fma(result, x, c)
    return result


def _of_angle(w: Instructions, x: Value, shift: int) -> Value:
    """Sine of an angle to which `shift` quarter turns are added."""
    dtype = numpy_type(x.kind)
    quarter_turns = w.intrinsic("rint", w.compute("fmul", x, w.like(x, 2 / np.pi)), flags="")
    remainder = x
    for part in half_pi_parts(x.kind):
        remainder = w.fma(quarter_turns, w.like(x, dtype(-part)), remainder)
    square = w.compute("fmul", remainder, remainder)
    sine = w.compute("fmul", _polynomial(w, square, 1, _TERMS[x.kind]), remainder)
    cosine = _polynomial(w, square, 0, _TERMS[x.kind])
    quadrant = RULES["add"](w, None, w.to_integer(quarter_turns), Value("i32", False, None, shift))

    def bit(k: int) -> Value:
        masked = w.compute("and", quadrant, Value("i32", False, None, k))
        return w.compute("icmp ne", masked, Value("i32", False, None, 0), kind="b")

    value = w.select(bit(1), cosine, sine)
    return w.select(bit(2), w.compute("fneg", value), value)


def sine(w: Instructions, equation: Any, x: Value) -> Value:
    return _of_angle(w, x, 0)


def cosine(w: Instructions, equation: Any, x: Value) -> Value:
    return _of_angle(w, x, 1)


Rule = Callable[..., Value]

_NUMPY: dict[str, Callable] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "max": np.maximum,
    "min": np.minimum,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
}


def _folded(name: str, kind: str, *args: Value) -> Value | None:
    """The result on integers or truth values that are known when the kernel is written."""
    if is_float(args[0].kind) or not all(a.is_known for a in args):
        return None
    with np.errstate(over="ignore"):
        known = _NUMPY[name](*(np.asarray(a.known, numpy_type(a.kind)) for a in args))
    return Value(kind, any(a.wide for a in args), None, np.asarray(known, numpy_type(kind))[()])


def _arithmetic(name: str) -> Rule:
    def rule(w: Instructions, equation: Any, a: Value, b: Value) -> Value:
        if is_float(a.kind):
            # A product of one lane fused with another lane's rounded one would differ between the
            # two: what lanes add up after an exchange must have the same bits on all of them.
            fused = "" if name != "mul" and {a.text, b.text} & w.exchanged else " contract"
            return w.compute(f"f{name}{fused}", a, b)
        known = _folded(name, a.kind, a, b) or _offset(name, a, b)
        return w.note_growth(name, a, b, known or w.compute(name, a, b))

    return rule


def _offset(name: str, a: Value, b: Value) -> Value | None:
    """A named integer and a number to be added to it; see `Value.known`."""
    if name == "mul":
        for x, y in ((a, b), (b, a)):
            if y.is_known and np.ndim(y.known) == 0 and y.known == 1 and x.wide >= y.wide:
                return x
        return None
    if name == "add" and a.is_known:
        a, b = b, a
    small = b.is_known and np.ndim(b.known) == 0 and a.kind == "i32" and a.wide >= b.wide
    if not small or a.is_known or abs(int(a.known)) + abs(int(b.known)) > 2**24:
        return None
    return a._replace(known=int(a.known) + (int(b.known) if name == "add" else -int(b.known)))


def _divide(w: Instructions, equation: Any, a: Value, b: Value) -> Value:
    if is_float(a.kind):
        return w.divide(a, b)
    return _integer_division(w, "sdiv", a, b)


def _remainder(w: Instructions, equation: Any, a: Value, b: Value) -> Value:
    return w.compute("frem", a, b) if is_float(a.kind) else _integer_division(w, "srem", a, b)


def _integer_division(w: Instructions, operation: str, a: Value, b: Value) -> Value:
    """Quotient or remainder of integers; those that processors trap at have XLA's results.

    x / 0 is -1, x rem 0 is x, and the smallest integer over -1 is itself, with remainder 0.
    """
    quotient = operation == "sdiv"
    if a.is_known and b.is_known and np.all(np.asarray(b.known) > 0):
        x = np.asarray(a.known)
        y = np.asarray(b.known)
        exact = np.asarray(np.sign(x) * (np.abs(x) // y) if quotient else np.fmod(x, y))
        return Value(a.kind, a.wide or b.wide, None, exact.astype(numpy_type(a.kind))[()])
    if b.is_known and np.all(np.asarray(b.known) > 0):
        return w.compute(operation, a, b)
    zero = w.like(b, 0)
    minus = w.like(b, -1)
    nothing = w.compute("icmp eq", b, zero, kind="b")
    negated = w.compute("icmp eq", b, minus, kind="b")
    trap = w.compute("or", nothing, negated)
    result = w.compute(operation, a, w.select(trap, w.like(b, 1), b))
    opposite = w.compute("sub", zero, a) if quotient else zero
    result = w.select(negated, opposite, result)
    return w.select(nothing, minus if quotient else a, result)


def _compare(name: str) -> Rule:
    def rule(w: Instructions, equation: Any, a: Value, b: Value) -> Value:
        known = _folded(name, "b", a, b)
        if known is not None:
            return known
        if is_float(a.kind):
            # A comparison with what is not a number is false, but "not equal" is true.
            test = "fcmp une" if name == "ne" else f"fcmp o{name}"
        else:
            sign = "u" if a.kind == "b" else "s"  # of truth values false is the smaller one
            test = f"icmp {name}" if name in ("eq", "ne") else f"icmp {sign}{name}"
        return w.compute(test, a, b, kind="b")

    return rule


def _extreme(name: str) -> Rule:
    def rule(w: Instructions, equation: Any, a: Value, b: Value) -> Value:
        if a.kind == "b":
            return w.compute("or" if name == "max" else "and", a, b)
        if not is_float(a.kind):
            return _folded(name, a.kind, a, b) or w.intrinsic(f"s{name}", a, b)
        return w.intrinsic({"max": "maximum", "min": "minimum"}[name], a, b, flags="nsz ")

    return rule


def _logic(name: str) -> Rule:
    def rule(w: Instructions, equation: Any, a: Value, b: Value) -> Value:
        return _folded(name, a.kind, a, b) or w.compute(name, a, b)

    return rule


def _shift(operation: str) -> Rule:
    """A shift of integers; by all bits or more XLA gives 0, and LLVM leaves it open."""

    def rule(w: Instructions, equation: Any, a: Value, b: Value) -> Value:
        bits = 8 * SIZES[a.kind]
        moved = w.compute(operation, a, b)
        if b.is_known and np.all((0 <= b.known) & (b.known < bits)):
            return moved
        negative = RULES["lt"](w, None, b, w.like(b, 0))
        outside = RULES["or"](w, None, negative, RULES["ge"](w, None, b, w.like(b, bits)))
        return w.select(outside, w.like(moved, 0), moved)

    return rule


def _not(w: Instructions, equation: Any, a: Value) -> Value:
    return w.compute("xor", a, Value(a.kind, a.wide, None, 1 if a.kind == "b" else -1))


def _negate(w: Instructions, equation: Any, x: Value) -> Value:
    if is_float(x.kind):
        return w.compute("fneg", x)
    return RULES["sub"](w, None, w.like(x, 0), x)


def _magnitude(w: Instructions, equation: Any, x: Value) -> Value:
    if is_float(x.kind):
        return w.intrinsic("fabs", x, flags="")
    return w.select(w.compute("icmp slt", x, w.like(x, 0), kind="b"), _negate(w, None, x), x)


def _sign(w: Instructions, equation: Any, x: Value) -> Value:
    """-1, 0 or 1; zeros and what is not a number stay as they are."""
    below, above = (RULES[test](w, None, x, w.like(x, 0)) for test in ("lt", "gt"))
    return w.select(below, w.like(x, -1), w.select(above, w.like(x, 1), x))


def _power(w: Instructions, equation: Any, x: Value) -> Value:
    result = w.like(x, 1)
    y = equation.params["y"]
    square = x
    for bit in reversed(bin(abs(y))[2:]):
        if bit == "1":
            result = square if result.is_known else RULES["mul"](w, None, result, square)
        square = RULES["mul"](w, None, square, square)
    return result if y >= 0 else w.divide(w.like(x, 1), result)


def _select_n(w: Instructions, equation: Any, which: Value, *cases: Value) -> Value:
    if which.kind == "b":
        chosen = w.select(which, cases[1], cases[0])
        if {case.text for case in cases} & w.exchanged:
            w.exchanged.add(chosen.text)
        return chosen
    result = cases[-1]
    for k in reversed(range(len(cases) - 1)):
        chosen = RULES["eq"](w, None, which, w.like(which, k))
        result = w.select(chosen, cases[k], result)
    return result


def _convert(w: Instructions, equation: Any, x: Value) -> Value:
    kind = kind_of(equation.outvars[0].aval.dtype)
    if kind == x.kind:
        return x
    if x.is_known and (not is_float(x.kind) or kind == "b" or is_float(kind)):
        known = np.asarray(x.known, numpy_type(x.kind)).astype(numpy_type(kind))
        return Value(kind, x.wide, None, known[()])
    if kind == "b":
        return RULES["ne"](w, None, x, w.like(x, 0))
    if is_float(x.kind) and is_float(kind):
        return w.convert("fpext" if kind == "f64" else "fptrunc", x, kind)
    if is_float(x.kind):
        return w.to_integer(x, kind)
    if is_float(kind):
        return w.convert("uitofp" if x.kind == "b" else "sitofp", x, kind)
    if x.kind == "b":
        return w.convert("zext", x, kind)
    return w.convert("sext" if kind == "i64" else "trunc", x, kind)


def _bitcast(w: Instructions, equation: Any, x: Value) -> Value:
    return w.convert("bitcast", x, kind_of(equation.outvars[0].aval.dtype))


def _reverse(w: Instructions, equation: Any, x: Value) -> Value:
    shape = equation.invars[0].aval.shape
    dimensions = equation.params["dimensions"]
    source = np.flip(np.arange(np.prod(shape)).reshape(shape), dimensions).ravel()
    if x.is_known:
        known = np.broadcast_to(np.asarray(x.known), (w.lanes,))[source]
        return x._replace(known=known if np.ndim(x.known) else x.known)
    swapped = w.swap_lanes(w.splat(x), source)
    w.exchanged.add(swapped.text)
    return swapped


def _over_lanes(name: str) -> Rule:
    def rule(w: Instructions, equation: Any, x: Value) -> Value:
        if x.kind != "i32":
            raise NotImplementedError(
                f"a kernel reduces int32 over its lanes, not {equation.invars[0].aval.dtype}"
            )
        return w.over_lanes(name, w.splat(x))

    return rule


def _is_finite(w: Instructions, equation: Any, x: Value) -> Value:
    size = _magnitude(w, None, x)
    return w.compute("fcmp olt", size, w.like(x, np.inf), kind="b")


def _clamp(w: Instructions, equation: Any, low: Value, x: Value, high: Value) -> Value:
    return RULES["min"](w, None, RULES["max"](w, None, x, low), high)


RULES: dict[str, Rule] = {
    "add": _arithmetic("add"),
    "add_any": _arithmetic("add"),
    "sub": _arithmetic("sub"),
    "mul": _arithmetic("mul"),
    "div": _divide,
    "rem": _remainder,
    "neg": _negate,
    "abs": _magnitude,
    "max": _extreme("max"),
    "min": _extreme("min"),
    "clamp": _clamp,
    "sign": _sign,
    "square": lambda w, e, x: RULES["mul"](w, None, x, x),
    "integer_pow": _power,
    "sqrt": lambda w, e, x: w.square_root(x),
    "rsqrt": lambda w, e, x: w.inverse_square_root(x),
    "sin": sine,
    "cos": cosine,
    "floor": lambda w, e, x: w.intrinsic("floor", x, flags=""),
    "ceil": lambda w, e, x: w.intrinsic("ceil", x, flags=""),
    "is_finite": _is_finite,
    **{name: _compare(name) for name in ("lt", "le", "gt", "ge", "eq", "ne")},
    **{name: _logic(name) for name in ("and", "or", "xor")},
    "not": _not,
    "shift_left": _shift("shl"),
    "shift_right_logical": _shift("lshr"),
    "select_n": _select_n,
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    "iota": lambda w, e: w.lane_index(),
    "population_count": lambda w, e, x: w.intrinsic("ctpop", x),
    "rev": _reverse,
    "reduce_max": _over_lanes("max"),
    "reduce_min": _over_lanes("min"),
}
