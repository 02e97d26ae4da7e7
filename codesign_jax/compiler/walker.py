"""Goes through a kernel's jaxpr, operation by operation, for what writes it in another language."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jax.extend import core

_INLINE = ("jit", "pjit", "closed_call", "custom_jvp_call", "remat2", "checkpoint")
_SAME = (
    "broadcast_in_dim",
    "broadcast_to",
    "reshape",
    "squeeze",
    "stop_gradient",
    "copy",
    "optimization_barrier",
    "reshard",  # in a share of the worlds, see `cores`
)

COMPARE = ("lt", "le", "gt", "ge", "eq", "ne")
"""Primitives that compare."""

# Taylor's polynomials in the square of an angle within pi / 4; the sine's is divided by the angle.
SINE = (1 / 362880, -1 / 5040, 1 / 120, -1 / 6, 1.0)
COSINE = (1 / 40320, -1 / 720, 1 / 24, -0.5, 1.0)


def quarter_turn_parts() -> list[float]:
    """Numbers that add up to pi / 2; the first two times a small whole number are exact."""
    parts, left = [], np.pi / 2
    for bits in (12, 12, 24):
        part = float(np.float32(left))
        if bits == 12:
            scale = 2.0 ** (bits - 1 - np.floor(np.log2(left)))
            part = float(np.floor(left * scale) / scale)
        left -= part
        parts.append(part)
    return parts


def swapped_lanes(shape: tuple[int, ...], dimensions: tuple[int, ...]) -> np.ndarray:
    """Lane that each lane takes its value from when lanes of a shape are reversed."""
    return np.flip(np.arange(np.prod(shape)).reshape(shape), dimensions).ravel()


def _power(w: "Walker", equation: Any, x: Any) -> Any:
    result, y = x, equation.params["y"]
    for _ in range(abs(y) - 1):
        result = w.apply("mul", result, x)
    return result if y > 0 else w.apply("div", w.constant(np.asarray(1.0)), result)


def _sign(w: "Walker", equation: Any, x: Any) -> Any:
    none, one, minus = (w.constant(np.asarray(v)) for v in (0.0, 1.0, -1.0))
    below, above = w.apply("lt", x, none), w.apply("gt", x, none)
    return w.apply("select_n", below, w.apply("select_n", above, none, one), minus)


def _turn(w: "Walker", x: Any) -> tuple[Any, Any]:
    """Quarter turns of an angle and what is left, within pi / 4 (Cody and Waite's reduction)."""
    turns = w.nearest(w.apply("mul", x, w.constant(np.asarray(2 / np.pi))))
    rest = x
    for part in quarter_turn_parts():
        rest = w.fma(turns, w.constant(np.asarray(-part)), rest)
    return w.whole(turns), rest


def _polynomial(w: "Walker", x: Any, coefficients: tuple[float, ...]) -> Any:
    result, *rest = (w.constant(np.asarray(c)) for c in coefficients)
    for c in rest:
        result = w.fma(result, x, c)
    return result


def _sine(shift: int) -> Callable:
    """Sine, or with a shift of one quarter turn cosine, by Taylor's polynomials to 1e-8."""

    def rule(w: "Walker", equation: Any, x: Any) -> Any:
        turns, r = _turn(w, x)
        square = w.apply("mul", r, r)
        sine = w.apply("mul", _polynomial(w, square, SINE), r)
        cosine = _polynomial(w, square, COSINE)
        quarter = w.apply("add", turns, w.constant(np.asarray(shift)))

        def bit(k: int) -> Any:
            masked = w.apply("and", quarter, w.constant(np.asarray(k)))
            return w.apply("ne", masked, w.constant(np.asarray(0)))

        value = w.apply("select_n", bit(1), sine, cosine)
        flipped = bit(2)
        return w.apply("select_n", flipped, value, w.apply("neg", value))

    return rule


SHARED: dict[str, Callable] = {
    "square": lambda w, e, x: w.apply("mul", x, x),
    "integer_pow": _power,
    "sign": _sign,
    "sin": _sine(0),
    "cos": _sine(1),
}
"""Rules of operations that are made of others, in any language."""


class Walker:
    """Writes instructions; a language adds values, memory, control flow and rules.

    Attributes:
      language: Its name.
      rules: Functions of writer, equation and operands to the result, by primitive.
    """

    language: str
    rules: dict[str, Callable]

    def constant(self, array: np.ndarray) -> Any:
        """The value of a literal or captured array."""
        raise NotImplementedError

    def apply(self, name: str, *args: Any) -> Any:
        """The result of an operation that needs no parameters."""
        return self.rules[name](self, None, *args)

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        """The product of a and b plus c, rounded once."""
        raise NotImplementedError

    def nearest(self, x: Any) -> Any:
        """The nearest whole number, a float."""
        raise NotImplementedError

    def whole(self, x: Any) -> Any:
        """A float without its fraction, an integer."""
        raise NotImplementedError

    def same(self, equation: Any, value: Any) -> Any:
        """The value in the shape of the equation's result."""
        raise NotImplementedError

    def get(self, equation: Any, ref: Any, leaves: list) -> Any:
        """Reads memory."""
        raise NotImplementedError

    def swap(self, equation: Any, ref: Any, value: Any, leaves: list) -> None:
        """Writes memory; nobody asks for what was there."""
        raise NotImplementedError

    def loop(self, equation: Any, args: list) -> list:
        """A scan without inputs and outputs: a loop of fixed length."""
        raise NotImplementedError

    def while_loop(self, equation: Any, args: list) -> list:
        """A while loop; its condition is the same on all lanes."""
        raise NotImplementedError

    def branch(self, equation: Any, args: list) -> list:
        """A conditional of two branches; its predicate is the same on all lanes."""
        raise NotImplementedError

    def run(self, jaxpr: Any, consts: Any, args: list) -> list:
        """Instructions of a jaxpr; returns its results.

        Raises:
          NotImplementedError: If an operation has no rule.
        """
        values: dict[Any, Any] = {}

        def read(atom: Any) -> Any:
            literal = isinstance(atom, core.Literal)
            return self.constant(np.asarray(atom.val)) if literal else values[atom]

        numbers = [self.constant(np.asarray(c)) for c in consts]
        values.update(zip(jaxpr.constvars, numbers, strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))
        for equation in jaxpr.eqns:
            results = self.equation(equation, [read(v) for v in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def equation(self, equation: Any, args: list) -> list:
        """Instructions of one operation."""
        name, params = equation.primitive.name, equation.params
        if name in _INLINE:
            inner = params.get("jaxpr", params.get("call_jaxpr"))
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), args)
        if name in _SAME:
            return [self.same(equation, args[0])]
        control = {"scan": self.loop, "while": self.while_loop, "cond": self.branch}
        if name in control:
            return control[name](equation, args)
        if name == "get":
            return [self.get(equation, args[0], args[1:])]
        if name == "swap":
            return [self.swap(equation, args[0], args[1], args[2:])]
        if name not in self.rules:
            raise NotImplementedError(f"no {self.language} instruction for {name}")
        return [self.rules[name](self, equation, *args)]
