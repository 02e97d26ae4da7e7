"""Results of cases in one file that no kill spoils: a line for each finished part."""

import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

MOST_KEPT = 20
"""Cases of a campaign that broke a promise and are kept with their details; all are counted."""


class Result(NamedTuple):
    """What became of a case.

    Attributes:
      word: The outcome in a word or two; a campaign says which keep its promise.
      detail: What was seen, of an outcome that does not.
      tallies: What the case counted, such as kills.
      most: Greatest values, such as memory maps.
    """

    word: str
    detail: str = ""
    tallies: dict[str, int] = {}  # noqa: RUF012  nobody changes it
    most: dict[str, float] = {}  # noqa: RUF012


class Part(NamedTuple):
    """Cases `first` to `stop` - 1 of a campaign, which were finished together."""

    campaign: str
    first: int
    stop: int
    counts: dict[str, int]
    tallies: dict[str, int]
    most: dict[str, float]
    bad: list[list[Any]]
    seconds: float


class Store:
    """The finished parts of all campaigns, a line of JSON each.

    A line that a killed process left unfinished is passed over and cut off.
    """

    def __init__(self, path: Path):
        """Reads the file, or begins one."""
        self.path, self.parts, self.starts = path, list[Part](), list[dict[str, Any]]()
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = 0
        if path.exists():
            for line in path.read_bytes().splitlines(keepends=True):
                if not line.endswith(b"\n"):
                    break
                whole += len(line)
                values = json.loads(line)
                if "start" in values:
                    self.starts.append(values["start"])
                else:
                    self.parts.append(Part(**values))
            os.truncate(path, whole)

    def start(self, provenance: dict[str, Any]) -> None:
        """Notes a start of the harness: commit, machine, time."""
        self.starts.append(provenance)
        self._append({"start": provenance})

    def add(self, part: Part) -> None:
        """Appends a finished part; it is on disk when this returns."""
        self.parts.append(part)
        self._append(part._asdict())

    def left(self, campaign: str, count: int, size: int) -> Iterator[range]:
        """Numbers below `count` that are not finished, in ranges of at most `size`."""
        at = 0
        done = sorted((p.first, p.stop) for p in self.parts if p.campaign == campaign)
        for first, stop in [*done, (count, count)]:
            while at < min(first, count):
                end = min(at + size, first, count)
                yield range(at, end)
                at = end
            at = max(at, stop)

    def forget(self, wanted: Any) -> int:
        """Drops the parts for which `wanted(part)` holds; returns their number."""
        kept = [part for part in self.parts if not wanted(part)]
        dropped = len(self.parts) - len(kept)
        if dropped:
            lines = [{"start": s} for s in self.starts] + [p._asdict() for p in kept]
            new = self.path.with_suffix(".new")
            new.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
            os.replace(new, self.path)
            self.parts = kept
        return dropped

    def summary(self, campaign: str) -> dict[str, Any]:
        """Counts, tallies, greatest values and broken promises of a campaign's finished parts."""
        parts = [p for p in self.parts if p.campaign == campaign]
        counts, tallies, most = Counter[str](), Counter[str](), dict[str, float]()
        for part in parts:
            counts.update(part.counts)
            tallies.update(part.tallies)
            for name, value in part.most.items():
                most[name] = max(value, most.get(name, value))
        return {
            "cases": sum(p.stop - p.first for p in parts),
            "counts": dict(sorted(counts.items())),
            "tallies": dict(sorted(tallies.items())),
            "most": dict(sorted(most.items())),
            "bad": [entry for part in parts for entry in part.bad][:MOST_KEPT],
            "seconds": round(sum(p.seconds for p in parts), 1),
        }

    def _append(self, values: dict[str, Any]) -> None:
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(values) + "\n")
            file.flush()
            os.fsync(file.fileno())


def gather(
    campaign: str, numbers: range, results: dict[int, Result], good: Any, took: float
) -> Part:
    """Makes the part of finished cases.

    Args:
      campaign: Name of the campaign.
      numbers: The cases' numbers.
      results: Their results by number.
      good: Outcomes that keep the campaign's promise.
      took: Time that they took [s].
    """
    counts, tallies, most = Counter[str](), Counter[str](), dict[str, float]()
    bad = []
    for number in numbers:
        result = results[number]
        counts[result.word] += 1
        tallies.update(result.tallies)
        for name, value in result.most.items():
            most[name] = max(value, most.get(name, value))
        if result.word not in good:
            bad.append([number, result.word, _short(result.detail)])
    return Part(
        campaign,
        numbers.start,
        numbers.stop,
        dict(counts),
        dict(tallies),
        most,
        bad,
        round(took, 2),
    )


def _short(text: str) -> str:
    """A text's beginning, which names the case, and its end, which has the error."""
    return text if len(text) < 2500 else f"{text[:500]}\n[...]\n{text[-2000:]}"
