"""Tables of the pages on searches, from the files of their studies."""

import functools
from typing import Any

import numpy as np

from codesign_jax import scene
from codesign_jax.judge.verdict import WANTED
from codesign_jax.optimize import DEFAULT, NAMES
from codesign_jax.runs.settings import COARSE
from codesign_jax.statistics import wilson
from scripts.shared import output, statistics

LIMITED = "23d"
"""Preset of the whole table within the scene's limits."""
TABLE = "paper-23d"
"""Preset of the whole table without them."""
SEARCHED = "--searched="
JUDGED = "--judged="
"""Options of a search with accuracies of its own for the episodes and for the judging trials."""
EQUAL_TIME = "equal time"
"""Change of a search that has the default search's time, not its grasps."""
ALIKE = (SEARCHED, JUDGED, "--first=", EQUAL_TIME)
"""Beginnings of changes that leave scene and hand as they are."""
LINES = "hand.valves.lines="
"""Change of a search in which fingers share pressure lines."""


def order(row: dict[str, Any]) -> tuple:
    """Where a row stands: 23D, the paper's objects, the default and `reference` first."""
    name = row["optimizer"].split(":")[0]
    place = NAMES.index(name) if name in NAMES else len(NAMES)
    few = row["preset"] not in (LIMITED, TABLE)
    judged = not _option(row, JUDGED)
    objects = row.get("objects") or ""
    return few, row["preset"] != LIMITED, objects, place, judged, row["optimizer"]


def hand_of(row: dict[str, Any]) -> str:
    """Name of the hand that was searched: that of the scene, unless the row names another."""
    return row.get("hand") or _hand_of_scene(row.get("scene", "paper"))


@functools.cache
def _hand_of_scene(name: str) -> str:
    return scene.load(name).hand.name


def tables(rows: list[dict[str, Any]]) -> dict[str, str]:
    """Tables of the page on searches, by their marks; a table without rows is left out."""
    alike = [row for row in rows if "kept" in row and not _changed(row)]
    timed = [r for r in alike if EQUAL_TIME in r["changes"] or _option(r, SEARCHED) == COARSE]
    groups = {
        "equal-time": [row for row in timed if _is_usual(row)],
        "other-hands": [row for row in timed if not _is_usual(row)],
        "equal-grasps": [row for row in alike if not row["changes"]],
    }
    texts = {mark: table(group) for mark, group in groups.items() if group}
    if any("masses" in row for row in rows):
        texts["masses"] = masses_table(rows)
    return texts


def table(rows: list[dict[str, Any]]) -> str:
    """A row for each search: what its recommended designs keep at its last mark.

    What all searches have in common is left out, and is for the page to say.
    """
    table_rows = []
    for row in sorted(rows, key=order):
        kept = np.array(row["kept"][-1])
        searched = {
            "optimiser": f"`{row['optimizer']}`",
            "preset": row["preset"],
            "hand": f"`{hand_of(row)}`",
            "objects": row.get("objects") or "three",
            "episodes at": f"`{_option(row, SEARCHED) or 'standard'}`",
            "judged at": f"`{_option(row, JUDGED) or 'standard'}`",
        }
        outcome = {
            "seeds": str(kept.size),
            "grasps of a seed": f"{row['grasps'][-1]:,}",
            "median kept": f"{np.median(kept):.3f}",
            "kept share, 5th percentile of the seeds": f"{np.quantile(kept, 0.05):.3f}",
            "share of seeds that keep 95 % (95 % interval)": share_of(kept),
            "commit": row["provenance"]["commit"][:7],
        }
        table_rows.append((searched, outcome))
    named = [name for name in table_rows[0][0] if len({s[name] for s, _ in table_rows}) > 1]
    head = [*named, *table_rows[0][1]]
    cells = [[*(s[name] for name in named), *f.values()] for s, f in table_rows]
    return output.markdown([head, *cells])


def masses_table(rows: list[dict[str, Any]]) -> str:
    """What recommended designs keep where every object has one of these masses."""
    table_rows = []
    for row in sorted((r for r in rows if "masses" in r), key=order):
        head = ["preset", "hand", "searched with"]
        objects = row.get("objects") or "objects as they are"
        cells = [row["preset"], hand_of(row)]
        cells.append(" ".join(_changed(row)) or objects)
        for mass, kept in row["masses"].items():
            head += [f"{1e3 * float(mass):g} g: kept on average", "seeds that keep 95 %"]
            cells += [f"{np.mean(kept):.3f}", share_of(np.array(kept))]
        table_rows = table_rows or [[*head, "commit"]]
        table_rows.append([*cells, row["provenance"]["commit"][:7]])
    return output.markdown(table_rows)


def lines_table(rows: list[dict[str, Any]]) -> str:
    """What fingers that share pressure lines cost, against those of the same seeds with their own.

    Empty without such a search.
    """
    usual = {"preset": LIMITED, "hand": None, "objects": None, "optimizer": DEFAULT}
    rows = [row for row in rows if usual.items() <= row.items() and "kept" in row]
    shared = [row for row in rows if "".join(row["changes"]).startswith(LINES)]
    if not shared:
        return ""
    [unchanged] = [row for row in rows if not row["changes"]]
    head = ["pressure lines", "seeds", "grasps of a seed", "kept on average %", "cost in points"]
    table_rows = [head]
    for row in sorted(shared, key=lambda row: row["changes"], reverse=True):
        grasps = row["grasps"][-1]
        kept = 100 * np.array(row["kept"][-1])
        alone = 100 * np.array(unchanged["kept"][unchanged["grasps"].index(grasps)][: kept.size])
        cost = statistics.bootstrap(lambda seeds, v=alone - kept: v[seeds].mean(-1), kept.size)
        cells = [str(kept.size), f"{grasps:,}"]
        if len(table_rows) == 1:
            table_rows.append(["one for each finger", *cells, f"{alone.mean():.1f}", "–"])
        words = f"{cost.value:.1f} ({cost.low:.1f} to {cost.high:.1f})"
        lines = row["changes"][0].removeprefix(LINES)
        table_rows.append([lines, *cells, f"{kept.mean():.1f}", words])
    return output.markdown(table_rows)


def accuracies_table(rows: list[dict[str, Any]]) -> str:
    """Default searches whose designs were judged at another accuracy than the scene's, by hand.

    The differences are paired by seed: from the first search of the hand, the one that has one
    accuracy for all of its grasps.  A bootstrap over seeds is also one over the judging trials,
    which each seed has for itself.  The last two columns are those of `--retest`.  Empty without
    such a search.
    """
    rows = [row for row in rows if row["optimizer"] == DEFAULT]
    judged = [row for row in rows if "kept" in row and _option(row, JUDGED)]
    retests = {(hand_of(r), *r["changes"]): r["retest"] for r in rows if "retest" in r}
    head = ["hand", "accuracy of the episodes", "grasps of a seed", "seeds"]
    head += ["kept on average %", "seeds that keep 95 % (95 % interval)"]
    head += ["more kept than with `standard`, points", "finalists that `fast` alone likes"]
    head += ["seeds in which a test at `fast` chooses another design"]
    table_rows = [head]
    first: dict[str, np.ndarray] = {}
    for row in sorted(judged, key=lambda r: (hand_of(r), bool(_option(r, SEARCHED)))):
        hand = hand_of(row)
        kept = 100 * np.array(row["kept"][-1])
        more = kept - first.setdefault(hand, kept)
        words = "–"
        if more.any():
            gain = statistics.bootstrap(lambda seeds, v=more: v[seeds].mean(-1), more.size)
            words = f"{gain.value:+.1f} ({gain.low:+.1f} to {gain.high:+.1f})"
        cells = [f"`{hand}`", f"`{_option(row, SEARCHED) or 'standard'}`"]
        cells += [f"{row['grasps'][-1]:,}", str(kept.size), f"{kept.mean():.1f}"]
        again = retests.get((hand, *row["changes"]))
        tested = ["–", "–"]
        if again:
            tested = [f"{again['lost']} of {again['finalists']}", str(again["chosen_otherwise"])]
        table_rows.append([*cells, share_of(kept / 100), words, *tested])
    return output.markdown(table_rows) if judged else ""


def _is_usual(row: dict[str, Any]) -> bool:
    """Whether a search is of the paper's scene with its own hand and objects."""
    return row["scene"] == "paper" and not (row.get("hand") or row.get("objects"))


def _changed(row: dict[str, Any]) -> list[str]:
    """Changes of a search's scene, hand or objects."""
    return [change for change in row["changes"] if not change.startswith(ALIKE)]


def _option(row: dict[str, Any], name: str) -> str:
    """Value of a change such as "--judged=reference"; empty without it."""
    values = [c.removeprefix(name) for c in row.get("changes", ()) if c.startswith(name)]
    return values[0] if values else ""


def share_of(kept: np.ndarray) -> str:
    """Share of the seeds that keep `WANTED`, with its interval."""
    good = int((kept >= WANTED).sum())
    share = wilson(good, kept.size)
    return f"{good / kept.size:.2f} ({share.low:.2f} to {share.high:.2f})"
