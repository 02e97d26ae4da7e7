"""The table of docs/faults.md, from what was counted."""

from pathlib import Path
from typing import Any

from scripts.faults import cases
from scripts.shared.tables import fill, markdown


def table(data: dict[str, Any]) -> list[list[str]]:
    """A row for each campaign: fault, tries, promise, what was seen, test."""
    rows = [["fault", "tries", "what is promised", "what was seen", "test"]]
    for name, campaign in cases.CAMPAIGNS.items():
        found = data["campaigns"].get(name, {})
        counts = found.get("counts", {})
        if not counts:
            rows.append([campaign.fault, "–", campaign.promise, "not run", _tests(campaign)])
            continue
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
        rows.append([campaign.fault, f"{tries:,}", campaign.promise, seen, _tests(campaign)])
    return rows


def _tests(campaign: Any) -> str:
    own = f"`make faults`, `{campaign.name}`"
    quick = [f"`{name}`" for name in campaign.tests]
    return ", ".join([*quick, own])


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


def write(data: dict[str, Any], page: Path) -> None:
    """Puts note and table between the page's marks; what stands around them stays.

    Raises:
      ValueError: If the page lacks a mark.
    """
    fill(page, note(data) + "\n\n" + markdown(table(data)), "counted")
