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
