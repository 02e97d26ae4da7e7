"""Which rows of memory a GPU's loop asks for ahead of their use, and how far ahead."""

from typing import NamedTuple

AHEAD = 300
"""Lines of a loop between asking for a row and reading it, about the time that memory takes."""


class Ahead(NamedTuple):
    """Rows that a loop reads at an address, and reads again further on in the next round.

    Attributes:
      line: Line behind which the address is known.
      offsets: Offsets of the rows from the address [bytes].
    """

    line: int
    offsets: list[int]


def rounds_ahead(lines: int, length: int) -> int:
    """How many rounds ahead of its use a loop prefetches a row.

    As many as memory takes, but few against the loop's length: what is asked for in the last rounds
    lies behind the rows that the loop reads.

    Args:
      lines: Lines of the loop's body.
      length: Its number of rounds.
    """
    return min(-(-AHEAD // max(1, lines)), max(1, length // 5))


def adjacent(offsets: list[int], row: int, lanes: int) -> list[tuple[int, int]]:
    """Runs of adjacent rows: first offset and number, at most as many as lanes."""
    found: list[tuple[int, int]] = []
    for offset in offsets:
        if found and offset == found[-1][0] + row * found[-1][1] and found[-1][1] < lanes:
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((offset, 1))
    return found
