"""A campaign: numbered cases of one fault; docs/faults.md says what each promises."""

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
      name: Name in the store, on the command line and on the page.
      count: Cases of `make faults`.
      case: Runs one.
      keeping: Outcomes that keep the promise, with commas between.
      size: Cases that are done and stored together, by one process.
      limit: Time that a case may take [s], generous: a case beyond it is ended and counts as hung.
      tries: Tally that the page counts as tries; by default the cases.
      alone: Whether a part begins in a process that has done nothing else.
      environment: Variables of that process.
    """

    name: str
    count: int
    case: Case
    keeping: str
    size: int = 1
    limit: float = 180.0
    tries: str = ""
    alone: bool = False
    environment: tuple[tuple[str, str], ...] = ()

    @property
    def good(self) -> frozenset[str]:
        """Outcomes that keep the promise."""
        return frozenset(self.keeping.split(", "))
