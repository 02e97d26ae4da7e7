"""Size of a program before it is compiled: equations and floating-point operations."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

# One operation an element; what only moves or chooses numbers is free.
_ARITHMETIC = frozenset(
    "add sub mul div neg abs max min sqrt rsqrt sin cos tan exp log expm1 log1p pow integer_pow "
    "square sign floor atan2 tanh logistic erf cumsum reduce_sum reduce_max".split()
)


class Size(NamedTuple):
    """Size of a program.

    Attributes:
      equations: Equations of the jaxpr, each counted once, wherever it is nested.
      flops: Floating-point operations: those of a `scan` times its length, those of a `while` for
        one iteration, those of a `cond` for its larger branch.
    """

    equations: int
    flops: float


def jaxpr_size(jaxpr: Any) -> Size:
    """Returns the size of a jaxpr with all jaxprs inside its equations.

    XLA's own cost analysis counts the body of every loop once, also of a `scan` whose length it
    knows (`HloCostAnalysis::HandleWhile`), and so a chain of forty links like one of a single link.
    """
    equations, flops = 0, 0.0
    for equation in jaxpr.eqns:
        inner = [jaxpr_size(j) for j in _inner(equation)]
        equations += 1 + sum(s.equations for s in inner)
        name = equation.primitive.name
        if name == "scan":
            flops += equation.params["length"] * inner[0].flops
        elif name == "cond":
            flops += max(s.flops for s in inner)
        elif inner:
            flops += sum(s.flops for s in inner)
        elif name == "dot_general":
            flops += _product(equation)
        elif name in _ARITHMETIC:
            # A reduction does one operation for each number that it reads.
            of = equation.invars if name.startswith("reduce") else equation.outvars
            flops += _elements(of[0])
    return Size(equations, flops)


def _inner(equation: Any) -> Iterator[Any]:
    """The jaxprs inside an equation."""
    for value in equation.params.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            jaxpr = getattr(item, "jaxpr", item)
            if hasattr(jaxpr, "eqns"):
                yield jaxpr


def _elements(variable: Any) -> int:
    aval = variable.aval
    return int(np.prod(aval.shape)) if np.issubdtype(aval.dtype, np.floating) else 0


def _product(equation: Any) -> float:
    (contracted, _), _ = equation.params["dimension_numbers"]
    depth = np.prod([equation.invars[0].aval.shape[i] for i in contracted])
    return 2.0 * float(depth) * _elements(equation.outvars[0])
