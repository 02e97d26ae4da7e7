"""Keeps the records of a benchmark and turns them into a table."""

import dataclasses
import hashlib
from typing import Any

from scripts.shared import peers, statistics, work
from scripts.shared.tables import markdown

KEY = ("engine", "setting", "worlds")


def reference_key() -> str:
    """Digest of what the reference costs depend on: scene, designs, trials and solver."""
    import mujoco

    scene = work.variant(solver=peers.REFERENCE)
    parts = [dataclasses.asdict(scene), work.GOOD, work.SEED, work.TRIALS, mujoco.__version__]
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def add(results: dict[str, Any], record: dict[str, Any], reference: list[float]) -> None:
    """Puts a record into the results in place of the same case's older one.

    Args:
      results: The file's contents, changed.
      record: The record; its costs are replaced by their comparison with the reference.
      reference: Costs of the reference, shape (world,).
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
    name = f"{record['engine']}:{record['setting']}"
    name += f" x{record['worlds']}" if "worlds" in record else ""
    if "problem" in record or "skipped" in record:
        return f"{name}: {record.get('problem') or record.get('skipped')}"
    return f"{name}: {record['grasps_per_s']:,.1f} grasps/s, compile {record['compile_s']:.1f} s"


def table(results: dict[str, Any]) -> str:
    """Rates, compile time, memory and verdicts of every case that was measured, in Markdown."""
    head = "engine, setting, worlds, grasps/s, nominal steps/s, simulated steps/s, compile s"
    head += ", memory MiB, same verdict, rank correlation, stops early"
    rows = [head.split(", ")]
    for r in results["records"]:
        if {"problem", "skipped"} & set(r):
            continue
        a, yes = r.get("agreement", {}), {True: "yes", False: "no", None: "–"}
        numbers = [(a.get("same_verdict"), ".1%"), (a.get("spearman"), ".3f")]
        rows.append(
            [
                r["engine"],
                r["setting"],
                f"{r['worlds']:,}",
                f"{r['grasps_per_s']:,.1f}",
                f"{r['nominal_world_steps_per_s']:,.0f}",
                f"{r['simulated_world_steps_per_s']:,.0f}",
                f"{r['trace_s'] + r['compile_s']:.1f}",
                f"{r['peak_memory_bytes'] / 2**20:,.0f}",
                *("–" if v is None else format(v, form) for v, form in numbers),
                yes[r["stops_early"]],
            ]
        )
    return markdown(rows)
