"""What a function computes, as a key: closures of one code over equal data have the same."""

import dataclasses
import enum
import functools
import types
from collections.abc import Callable, Hashable
from typing import Any

import jax.numpy as jnp
import numpy as np

_DATA = (type(None), bool, int, str, bytes, type, enum.Enum, np.dtype)
_THEMSELVES = (jnp.ufunc, types.BuiltinFunctionType)
_DEEPEST = 8  # closures within closures; a function that closes over itself has no end


class NoIdentity(TypeError):
    """A value that can only be told from others by being the same object."""


def of(value: Any, depth: int = 0) -> Hashable:
    """A key that equal values share.

    Args:
      value: A function, or what it closes over: numbers, texts, tuples, lists, dicts, arrays of
        NumPy, types, frozen dataclasses and functions.
      depth: How deep in a function's closures the value was found.

    Raises:
      NoIdentity: If it is, or holds, something else, such as an array of JAX or an object whose
        state a method may read.
    """
    if depth > _DEEPEST:
        raise NoIdentity(f"{value!r} lies too deep")
    deeper = functools.partial(of, depth=depth + 1)
    if isinstance(value, _THEMSELVES):
        return value
    if isinstance(value, types.FunctionType):
        return value.__code__, *map(deeper, _beside_arguments(value))
    if isinstance(value, functools.partial):
        return "partial", *map(deeper, (value.func, value.args, value.keywords))
    if isinstance(value, np.generic | np.ndarray | float):  # by bits: -0.0 is not 0.0
        array = np.asarray(value)
        return type(value), array.dtype, array.shape, array.tobytes()
    if isinstance(value, _DATA):
        return type(value), value
    if isinstance(value, tuple | list):
        return type(value), *map(deeper, value)
    if isinstance(value, dict):
        return dict, *((key, deeper(v)) for key, v in value.items())
    if dataclasses.is_dataclass(value) and isinstance(value, Hashable):
        return type(value), value
    raise NoIdentity(f"{value!r} has no value that could be compared")


def _beside_arguments(function: Callable) -> list:
    """What a function's code reads besides arguments and the names of its module."""
    try:
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
    except ValueError:  # a name that has no value yet
        raise NoIdentity(f"{function!r} is not complete") from None
    return [*cells, function.__defaults__, function.__kwdefaults__, function.__module__]
