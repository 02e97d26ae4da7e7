"""The hard cases as data: what is measured, its bound, and the table of their margins."""

import dataclasses
import functools
import itertools
import json
import math
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from codesign_jax.provenance import environment, git_state
from scripts.shared import evidence

CASES: dict[str, "Case"] = {}
STEPS = (1.0, 0.5, 0.25)
WIDTHS = {"structured": ("float32", "float64"), "mujoco": ("float64",)}
BOTH = tuple(WIDTHS)


class Found(NamedTuple):
    """A measured value, what it is held against, and what a reader should know about this one."""

    measured: float
    bound: float
    note: str = ""


@dataclasses.dataclass(frozen=True)
class Case:
    """One invariant of a hard case, over time steps and precisions.

    Attributes:
      number: Number of the case in the protocol, 1 to 40.
      name: Names of function and engine.
      title: The case.
      invariant: What must hold.
      engine: Engine that simulates.
      measure: The function (engine, step factor, precision) -> Found.
      unit: Unit of the measured value.
      steps: Factors on the time step.
      precisions: Those of the structured engine; MuJoCo C is built for float64.
      quick: The engine whose first step and precision `make test` runs.
      lower: Whether the bound is a lower one.
      failure: Cause of its failure, if it fails.
    """

    number: int
    name: str
    title: str
    invariant: str
    engine: str
    measure: Callable[[str, float, str], Found]
    unit: str = ""
    steps: tuple[float, ...] = STEPS
    precisions: tuple[str, ...] = WIDTHS["structured"]
    quick: str = ""
    lower: bool = False
    failure: str = ""

    @property
    def variants(self) -> list[tuple[float, str]]:
        """Time steps and precisions; the first one may be quick."""
        widths = self.precisions if self.engine == "structured" else WIDTHS[self.engine]
        return list(itertools.product(self.steps, widths))

    def run(self, step: float, precision: str) -> dict[str, Any]:
        """Measures a variant; returns its row of the table."""
        result = self.measure(self.engine, step, precision)
        row = {"case": self.number, "precision": precision, "step": step, "note": result.note}
        names = ("name", "title", "invariant", "engine", "lower", "unit")
        row |= {name: getattr(self, name) for name in names}
        row["failure"] = self.failure
        # of NumPy's, JSON has none
        measured = float(result.measured)
        bound = float(result.bound)
        row |= {"measured": measured, "bound": bound, "margin": margin(self.lower, measured, bound)}
        row["passed"] = row["margin"] >= 1
        return row


def case(number: int, title: str, invariant: str, *, engines=BOTH[:1], name: str = "", **options):
    """Registers a function as a hard case of each engine; `options`: see `Case`."""

    def register(measure):
        for engine in engines:
            full = f"{name or measure.__name__}-{engine}"
            assert full not in CASES, f"two cases are called {full}"
            CASES[full] = Case(number, full, title, invariant, engine, measure, **options)
        return measure

    return register


def case_of_both_scenes(number, title, *invariant, quick="", failure="", **options):
    """Registers a function (scene, engine, step, precision): the spheres', and the default one.

    Of the default one alone `failure` says why it fails.
    """

    def register(measure):
        name = measure.__name__
        spheres, default = (functools.partial(measure, n) for n in ("paper_spheres", "paper"))
        case(number, title, *invariant, name=name, engines=BOTH, quick=quick, **options)(spheres)
        options.update(name=f"{name}_default", failure=failure)
        case(number, f"{title}, default scene", *invariant, **options)(default)

    return register


def margin(lower: bool, measured: float, bound: float) -> float:
    """Bound over measured value, or its inverse for a lower bound; 1 or more passes."""
    if not math.isfinite(measured):
        return 0.0
    top, low = (measured, bound) if lower else (bound, measured)
    if low == 0:
        return math.inf if top >= 0 else 0.0
    return top / low


def current(rows: list[dict[str, Any]]) -> dict[tuple, dict[str, Any]]:
    """Stored rows of variants that exist, by name, step and precision; others are obsolete."""
    variants = {(c.name, *variant) for c in CASES.values() for variant in c.variants}
    by_variant = {(r["name"], r["step"], r["precision"]): r for r in rows}
    return {key: row for key, row in by_variant.items() if key in variants}


def write(docs: Path, new: list[dict[str, Any]], commit: str | None = None) -> None:
    """Puts rows into the stored table and the table into its page; obsolete rows are dropped.

    Args:
      docs: The folder of the documentation.
      new: Rows of this run, which replace those of the same variants.
      commit: Commit of the code where there is no repository to ask.
    """
    state = git_state(commit)
    made = str(state["commit"])[:7] + (" with changes" if state.get("modified") else "")
    versions: Any = environment()["versions"]
    made_with = {name: versions[name] for name in ("jax", "mujoco")}
    made_with |= {"version": evidence.version(), "kernel": evidence.kernel()}
    made_with["python"] = platform.python_version()
    path = docs / "data" / "stability.json"
    page = docs / "notes" / "stability.md"
    old = json.loads(path.read_text())["rows"] if path.exists() else []
    rows = {(r["name"], r["step"], r["precision"]): r for r in old}
    for row in new:
        # JSON has no infinite numbers.
        plain = {k: None if v in (math.inf, -math.inf) else v for k, v in row.items()}
        plain |= {"commit": made, **made_with}
        rows[row["name"], row["step"], row["precision"]] = plain
    kept = sorted(
        current(list(rows.values())).values(),
        key=lambda r: (r["case"], r["name"], r["precision"], -r["step"]),
    )
    data = {"command": "make stability", "rows": kept}
    path.write_text(json.dumps(data, indent=1) + "\n")
    head, tail = page.read_text().split("<!-- table:begin -->")
    tail = tail.split("<!-- table:end -->")[1]
    page.write_text(f"{head}<!-- table:begin -->\n\n{to_markdown(kept)}\n<!-- table:end -->{tail}")
    evidence.write(page)


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """A line for each invariant: the measurement of the least margin; the data have the others."""
    lines = [
        "| case | invariant | least margin | engine, precision, step | measured | bound | remark |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups: dict[tuple, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["case"], row["title"], row["invariant"]), []).append(row)
    for (number_of_case, title, invariant), group in groups.items():
        least = min(group, key=lambda r: math.inf if r["margin"] is None else r["margin"])
        causes = {r.get("failure") or "not explained" for r in group if not r["passed"]}
        remark = "**fails**: " + "; ".join(sorted(causes)) if causes else ""
        engine = "MuJoCo C" if least["engine"] == "mujoco" else least["engine"]
        step = "h" if least["step"] == 1 else f"h/{1 / least['step']:g}"
        measured = f"{number(least['measured'])} {least['unit']}"
        lines.append(
            f"| {number_of_case} {title} | {invariant} | {number(least['margin'])} | "
            f"{engine}, {least['precision']}, {step} | {measured} | "
            f"{'>=' if least['lower'] else '<='} {number(least['bound'])} | {remark} |"
        )
    return "\n".join(lines) + "\n"


def number(value: float | None) -> str:
    """A number with three digits; what JSON keeps as null is infinite."""
    return "inf" if value is None or math.isinf(value) else f"{value:.3g}"
