"""A campaign: numbered cases of one fault, and what is promised about them."""

import dataclasses
from collections.abc import Callable
from typing import Any

from scripts.faults.store import Result

Case = Callable[[Any, int], Result]
"""Runs the case of a number at a `bench.Bench`: the same number is the same case."""


@dataclasses.dataclass(frozen=True)
class Campaign:
    """Cases of one fault, a row of the page's table.

    Attributes:
      name: Name in the store and on the command line.
      count: Cases of `make faults`.
      case: Runs one.
      good: Outcomes that keep the promise.
      fault: What happens, for the page.
      promise: What is promised.
      test: The quick tests that keep the idea, their names with commas.
      size: Cases that are done and stored together, by one process.
      limit: Time that a case may take [s], generous: a case beyond it is ended and counts as hung.
      tries: Tally that the page counts as tries; by default the cases.
      alone: Whether a part begins in a process that has done nothing else.
      environment: Variables of that process.
    """

    name: str
    count: int
    case: Case
    good: frozenset[str]
    fault: str
    promise: str
    test: str = ""
    size: int = 1
    limit: float = 180.0
    tries: str = ""
    alone: bool = False
    environment: tuple[tuple[str, str], ...] = ()

    @property
    def tests(self) -> list[str]:
        """Names of the quick tests."""
        return [name for name in self.test.split(", ") if name]
