"""Markdown tables of a study: references and orders, errors, decisions, what chaos alone does."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from codesign_jax.report.statistics import Interval
from scripts.accuracy import analysis
from scripts.accuracy.analysis import Records
from scripts.accuracy.figures import Point, grasps
from scripts.accuracy.results import ERRORS, WANTED, Study, named, place
from scripts.accuracy.settings import PRESETS, Setting, one_at_a_time, own_limits

COST = ["wall s / simulated s", "grasps/s"]
POPULATIONS = {
    "spread": "particles of every quality",
    "late": "final particles of all co-design runs",
}


def lines(records: Records) -> dict[str, list[tuple[float, float]]]:
    """Errors over what is refined, by what is measured, for `figures.convergence`."""
    tips = analysis.against_reference(records, "tip")
    beams = analysis.measured(records, "beam")
    found = {
        f"tip in motion [mm], time step, {kind} damping": [
            (r["of"].timestep, r["tip_rms_mm"])
            for r in tips
            if "at the reference's links" in r["more"] and r["of"].damping == kind
        ]
        for kind in ("added", "least")
    }
    found |= {
        "tip in motion [mm]": [
            (1 / r["of"].links, r["tip_rms_mm"])
            for r in tips
            if "at the reference's time step" in r["more"]
        ],
        "impulse, relative, time step": analysis.by_step(records),
    }
    for name in sorted({k for r in beams for k in r if k.startswith(("elastica", "arc"))}):
        found[f"{name}, tip / length"] = [(1 / r["of"].links, r[name]) for r in beams]
    return found


def confirmed(records: Records) -> list[list[str]]:
    """How far the reference moves if it is refined once more, and the orders of convergence."""
    rows = [["what", "value"]]
    for r in records:
        if {"timestep", "links"} & set(r["more"]) and analysis.bad(r):
            rows.append([f"reference refined to {r['label']}: {r['part']}", _why(r)])
    for part, unit in (("tip", "mm"), ("impulse", "")):
        for r in analysis.against_reference(records, part):
            for role, words in (("timestep", "time step halved"), ("links", "links doubled")):
                if role in r["more"]:
                    value = r[ERRORS[part][1]]
                    what = f"reference moves, {words}: {ERRORS[part][0]}"
                    rows.append([what, f"{value:.2g} {unit}".strip()])
    for name, value in analysis.orders(records).items():
        if value is not None:
            rows.append([f"order of convergence: {name}", f"{value:.2f}"])
    return rows


def cost_cells(cost: float | None) -> list[str]:
    """A cost as wall seconds of a simulated second of a world, and as grasps a second."""
    if cost is None:
        return ["–", "–"]
    rate = float(f"{grasps(cost):.3g}")
    return [f"{cost:.2e}", f"{rate:,.0f}" if rate >= 100 else f"{rate:.3g}"]


def title(setting: Setting) -> str:
    """A setting's name in the tables."""
    return named(setting.label, setting.engine)


def wanted(study: Study) -> list[list[str]]:
    """For every error wanted and engine: the cheapest setting below it and its cost."""
    rows = [["error", "wanted below", "engine", "setting", "error there", *COST]]
    for part, limits in WANTED.items():
        engines = dict.fromkeys(p.engine for p in study.points(part))
        for engine, limit in itertools.product(engines, limits):
            rows.append(
                [ERRORS[part][0], f"{limit:g}", engine, *_found(study, part, engine, limit)]
            )
    return rows


def _found(study: Study, part: str, engine: str, limit: float) -> list[str]:
    p = study.cheapest(part, engine, limit)
    if p is None:
        return ["none", "–", "–", "–"]
    return [named(p.label, engine), f"{p.error:.3g}", *cost_cells(p.cost)]


def wanted_here(full: Study, small: Study | None) -> list[list[str]]:
    """As `wanted` for the structured engine alone, with the same settings' costs on a CPU."""
    costs = ["one H200: wall s / simulated s", "grasps/s"]
    costs += ["2 CPU cores: wall s / simulated s", "grasps/s"] if small else []
    rows = [["error", "wanted below", "setting", "error there", *costs]]
    for part, limits in WANTED.items():
        for limit in limits if full.errors(part) else ():
            p = full.cheapest(part, "structured", limit)
            row = [ERRORS[part][0], f"{limit:g}", *_found(full, part, "structured", limit)]
            rows.append(row + _small_cost(small, p))
    return rows


def _small_cost(small: Study | None, point: Point | None) -> list[str]:
    if small is None:
        return []
    every = {s.label: s for s in one_at_a_time("structured")}
    setting = every.get(point.label) if point else None
    return cost_cells(small.cost("structured", setting) if setting else None)


def _number(value: float | None, form: str = ".2g") -> str:
    return "–" if value is None or not np.isfinite(value) else format(value, form)


def errors_table(study: Study, part: str) -> list[list[str]]:
    """Every setting's errors of a kind and its cost."""
    heads = {
        "tip": ["tip_rms_mm", "tip_max_mm"],
        "impulse": ["impulse_error", "impulse_max", "grip_error", "touch_error_ms"],
    }
    rows = [["engine", "setting", *(h.replace("_", " ") for h in heads[part]), *COST]]
    for r in study.errors(part):
        setting = r["of"]
        if analysis.bad(r):
            values = [_why(r), *[""] * (len(heads[part]) - 1)]
        else:
            values = [_number(r.get(h)) for h in heads[part]]
        cost = study.cost(setting.engine, setting)
        rows.append([setting.engine, title(setting), *values, *cost_cells(cost)])
    return rows


def _why(record: dict[str, Any]) -> str:
    """Why there is no measurement, the last clause of the reason."""
    kind = "refused" if record.get("refused") else "failed"
    return f"{kind}: {(analysis.bad(record) or '').split(':')[-1].strip()}"


def interval(value: Interval, form: str = ".1%") -> str:
    """A value with its interval; a dash where it is not defined."""
    if not np.isfinite(value.value):
        return "–"
    return f"{value.value:{form}} [{value.low:{form}}, {value.high:{form}}]"


def _row(first: list[str], c: dict[str, Any]) -> list[str]:
    return [
        *first,
        f"{c['particles']} x {c['trials']}",
        interval(c["flipped"]),
        interval(c["success"]),
        interval(c["success_difference"], "+.1%"),
        interval(c["rank"], ".2f"),
        f"{c['offspring_moved']:.1%}",
        f"{c['failed']:.2%}",
    ]


_DECISION = [
    "particles x trials", "verdicts that flip", "success", "success, difference",
    "rank correlation", "offspring moved", "failed",
]  # fmt: skip
FLOOR = "flips by 1 µm"


def decisions_table(study: Study, population: str) -> list[list[str]]:
    """Every setting's decisions beside the finest's, its own floor, and its cost."""
    rows = [["engine", "setting", *_DECISION, FLOOR, *COST]]
    for setting, c in study.decisions(population).items():
        cells = [_number(study.floor(setting, population), ".2%")]
        cells += cost_cells(study.cost(setting.engine, setting))
        rows.append([*_row([setting.engine, title(setting)], c), *cells])
    for r in study.errors("decision") if population == "late" else ():
        if analysis.bad(r):
            rows.append(["structured", r["of"].label, _why(r), *[""] * (len(rows[0]) - 3)])
    return rows


def alone(study: Study) -> list[list[str]]:
    """One knob at a time against its own limit, everything else fine: where flips come from."""
    rows = [["knob", "setting", "limit", *_DECISION, FLOOR]]
    for knob, settings in own_limits().items():
        limit = study.grasps.get((settings[-1], False, "late"))
        for setting in settings[:-1]:
            cost = study.grasps.get((setting, False, "late"))
            if cost is not None and limit is not None:
                found = _row(
                    [knob, title(setting), title(settings[-1])], analysis.compare(cost, limit)
                )
                rows.append([*found, _number(study.floor(setting), ".2%")])
    return rows


def preset_to_preset(study: Study) -> list[list[str]]:
    """Decisions from preset to preset, the coarser beside the finer."""
    rows = [["presets", "population", *_DECISION]]
    for population in POPULATIONS:
        for a, b in itertools.combinations(PRESETS, 2):
            costs = [study.grasps.get((PRESETS[n], False, population)) for n in (a, b)]
            if costs[0] is not None and costs[1] is not None:
                what = f"{a} against {b}"
                rows.append(_row([what, population], analysis.compare(*costs)))
    return rows


def floors(study: Study) -> list[list[str]]:
    """Settings against themselves with objects moved, engines against each other, other trials."""
    rows = [["comparison", "population", *_DECISION]]
    for (setting, moved, name), cost in study.grasps.items():
        plain = study.grasps.get((setting, False, name))
        shown = setting.engine == "mujoco" or setting in PRESETS.values()
        if moved and shown and plain is not None:
            what = f"{setting.engine}, {title(setting)}: objects moved by 1 µm"
            rows.append(_row([what, name], analysis.compare(cost, plain)))
        same = study.grasps.get((replace(setting, engine="structured"), False, name))
        if setting.engine == "mujoco" and not moved and same is not None:
            what = f"MuJoCo C against structured, {setting.label}"
            rows.append(_row([what, name], analysis.compare(cost, same)))
    for (setting, moved, name), cost in study.grasps.items():
        noise = analysis.trial_noise(cost)
        if setting == Setting() and not moved and noise is not None:
            what = "structured, standard: six trials against six others"
            values = ["–"] * len(_DECISION)
            values[4] = f"{noise:.2f}"
            rows.append([what, name, *values])
    return rows


def curse(study: Study) -> list[list[str]]:
    """What the best particles by a coarse setting are worth at the reference: the winner's curse.

    Of the population "late" the sixth with the lowest mean costs over the first half of the trials
    is chosen; the other half tells its success at both settings.
    """
    rows = [["designs", "chosen and tested at", "trials of the test", "success there",
             "success at the reference", "difference"]]  # fmt: skip
    truth = study.grasps.get((PRESETS["reference"], False, "late"))
    for name in (n for n in PRESETS if n != "reference"):
        cost = study.grasps.get((PRESETS[name], False, "late"))
        if cost is None or truth is None:
            continue
        half = min(cost.shape[1], truth.shape[1]) // 2
        ranked = np.argsort(analysis.means(cost[:, :half]), kind="stable")
        test = slice(half, 2 * half)
        best = ranked[: max(1, len(cost) // 6)]
        for words, chosen in (("best sixth", best), ("all", slice(None))):
            found = analysis.compare(cost[chosen, test], truth[chosen, test])
            cells = [interval(found[n]) for n in ("success", "success_reference")]
            cells.append(interval(found["success_difference"], "+.1%"))
            rows.append([words, f"`{name}`", str(half), *cells])
    return rows


def warnings(study: Study) -> list[list[str]]:
    """Share of the late population's trials by status bit."""
    found = analysis.warned(study.records, "late")
    names = sorted({n for bits in found.values() for n in bits})
    rows = [["setting", *names]]
    for setting in sorted(found, key=place):
        rows.append([title(setting), *(f"{found[setting].get(n, 0.0):.2%}" for n in names)])
    return rows
