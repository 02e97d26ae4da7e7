"""From scored waves to the page's tables and figures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from codesign_jax.scene import InputError
from scripts.calibration import figures, files, itself, score
from scripts.calibration.files import Scored
from scripts.shared import sets
from scripts.shared.tables import fill

MEASURES = {
    "untouched": "never touched",
    "lossless": "cost < 0.01",
    "below_one": "cost < 1",
    "above_two": "cost > 2",
    "saddle": "saddle between regions",
    "simulations concurrent, first, own": "simulations, concurrent",
    "success concurrent, own": "success, concurrent",
    "success single, own": "success, single domain",
}
"""Numbers of a set that the page relates to the constants."""
FEW = 5
"""Sets below which a share of them says nothing; the page then shows the best ones."""
SHOWN = 40
"""Number of best sets that the page shows where too few are left."""


def make(
    data: Path, pictures: Path, page: Path | None = None, experiments: Path | None = None
) -> str:
    """Draws the figures of all scored waves and writes the tables.

    Waves of one fidelity belong together; the largest such group is the page's subject, the others
    are compared with it set by set.

    Args:
      data: Folder of the scores.
      pictures: Folder of the figures.
      page: Markdown page whose text between the marks is replaced; None for none.
      experiments: Folder of the default scene's own experiments; None for none.

    Returns:
      The tables in Markdown.

    Raises:
      InputError: If the folder holds no scores.
    """
    waves = files.read_scores(sorted(data.glob(f"*{files.SCORES}.npz")))
    if not waves:
        raise InputError([f"{data} holds no scores: run wave and score first"])
    groups: dict[str, list[Scored]] = {}
    for wave in waves:
        groups.setdefault(wave.fidelity, []).append(wave)
    chosen = max(groups.values(), key=lambda g: sum(len(w.data["units"]) for w in g))
    joined = join(chosen)
    figures.constants(joined, pictures / "calibration_constants.png")
    figures.correlations(correlations(joined), MEASURES, pictures / "calibration_correlations.png")
    figures.landscapes(joined, pictures / "calibration_landscapes.png")
    parts = [wave_table(waves), target_table(joined), ranges_table(joined), readings(joined)]
    parts += [
        f"{other.name} against {wave.name}:\n\n{comparison(wave, other)}"
        for wave in chosen
        for other in waves
        if other.fidelity != wave.fidelity and len(_common(wave, other)[0]) > FEW
    ]
    if experiments:
        parts.append(f"The default scene by its own experiments:\n\n{itself.table(experiments)}")
    text = "\n\n".join(parts)
    if page:
        fill(page, text, "calibration")
    return text


def join(waves: Sequence[Scored]) -> Scored:
    """All sets of several waves of one fidelity and one grid as one."""
    data = {
        key: value if key.endswith("_axis") else np.concatenate([w.data[key] for w in waves])
        for key, value in waves[0].data.items()
    }
    return Scored(" and ".join(w.name for w in waves), data, waves[0].notes)


def shown(wave: Scored) -> tuple[np.ndarray, str]:
    """Indices of the sets that are left, or of the best ones if there are few, and their name."""
    left = np.flatnonzero(wave.plausible)
    if len(left) >= FEW:
        return left, f"the {len(left)} sets that no target rules out"
    count = min(SHOWN, len(wave.plausible))
    return score.best(wave.data["distances"], count), f"the {count} best sets"


def correlations(wave: Scored) -> np.ndarray:
    """Spearman's rank correlation of constants and measures, shape (constant, measure)."""
    units = wave.data["units"]
    found = np.zeros((len(sets.OPEN), len(MEASURES)))
    for j, name in enumerate(MEASURES):
        values = wave.data[name]
        if np.ptp(values) > 0:
            found[:, j] = [stats.spearmanr(u, values).statistic for u in units.T]  # type: ignore
    return found


def wave_table(waves: Sequence[Scored]) -> str:
    """What was simulated, a row a wave."""
    lines = [
        "| wave | simulated | sets | grid × trials | grasps | failed | solver at limit | device "
        "| commit | left |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for wave in waves:
        notes, count = wave.notes["wave"], len(wave.data["units"])
        points, trials = (notes["settings"][k] for k in ("points", "trials"))
        grasps = count * points**2 * trials
        commit = str(notes.get("commit"))[:7]
        lines.append(
            f"| {wave.name} | {wave.fidelity} | {count:,} | {points} × {points} × {trials} "
            f"| {grasps:,} | {100 * wave.data['failed'].mean():.1f} % "
            f"| {100 * wave.data['capped'].mean():.0f} % "
            f"| {notes['device']} | {commit} | {int(wave.plausible.sum())} |"
        )
    return "\n".join(lines)


def target_table(wave: Scored) -> str:
    """What kept sets out: by each target, and by it alone."""
    out = wave.data["distances"] > sets.CUTOFF
    alone = out & (out.sum(-1, keepdims=True) == 1)
    lines = [
        "| target | the paper says | sets ruled out | by nothing else | median distance |",
        "|---|---|---|---|---|",
    ]
    middle = np.median(wave.data["distances"], axis=0)
    for i, target in enumerate(score.TARGETS):
        share = 100 * out[:, i].mean()
        lines.append(
            f"| {target.name} | {target.says} | {share:.0f} % | {int(alone[:, i].sum())} "
            f"| {middle[i]:.1f} |"
        )
    return "\n".join(lines)


def ranges_table(wave: Scored) -> str:
    """Ranges of the constants in the sets that are left, and how much each constant matters."""
    index, name = shown(wave)
    values, others = sets.values(wave.data["units"]), np.ones(len(wave.data["units"]), bool)
    others[index] = False
    worst = wave.data["distances"].max(-1)
    lines = [
        f"Ranges in {name} (5 to 95 %, median); p by the Kolmogorov-Smirnov test against the other "
        "sets, rank correlation with the worst distance to a target:",
        "",
        "| constant | tried | left | median | p | rank correlation |",
        "|---|---|---|---|---|---|",
    ]
    for o in sets.OPEN:
        v = values[o.name]
        low, middle, high = np.quantile(v[index], [0.05, 0.5, 0.95])
        p = stats.ks_2samp(v[index], v[others]).pvalue if others.any() else 1.0  # type: ignore
        rho = stats.spearmanr(v, worst).statistic if np.ptp(worst) else 0.0  # type: ignore
        lines.append(
            f"| {o.label} [{o.unit or '1'}] | {o.low:g} to {o.high:g} | {low:.3g} to {high:.3g} "
            f"| {middle:.3g} | {'< 0.001' if p < 1e-3 else f'{p:.3f}'} | {rho:+.2f} |"
        )
    return "\n".join([*lines, "", _pairs(wave.data["units"][index])])


def _pairs(units: np.ndarray) -> str:
    """The strongest rank correlations between two constants of the sets that are left."""
    if len(units) < 10:
        return f"{len(units)} sets are too few for correlations between constants."
    rho, p = (np.asarray(v) for v in stats.spearmanr(units))
    first, second = np.triu_indices(len(sets.OPEN), 1)
    # Bonferroni's correction for all pairs.
    real = [k for k in range(len(first)) if p[first[k], second[k]] * len(first) < 0.05]
    real.sort(key=lambda k: -abs(rho[first[k], second[k]]))
    if not real:
        return "No two constants are correlated in them (Bonferroni, p < 0.05)."
    named = [
        f"{sets.OPEN[first[k]].label} and {sets.OPEN[second[k]].label} "
        f"{rho[first[k], second[k]]:+.2f}"
        for k in real[:6]
    ]
    return f"Correlated in them (Bonferroni, p < 0.05): {'; '.join(named)}."


def readings(wave: Scored) -> str:
    """Simulations to convergence of the concurrent strategy by each reading of the paper."""
    index, name = shown(wave)
    lines = [
        f"Simulations to convergence of the concurrent strategy (the paper: {score.PAPER_2D:.0f}) "
        f"in {name}, by what converged means and by whether particles share their trials:",
        "",
        "| reading | median | 5 to 95 % | within a quarter of the paper's |",
        "|---|---|---|---|",
    ]
    for reading in score.READINGS:
        found = wave.data[f"simulations concurrent, {reading}"][index]
        low, middle, high = np.quantile(found, [0.05, 0.5, 0.95])
        near = np.abs(np.log(found / score.PAPER_2D)) < np.log(1.25)
        lines.append(
            f"| {reading} | {middle:.0f} | {low:.0f} to {high:.0f} | {100 * near.mean():.0f} % |"
        )
    return "\n".join(lines)


def _common(a: Scored, b: Scored) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the sets that two waves share."""
    place = {row.tobytes(): i for i, row in enumerate(np.asarray(a.data["units"], float))}
    keys = [row.tobytes() for row in np.asarray(b.data["units"], float)]
    pairs = [(place[key], i) for i, key in enumerate(keys) if key in place]
    first, second = np.array(pairs, int).reshape(-1, 2).T
    return first, second


def comparison(a: Scored, b: Scored) -> str:
    """Rank correlations between two fidelities over the sets that they share, as a table.

    Raises:
      ValueError: If they share fewer than three sets.
    """
    i, j = _common(a, b)
    if len(i) < 3:
        raise ValueError(f"{a.name} and {b.name} share {len(i)} sets: too few to rank")
    lines = [
        f"| {len(i)} sets in common | rank correlation | {a.fidelity} | {b.fidelity} |",
        "|---|---|---|---|",
    ]
    for name, label in MEASURES.items():
        x, y = a.data[name][i], b.data[name][j]
        both = np.ptp(x) > 0 and np.ptp(y) > 0
        rho = f"{stats.spearmanr(x, y).statistic:+.2f}" if both else "–"  # type: ignore
        lines.append(f"| {label} | {rho} | {np.median(x):.3g} | {np.median(y):.3g} |")
    same = (a.plausible[i] == b.plausible[j]).mean()
    lines.append(f"| ruled out or not, alike | {100 * same:.0f} % | | |")
    return "\n".join(lines)
