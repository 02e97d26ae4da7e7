"""Arithmetic on many components as one operation of a kernel's jaxpr.

A law of physics on small arrays is hundreds of operations on numbers of a lane.  To trace them one
by one would take most of the time that a kernel takes to compile.  Here they are recorded on
symbols and bound to JAX as one operation, `straight_line`, which the writer expands.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir


class Operation(NamedTuple):
    """An operation of JAX that an operator stands for; writers take it for an equation."""

    primitive: Any
    function: Callable  # Of arrays; it knows the parameters with which JAX binds the primitive
    params: dict[str, Any] = {}  # noqa: RUF012  # nothing that a writer asks for


_ADD = Operation(jax.lax.add_p, jax.lax.add)
_MUL = Operation(jax.lax.mul_p, jax.lax.mul)
_DIV = Operation(jax.lax.div_p, jax.lax.div)
_OR = Operation(jax.lax.or_p, jax.lax.bitwise_or)
_AND = Operation(jax.lax.and_p, jax.lax.bitwise_and)


class Step(NamedTuple):
    """An operation on earlier values."""

    operation: Any  # An `Operation`, or an equation of a jaxpr
    operands: tuple[Any, ...]  # Numbers of values, int, or numbers known beforehand, NumPy scalars


class StraightLine:
    """Operations without control on values of one shape; programs that are recorded differ.

    Values are numbered: arguments first, then one for each step.

    Attributes:
      steps: The operations.
      results: Numbers of the values that are returned.
    """

    def __init__(self, arguments: list[Any]):
        """Begins a program; arguments: arrays or tracers, of which shape and type are taken."""
        self.steps: list[Step] = []
        self.results: list[int] = []
        self._types: list[Any] = []
        shapes = {v.shape for v in arguments}
        assert len(shapes) <= 1, shapes
        self._shape = next(iter(shapes), ())
        self.arguments = [self._symbol(v.dtype) for v in arguments]

    def _symbol(self, dtype: Any) -> "Symbol":
        self._types.append(np.dtype(dtype))
        return Symbol(self, len(self._types) - 1, self._types[-1])

    def record(self, operation: Any, operands: tuple, types: list[Any], dtype: Any) -> "Symbol":
        """Records a step; operands are symbols or numbers, which have the types."""
        places = tuple(
            v.number if isinstance(v, Symbol) else np.asarray(v, t)[()]
            for v, t in zip(operands, types, strict=True)
        )
        self.steps.append(Step(operation, places))
        return self._symbol(dtype)

    def end(self, results: list["Symbol"]) -> None:
        self.results = [symbol.number for symbol in results]

    def shapes(self) -> list[Any]:
        """Shapes and types of the results."""
        return [ShapedArray(self._shape, self._types[k]) for k in self.results]

    def run(self, values: list[Any], known: Callable, apply: Callable) -> list[Any]:
        """The results of known(number) and apply(operation, operands) from arguments."""
        values = list(values)
        for operation, operands in self.steps:
            inputs = [values[v] if type(v) is int else known(v) for v in operands]
            values.append(apply(operation, inputs))
        return [values[k] for k in self.results]

    def bind(self, values: list[Any]) -> list[Any]:
        """The program's results, bound to JAX as one operation."""
        return straight_line_p.bind(*values, program=self) if self.results else []


class Symbol:
    """A value of a program that is recorded."""

    __slots__ = ("dtype", "number", "program")

    def __init__(self, program: StraightLine, number: int, dtype: np.dtype):
        self.program = program
        self.number = number
        self.dtype = dtype

    def _with(self, operation: Operation, first: Any, second: Any) -> "Symbol":
        return self.program.record(operation, (first, second), [self.dtype] * 2, self.dtype)

    def __add__(self, other: Any) -> "Symbol":
        return self._with(_ADD, self, other)

    def __radd__(self, other: Any) -> "Symbol":
        return self._with(_ADD, other, self)

    def __mul__(self, other: Any) -> "Symbol":
        return self._with(_MUL, self, other)

    def __rmul__(self, other: Any) -> "Symbol":
        return self._with(_MUL, other, self)

    def __rtruediv__(self, other: Any) -> "Symbol":
        return self._with(_DIV, other, self)

    def __or__(self, other: Any) -> "Symbol":
        return self._with(_OR, self, other)

    def __and__(self, other: Any) -> "Symbol":
        return self._with(_AND, self, other)


straight_line_p = Primitive("straight_line")
"""The operation; everything but the writer takes it for its steps."""
straight_line_p.multiple_results = True


def _replay(*values: Any, program: StraightLine) -> list[Any]:
    def known(number: Any) -> Any:
        return jax.lax.full(values[0].shape, number)

    def apply(operation: Any, operands: list[Any]) -> Any:
        if isinstance(operation, Operation):
            return operation.function(*operands)
        return operation.primitive.bind(*operands, **operation.params)

    return program.run([*values], known, apply)


def _jvp(primals: Any, tangents: Any, *, program: StraightLine) -> Any:
    """Of floats alone: the tangents of other types are no numbers that a kernel could have."""
    moving = [
        k
        for k, (value, tangent) in enumerate(zip(primals, tangents, strict=True))
        if type(tangent) is not ad.Zero and _has_derivative(value)
    ]

    def run(*values: Any) -> tuple[list[Any], list[Any]]:
        arguments = dict(enumerate(primals)) | dict(zip(moving, values, strict=True))
        results = _replay(*arguments.values(), program=program)
        return [r for r in results if _has_derivative(r)], results

    given = [tuple(of[k] for k in moving) for of in (primals, tangents)]
    _, slopes, results = jax.jvp(run, *given, has_aux=True)
    rest = iter(slopes)
    return results, [next(rest) if _has_derivative(r) else _no_tangent(r) for r in results]


def _has_derivative(value: Any) -> bool:
    return np.issubdtype(value.dtype, np.floating)


def _no_tangent(value: Any) -> Any:
    return ad.Zero(jax.typeof(value).to_tangent_aval())


def _batched(values: Any, axes: Any, *, program: StraightLine) -> tuple[list[Any], list[int]]:
    results = jax.vmap(partial(_replay, program=program), tuple(axes))(*values)
    return results, [0] * len(results)


straight_line_p.def_impl(_replay)
straight_line_p.def_abstract_eval(lambda *values, program: program.shapes())
ad.primitive_jvps[straight_line_p] = _jvp
batching.primitive_batchers[straight_line_p] = _batched
mlir.register_lowering(straight_line_p, mlir.lower_fun(_replay, multiple_results=True))
