"""The hard cases as data: what is measured, its bound, and the table of their margins."""

import itertools
import json
import math
from collections.abc import Callable
from typing import Any, NamedTuple

CASES: dict[str, "Case"] = {}


class Found(NamedTuple):
    """What a case measured.

    Attributes:
      measured: The measured value.
      bound: What it is held against.
      note: What a reader should know about this one.
    """

    measured: float
    bound: float
    note: str = ""


class Case(NamedTuple):
    """One invariant of a hard case, over time steps and precisions.

    Attributes:
      number: Number of the case in the protocol, 1 to 25.
      name: Name of the function.
      title: The case.
      invariant: What must hold.
      engine: Engine that simulates.
      unit: Unit of the measured value.
      variants: Factors on the time step and precisions.
      quick: The variants that `make test` runs.
      lower: Whether the bound is a lower one.
      failures: Reason of an honest failure by variant.
      measure: The function.
    """

    number: int
    name: str
    title: str
    invariant: str
    engine: str
    unit: str
    variants: tuple[tuple[float, str], ...]
    quick: tuple[tuple[float, str], ...]
    lower: bool
    failures: dict[tuple[float, str], str]
    measure: Callable[[str, float, str], Found]

    def run(self, variant: tuple[float, str]) -> dict[str, Any]:
        """Measures a variant; returns its row of the table."""
        step, precision = variant
        found = self.measure(self.engine, step, precision)
        row = {"case": self.number, "name": self.name, "title": self.title}
        row |= {"invariant": self.invariant, "engine": self.engine, "precision": precision}
        row |= {"step": step, "measured": float(found.measured), "bound": float(found.bound)}
        row |= {"lower": self.lower, "unit": self.unit, "note": found.note}
        row["margin"] = margin(row)
        row["passed"] = row["margin"] >= 1
        row["failure"] = self.failures.get(variant, "")
        return row


STEPS = (1.0, 0.5, 0.25)
BOTH = ("float32", "float64")


def case(
    number: int,
    title: str,
    invariant: str,
    *,
    engine: str = "structured",
    unit: str = "",
    steps: tuple[float, ...] = STEPS,
    precisions: tuple[str, ...] | None = None,
    quick: tuple[tuple[float, str], ...] = (),
    lower: bool = False,
    failures: dict[tuple[float, str], str] | None = None,
    name: str = "",
):
    """Registers a function (engine, step factor, precision) -> Found as a hard case.

    Its name, by default the function's, and its engine tell it from all others.
    """
    widths = precisions or (BOTH if engine == "structured" else ("float64",))

    def register(measure: Callable[[str, float, str], Found]):
        full = f"{name or measure.__name__}-{engine}"
        assert full not in CASES, f"two cases are called {full}"
        variants = tuple(itertools.product(steps, widths))
        CASES[full] = Case(
            number,
            full,
            title,
            invariant,
            engine,
            unit,
            variants,
            quick,
            lower,
            failures or {},
            measure,
        )
        return measure

    return register


def margin(row: dict[str, Any]) -> float:
    """Bound over measured value, or its inverse for a lower bound; 1 or more passes."""
    measured, bound = row["measured"], row["bound"]
    if not math.isfinite(measured):
        return 0.0
    top, low = (measured, bound) if row["lower"] else (bound, measured)
    if low == 0:
        return math.inf if top >= 0 else 0.0
    return top / low


def merge(rows: list[dict[str, Any]], old: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Replaces the rows that were measured again; sorted by case."""
    table = {_key(r): r for r in [*old, *rows]}
    order = {p: i for i, p in enumerate(BOTH)}
    return sorted(
        table.values(),
        key=lambda r: (r["case"], r["name"], -r["step"], order[r["precision"]]),
    )


def _key(row: dict[str, Any]) -> tuple:
    return row["name"], row["step"], row["precision"]


def to_json(table: dict[str, Any]) -> str:
    """The table as JSON; an infinite margin becomes null."""

    def plain(v: Any) -> Any:
        return None if isinstance(v, float) and not math.isfinite(v) else v

    rows = [{k: plain(v) for k, v in r.items()} for r in table["rows"]]
    return json.dumps({**table, "rows": rows}, indent=1) + "\n"


def number(value: float | None) -> str:
    """A number with three digits; what JSON keeps as null is infinite."""
    return "inf" if value is None or math.isinf(value) else f"{value:.3g}"


def step_name(step: float) -> str:
    """The time step as a part of h, the paper's 10 ms."""
    return "h" if step == 1 else f"h/{1 / step:g}"


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """A row for each invariant, engine and precision: measured values over the time steps."""
    lines = [
        "| case | invariant | engine | measured (h; h/2; h/4) | bound | least margin | commit | |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups = itertools.groupby(rows, lambda r: (r["case"], r["name"]))
    for (count, _), group in groups:
        group = list(group)
        for precision in BOTH:
            part = [r for r in group if r["precision"] == precision]
            if part:
                lines.append(_line(count, precision, part))
    return "\n".join(lines) + "\n"


def _line(count: int, precision: str, part: list[dict[str, Any]]) -> str:
    first = part[0]
    values = "; ".join(number(r["measured"]) for r in part)
    steps = [r["step"] for r in part]
    if tuple(steps) != STEPS:
        values += f" ({'; '.join(map(step_name, steps))})"
    bounds = sorted({number(r["bound"]) for r in part})
    sign = ">=" if first["lower"] else "<="
    least = min(math.inf if r["margin"] is None else r["margin"] for r in part)
    verdict = (
        ""
        if all(r["passed"] for r in part)
        else "**fails**: "
        + "; ".join(sorted({r["failure"] or "not explained" for r in part if not r["passed"]}))
    )
    notes = "; ".join(sorted({r["note"] for r in part if r["note"]}))
    text = " ".join(filter(None, (verdict, notes)))
    made = ", ".join(sorted({r.get("commit", "") for r in part}))
    engine = "MuJoCo C" if first["engine"] == "mujoco" else first["engine"]
    return (
        f"| {count} {first['title']} | {first['invariant']} | {engine}, {precision} | {values} "
        f"{first['unit']} | {sign} {', '.join(bounds)} | {number(least)} | {made} | {text} |"
    )
