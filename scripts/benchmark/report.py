"""Keeps the records of a benchmark and turns them into tables."""

import dataclasses
import hashlib
from typing import Any

from scripts.shared import peers, statistics, work
from scripts.shared.tables import markdown

KEY = ("engine", "setting", "kind", "worlds", "variant", "growth")


def reference_key() -> str:
    """Digest of what the reference costs depend on: scene, designs, trials and solver."""
    import mujoco

    scene = work.variant(solver=peers.REFERENCE)
    parts = [dataclasses.asdict(scene), work.GOOD, work.SEED, work.TRIALS, mujoco.__version__]
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def warp_runs(machine: dict[str, Any]) -> bool:
    """Whether MuJoCo Warp can be measured: a GPU and the package."""
    return machine["platform"] == "gpu" and bool(machine["warp"])


def add(results: dict[str, Any], record: dict[str, Any], reference: list[float]) -> None:
    """Puts a record into the results in place of the same case's older one.

    Args:
      results: The file's contents, changed.
      record: The record; its costs are replaced by their comparison with the reference.
      reference: Costs of the reference, shape (world,); empty if no case is compared.
    """
    costs = record.pop("costs", None)
    if costs and reference:
        record["agreement"] = statistics.agreement(costs, reference, work.TRIALS)

    def key(r: dict[str, Any]) -> list:
        return [r.get(k) for k in KEY]

    kept = [r for r in results["records"] if key(r) != key(record)]
    results["records"] = [*kept, record]


def line(record: dict[str, Any]) -> str:
    """One line about a record."""
    name = f"{record['engine']}:{record['setting']} {record['kind']}"
    name += "".join(f" {k}={v}" for k, v in record.get("variant", {}).items())
    name += f" x{record['worlds']}" if "worlds" in record else ""
    if "problem" in record or "skipped" in record:
        return f"{name}: {record.get('problem') or record.get('skipped')}"
    if "median_s" in record:
        rate = record["nominal_world_steps_per_s"]
        return f"{name}: {rate:,.0f} world-steps/s, compile {record['compile_s']:.1f} s"
    return f"{name}: median error {record['median']:.1e}, 99 % {record['p99']:.1e}"


def growth(results: dict[str, Any], name: str) -> dict[str, list[tuple[float, float]]]:
    """Microseconds of a world's step by engine, for a variant's key, sorted by its value."""
    found: dict[str, list[tuple[float, float]]] = {}
    for r in results["records"]:
        # A first run loads the program: a case without a second one has no cost to show.
        if r.get("growth") and name in r["variant"] and r.get("warm"):
            cost = 1e6 / r["nominal_world_steps_per_s"]
            found.setdefault(r["engine"], []).append((r["variant"][name], cost))
    return {engine: sorted(points) for engine, points in found.items()}


def measured(results: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    """Records of a kind, variants left out, that have figures."""
    return [
        r
        for r in results["records"]
        if r["kind"] == kind and not r.get("growth") and not {"problem", "skipped"} & set(r)
    ]


def _head(names: str) -> list[list[str]]:
    return [[str(name) for name in names.split(", ")]]


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _compile(record: dict[str, Any]) -> str:
    text = f"{record['trace_s'] + record['compile_s']:.1f}"
    cached = record.get("cached_start_s")
    return text if cached is None else f"{text} ({cached:.1f})"


def grasp_table(results: dict[str, Any]) -> list[list[str]]:
    """Whole grasps: rates, compile time, memory and verdicts."""
    head = "engine, setting, worlds, grasps/s, nominal steps/s, simulated steps/s, simulated share"
    head += ", compile s (cached), memory MiB, same verdict, rank correlation, stops early"
    rows = _head(head)
    for r in measured(results, "grasp"):
        a, early = r.get("agreement", {}), r["stops_early"]
        rows.append(
            [
                r["engine"],
                r["setting"],
                f"{r['worlds']:,}",
                f"{r['grasps_per_s']:,.1f}",
                f"{r['nominal_world_steps_per_s']:,.0f}",
                f"{r['simulated_world_steps_per_s']:,.0f}",
                f"{r['simulated_share']:.0%}",
                _compile(r),
                f"{r['peak_memory_bytes'] / 2**20:,.0f}",
                _number(a.get("same_verdict"), ".1%"),
                _number(a.get("spearman"), ".3f"),
                {True: "yes", False: "no", None: "–"}[early],
            ]
        )
    return rows


def window_table(results: dict[str, Any]) -> list[list[str]]:
    """Short rollouts in contact, with the errors of the accelerations."""
    errors = {(r["engine"], r["setting"]): r for r in measured(results, "residual")}
    rows = _head("engine, setting, worlds, steps, steps/s, error median, error 99 %")
    for r in measured(results, "window"):
        e = errors.get((r["engine"], r["setting"]), {})
        rows.append(
            [
                r["engine"],
                r["setting"],
                f"{r['worlds']:,}",
                str(r["steps"]),
                f"{r['nominal_world_steps_per_s']:,.0f}",
                _number(e.get("median"), ".1e"),
                _number(e.get("p99"), ".1e"),
            ]
        )
    return rows


def growth_table(results: dict[str, Any]) -> list[list[str]]:
    """Microseconds of a world's step against links, fingers and spheres."""
    rows = [["engine", "against", "µs a world and step", "exponent"]]
    for name in ("links", "fingers", "spheres"):
        for engine, points in growth(results, name).items():
            upper = [p for p in points if name != "links" or p[0] >= 10]
            slope = statistics.slope(*zip(*upper, strict=True)) if len(upper) > 1 else None
            text = ", ".join(f"{int(n)}: {cost:,.3g}" for n, cost in points)
            rows.append([engine, name, text, _number(slope, ".2f")])
    for r in results["records"]:
        if r.get("growth") and "hand_name" in r["variant"] and "median_s" in r:
            cost = 1e6 / r["nominal_world_steps_per_s"]
            rows.append([r["engine"], "hand", f"{r['variant']['hand_name']}: {cost:,.3g}", "–"])
    return rows


def tables(results: dict[str, Any]) -> str:
    """All tables that have rows, in Markdown."""
    every = (grasp_table, window_table, growth_table)
    made = [table(results) for table in every]
    return "\n\n".join(markdown(rows) for rows in made if len(rows) > 1)
