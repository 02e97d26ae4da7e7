"""What was counted, in the table of docs/faults.md, whose other words are the page's own."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from scripts.faults import cases
from scripts.shared.tables import fill, markdown

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"
HEAD = ["campaign", "fault", "tries", "what is promised", "what was seen", "quick test"]
TRIES, SEEN, TESTS = (HEAD.index(name) for name in ("tries", "what was seen", "quick test"))


def rows(page: Path = PAGE) -> dict[str, list[str]]:
    """The cells of each campaign's row, by its name.

    Raises:
      ValueError: If a campaign has no row, or a row no campaign.
    """
    lines = re.findall(r"^\| `([a-z-]+)` \| (.*) \|$", page.read_text(encoding="utf-8"), re.M)
    found = {name: [f"`{name}`", *text.split(" | ")] for name, text in lines}
    other = {*found} ^ {*cases.CAMPAIGNS} | {n for n, r in found.items() if len(r) != len(HEAD)}
    if other:
        raise ValueError(f"{page} and the campaigns differ in {', '.join(sorted(other))}")
    return {name: found[name] for name in cases.CAMPAIGNS}


def table(data: dict[str, Any], page: Path = PAGE) -> list[list[str]]:
    """The page's table with what was counted: tries, and what was seen."""
    return [HEAD, *_counted(data["campaigns"], rows(page))]


def _counted(found: dict[str, Any], every: dict[str, list[str]]) -> Iterator[list[str]]:
    for name, row in every.items():
        counts = found.get(name, {}).get("counts", {})
        row[TRIES], row[SEEN] = _seen(name, found[name]) if counts else ("–", "not run")
        yield row


def _seen(name: str, found: dict[str, Any]) -> tuple[str, str]:
    """Number of tries, and what was seen in words."""
    campaign, counts = cases.CAMPAIGNS[name], found["counts"]
    tries = found["tallies"].get(campaign.tries, found["cases"])
    seen = ", ".join(
        f"{n:,} {word}" + ("" if word in campaign.good else " (**broken**)")
        for word, n in sorted(counts.items(), key=lambda entry: -entry[1])
    )
    if campaign.tries == "kills":
        signals = {k: n for k, n in found["tallies"].items() if k.startswith("SIG")}
        more = ", ".join(f"{k} {n}" for k, n in signals.items())
        seen += f" of {found['cases']}" + (f"; {more}" if more else "")
    if left := found["tallies"].get("temporary files left"):
        seen += f"; {left} in `.tmp` left"
    if found["most"]:
        seen += "; at most " + ", ".join(f"{v:,.0f} {k}" for k, v in found["most"].items())
    return f"{tries:,}", seen


def note(data: dict[str, Any]) -> str:
    """Of which code and on what machine the counts are."""
    starts = data["starts"]
    total = sum(found["cases"] for found in data["campaigns"].values())
    hours = sum(found["seconds"] for found in data["campaigns"].values()) / 3600
    last = starts[-1]
    return (
        f"{total:,} cases in {hours:.1f} h; Python {last['python']}, "
        f"jax {last['jax']}, {last['cpus']} cores of {last['cpu']}, {last['date'][:10]}."
    )


def write(data: dict[str, Any]) -> None:
    """Fills in the page."""
    fill(PAGE, note(data) + "\n\n" + markdown(table(data)), "counted")
