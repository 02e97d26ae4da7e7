"""Tables of measured rates, in README and on the page about performance."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from scripts.shared.tables import fill, markdown

ROOT = Path(__file__).parents[2]
FILES = "docs/data/rates_*.json"
PAGES = {"README.md": ("rates",), "docs/performance.md": ("rates", "measured", "peers")}
"""Pages with the marks of the tables that they hold."""
BATCHES = {60: ", an episode of the paper's 2D", 360: ", of its 23D experiment"}
DESIGNS = {"random": "random designs", "winners": "winners"}


def replaced(records: list[dict[str, Any]], new: dict[str, Any]) -> list[dict[str, Any]]:
    """The records with a new one in place of the same case's older one."""

    def key(record: dict[str, Any]) -> list:
        return [record[k] for k in ("scene", "designs", "engine", "worlds")]

    return [r for r in records if key(r) != key(new)] + [new]


def read() -> list[dict[str, Any]]:
    """Contents of the files, in the order of their names."""
    return [json.loads(path.read_text()) for path in sorted(ROOT.glob(FILES))]


def machine(run: dict[str, Any]) -> str:
    """What measured, such as "2 CPU cores" and "one H100"."""
    if run["platform"] == "cpu":
        return f"{run['cpus']} CPU cores"
    return f"one {run['device'].removeprefix('NVIDIA ').split()[0]}"


def rates(files: list[dict[str, Any]]) -> str:
    """Grasps a second in the default scene: batches against machines and designs, in Markdown."""
    cells: dict[tuple[str, str], dict[int, str]] = {}
    for found in files:
        for record in found["records"]:
            if record["scene"] == "paper" and record["engine"] == "structured":
                column = machine(found["runs"][record["run"]]), DESIGNS[record["designs"]]
                rate, worlds = record["grasps_per_s"], record["worlds"]
                text = f"{_rounded(rate)} ({_rounded(worlds / rate)} s)"
                cells.setdefault(column, {})[worlds] = text
    columns = sorted(cells, key=lambda c: list(DESIGNS.values()).index(c[1]))
    columns.sort(key=lambda c: [machine(f["runs"][0]) for f in files].index(c[0]))
    sizes = sorted({n for column in cells.values() for n in column})
    rows = [
        [
            "grasps a second (time of a batch)",
            *(f"{where}, {designs}" for where, designs in columns),
        ]
    ]
    for n in sizes:
        rows.append([f"{n:,} grasps{BATCHES.get(n, '')}", *(cells[c].get(n, "–") for c in columns)])
    return markdown(rows)


def measured(files: list[dict[str, Any]]) -> str:
    """What measured the default scene's rates, in a line; the files have the commits."""
    made: dict[str, None] = {}
    for found in files:
        for record in found["records"]:
            run = found["runs"][record["run"]]
            if record["scene"] == "paper":
                made[f"{machine(run)}, JAX {run['jax']}, {run['date'][:10]}"] = None
    return f"Measured on {'; on '.join(made)} (`docs/data/rates_*.json`)."


def peers(files: list[dict[str, Any]]) -> str:
    """This engine beside each peer: the same grasps on the same machine, in Markdown."""
    head = "scene, machine, peer, peer's grasps a second, this engine's, times as many"
    rows = [[*head.split(", "), "same verdicts"]]
    for found in files:
        for theirs in found["records"]:
            if theirs["engine"] == "structured":
                continue
            ours = _beside(found["records"], theirs)
            where = machine(found["runs"][theirs["run"]])
            where += f", {theirs['worlds']:,} grasps" if theirs["worlds"] else ""
            numbers = [theirs["grasps_per_s"], ours["grasps_per_s"]]
            shown = [_rounded(n) for n in numbers]
            ratio = f"{numbers[1] / numbers[0]:.0f}"
            same = _same(ours.get("verdicts", ""), theirs.get("verdicts", ""))
            rows.append([theirs["scene"], where, theirs["engine"], *shown, ratio, same])
    return markdown(rows)


def _beside(records: Iterable[dict[str, Any]], theirs: dict[str, Any]) -> dict[str, Any]:
    alike = [theirs[k] for k in ("scene", "designs", "worlds")]
    [ours] = [
        r
        for r in records
        if [r[k] for k in ("scene", "designs", "worlds")] == alike and r["engine"] == "structured"
    ]
    return ours


def _same(a: str, b: str) -> str:
    pairs = list(zip(a, b, strict=False))
    return f"{sum(x == y for x, y in pairs)} of {len(pairs)}" if pairs else "–"


def _rounded(number: float) -> str:
    """A number with two digits."""
    return f"{float(f'{number:.2g}'):,.0f}" if number >= 10 else f"{number:#.2g}"


def fill_pages() -> None:
    """Fills in the tables from the files."""
    files = read()
    for page, marks in PAGES.items():
        for mark in marks:
            fill(
                ROOT / page,
                {"rates": rates, "measured": measured, "peers": peers}[mark](files),
                mark,
            )
