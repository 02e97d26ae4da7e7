"""Sine and cosine of a kernel, by Taylor's polynomials after Cody and Waite's reduction.

W. J. Cody, W. Waite, Software Manual for the Elementary Functions, 1980: a multiple of pi / 2, kept
in parts that a fused multiplication subtracts without loss, is taken off the angle.  The rest is
within pi / 4, where the polynomials below are exact to half a unit in the last place of their type.
Angles beyond some 1e5 lose the digits that the multiple takes.
"""

from fractions import Fraction
from math import factorial
from typing import TYPE_CHECKING, Any

import numpy as np

from codesign_jax.compiler.values import Value, numpy_type

if TYPE_CHECKING:
    from codesign_jax.compiler.writer import Writer

_HALF_PI = Fraction("3.14159265358979323846264338327950288419716939937510") / 2
# Terms of each polynomial and bits of the parts of pi / 2, by type.
_TERMS = {"f32": 5, "f64": 9}
_BITS = {"f32": (12, 12, 24), "f64": (33, 33, 53)}


def half_pi_parts(kind: str) -> list[float]:
    """Numbers that add up to pi / 2; all but the last times a small whole number are exact."""
    parts, left = [], _HALF_PI
    for bits in _BITS[kind]:
        scale = Fraction(2) ** (bits - 1 - int(np.floor(np.log2(float(left)))))
        part = Fraction(int(left * scale), 1) / scale
        left -= part
        parts.append(float(part))
    return parts


def _polynomial(w: "Writer", x: Value, first: int, terms: int) -> Value:
    """Sum of (-x)^k / (2 k + first)!, the last term first."""
    coefficients = [(-1) ** k / factorial(2 * k + first) for k in range(terms)]
    result, *rest = (w.like(x, c) for c in reversed(coefficients))
    for c in rest:
        result = w.fma(result, x, c)
    return result


def _of_angle(w: "Writer", x: Value, shift: int) -> Value:
    """Sine of an angle to which `shift` quarter turns are added."""
    from codesign_jax.compiler.rules import RULES

    one = numpy_type(x.kind)
    turns = w.intrinsic("rint", w.compute("fmul", x, w.like(x, 2 / np.pi)), flags="")
    rest = x
    for part in half_pi_parts(x.kind):
        rest = w.fma(turns, w.like(x, one(-part)), rest)
    square = w.compute("fmul", rest, rest)
    sine = w.compute("fmul", _polynomial(w, square, 1, _TERMS[x.kind]), rest)
    cosine = _polynomial(w, square, 0, _TERMS[x.kind])
    quarter = RULES["add"](w, None, w.whole(turns), Value("i32", False, None, shift))

    def bit(k: int) -> Value:
        masked = w.compute("and", quarter, Value("i32", False, None, k))
        return w.compute("icmp ne", masked, Value("i32", False, None, 0), kind="b")

    value = w.select(bit(1), cosine, sine)
    return w.select(bit(2), w.compute("fneg", value), value)


def sine(w: "Writer", equation: Any, x: Value) -> Value:
    """Rule of `sin`."""
    return _of_angle(w, x, 0)


def cosine(w: "Writer", equation: Any, x: Value) -> Value:
    """Rule of `cos`."""
    return _of_angle(w, x, 1)
