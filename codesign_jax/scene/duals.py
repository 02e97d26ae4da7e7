"""Numbers with slopes by two variables: forward differentiation for NumPy's and JAX's arrays."""

from __future__ import annotations

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Dual:
    """A value with its slopes; other operands are constants, numbers or arrays.

    Attributes:
      value: The value.
      first: Its slope by the first variable.
      second: By the second one.
    """

    value: Any
    first: Any
    second: Any = 0.0
    __array_ufunc__ = None  # NumPy's arrays leave their operators to this class

    def __add__(self, other: Any) -> Dual:
        """The sum."""
        if not isinstance(other, Dual):
            return Dual(self.value + other, self.first, self.second)
        return Dual(self.value + other.value, self.first + other.first, self.second + other.second)

    def __neg__(self) -> Dual:
        """The negative."""
        return Dual(-self.value, -self.first, -self.second)

    def __sub__(self, other: Any) -> Dual:
        """The difference."""
        return self + -other

    def __rsub__(self, other: Any) -> Dual:
        """A constant less this one."""
        return -self + other

    def __mul__(self, other: Any) -> Dual:
        """The product."""
        if not isinstance(other, Dual):
            return Dual(self.value * other, self.first * other, self.second * other)
        return Dual(
            self.value * other.value,
            self.first * other.value + self.value * other.first,
            self.second * other.value + self.value * other.second,
        )

    def __truediv__(self, other: Any) -> Dual:
        """The quotient."""
        if not isinstance(other, Dual):
            return self * (1 / other)
        inverse = 1 / other.value
        value = self.value * inverse
        return Dual(
            value,
            (self.first - value * other.first) * inverse,
            (self.second - value * other.second) * inverse,
        )

    def sqrt(self) -> Dual:
        """The square root of a positive value."""
        root = self.value.__array_namespace__().sqrt(self.value)
        half = 0.5 / root
        return Dual(root, self.first * half, self.second * half)

    def where(self, which: Any, other: Dual) -> Dual:
        """This one where `which`, else the other one."""
        where = self.value.__array_namespace__().where
        pairs = (
            (self.value, other.value),
            (self.first, other.first),
            (self.second, other.second),
        )
        return Dual(*(where(which, a, b) for a, b in pairs))
