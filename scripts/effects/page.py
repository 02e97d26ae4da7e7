"""Table and figure of what effects cost and decide, from the measured file."""

from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax.scene.effects import EFFECTS, ENGINES
from scripts.shared import figures as pictures
from scripts.shared.tables import fill, markdown

REFERENCE = "as it is"


def draw(results: dict[str, Any], path: Path) -> None:
    """Time of a step and success rate of the scene with each effect turned over."""
    rows = results["effects"]
    names = [*(n for n in rows if n != REFERENCE), REFERENCE][::-1]
    figure = pictures.new(9.6, 5.6)
    left, right = figure.subplots(1, 2, sharey=True)
    for axis, field, bounds in (
        (left, "ratio", lambda r: r["ratio_quartiles"]),
        (right, "success", lambda r: (r["success_low"], r["success_high"])),
    ):
        place = [k for k, n in enumerate(names) if field in rows[n]]
        value = np.array([rows[names[k]][field] for k in place])
        low, high = np.array([bounds(rows[names[k]]) for k in place]).T
        # A share of 0 or 1 lies on its interval's end but for rounding.
        error = np.maximum([value - low, high - value], 0.0)
        axis.errorbar(value, place, xerr=error, fmt="o", ms=4, capsize=2)
        axis.axvline(rows[REFERENCE][field], color="black", lw=0.8, ls="--")
        axis.grid(axis="x", alpha=0.3)
    left.set_yticks(range(len(names)), names)
    left.set(xlabel="time of a step, relative to the scene as it is, quartiles", xlim=(0, None))
    right.set(xlabel="success rate with 95 % interval")
    pictures.save(figure, path)


def support_table() -> list[list[str]]:
    """What each effect means and which engines have it, in words."""
    table = [["effect", "meaning", *ENGINES]]
    for name, effect in EFFECTS.items():
        cells = []
        for engine in ENGINES:
            refused = effect.refused.get(engine, {})
            words = [f"not {str(v).lower() if isinstance(v, bool) else v}" for v in refused]
            no_hull = effect.hull and "hull" in EFFECTS["surface"].refused.get(engine, {})
            cells.append(", ".join(words) or ("no hull" if no_hull else "yes"))
        table.append([f"`{name}`", effect.meaning, *cells])
    return table


def measured_table(results: dict[str, Any]) -> list[list[str]]:
    """A row for each change of the scene; what was not measured is a dash."""
    head = ["change", "µs a step", "time ×"]
    table = [[*head, "success (95 %)", "same verdict", "rank corr."]]
    rows = results["effects"]
    for name, r in rows.items():
        same = " (same program)" if _same(rows, name) else ""
        program = ["–"] * 2
        if "ratio" in r:
            low, high = r["ratio_quartiles"]
            program = [
                f"{r['step_seconds'] * 1e6:.1f}",
                f"{r['ratio']:.2f} ({low:.2f}–{high:.2f})",
            ]
        decision = ["–"] * 3
        if "success" in r:
            rank = r["rank_correlation"]
            decision = [
                f"{r['success']:.3f} ({r['success_low']:.3f}–{r['success_high']:.3f})",
                f"{r['same_verdict']:.3f}",
                "–" if rank is None else f"{rank:.3f}",
            ]
        table.append([name + same, *program, *decision])
    return table


def _same(rows: dict[str, Any], name: str) -> bool:
    mine, reference = (rows[n].get("program") for n in (name, REFERENCE))
    return name != REFERENCE and mine is not None and mine == reference


def write(results: dict[str, Any], page: Path, note: Path) -> None:
    """Puts the tables between the pages' marks; what stands around them stays."""
    p = results["provenance"]
    load = [f"{results[k][0]:.1f}" for k in ("load_before", "load_after") if k in results]
    worlds = results["effects"][REFERENCE].get("worlds", 0)
    made = (
        f"{worlds} grasps, {results.get('trials')} trials a design; {p['cpus']} cores of {p['cpu']}"
        f", jax {p['jax']}, MuJoCo {p['mujoco']}, commit {p['commit']}; load of the machine while "
        f"timing: {' to '.join(load) or 'not timed'}."
    )
    fill(note, made + "\n\n" + markdown(measured_table(results)), "measured")
    fill(page, markdown(support_table()), "support")
