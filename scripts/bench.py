"""What each measurement of a finger tells of its constants: python -m scripts.bench.

Simulates the bench measurements of the default finger with noise of 2 to 5 %, of constants that are
not the hand file's, and fits all that was measured so far; draws docs/figures/bench.png and prints
the table of docs/measurements.md.  Half a minute of one core.
"""

import sys
from pathlib import Path

import numpy as np

from codesign_jax import finger, parameters, scene
from codesign_jax.finger import swing
from scripts.shared import output, provenance

DOCS = Path(__file__).parents[1] / "docs"
TRUTH = {
    "shear_modulus": 97e3,
    "moment_factor": 0.9,
    "lateral_factor": 0.5,
    "torsion_factor": 1.6,
    "damping_time": 5e-3,
}
"""Constants of the finger that is measured; those of the hand file are others."""
LABELS = {
    "shear_modulus": "modulus",
    "moment_factor": "moment",
    "lateral_factor": "sideways",
    "torsion_factor": "twist",
    "damping_time": "damping",
}
NOISE = {"angle": 0.02, "tip_force": 0.05, "sideways": 0.03, "drop": 0.02}
"""Noise of a column, of its root mean square."""


def measure(truth: finger.Finger) -> dict[str, dict[str, np.ndarray]]:
    """Tables of each measurement, with its noise."""
    random = np.random.default_rng(71)
    pressure = np.linspace(10e3, 60e3, 6)
    times = np.linspace(0.0, 4 * swing.first_period(truth, 0.0), 60)
    columns = {
        "angles": ("angle", {"pressure": pressure}),
        "tip forces": ("tip_force", {"pressure": pressure}),
        "weights, sideways": ("sideways", {"pressure": np.repeat([0, 60e3], 3), "load": 0.3}),
        "a release": ("drop", {"pressure": 0.0, "time": times, "load": 0.0}),
    }
    tables = {}
    for words, (column, states) in columns.items():
        rows = max(np.size(v) for v in states.values())
        table = {n: np.broadcast_to(np.asarray(v, float), rows).copy() for n, v in states.items()}
        if column == "drop":
            step = times[-1] / (8 * swing.STEPS)
            clean = np.interp(times, *swing.released(truth, 0.0, 0.0, times[-1] + step, step))
        else:
            clean = finger.predict(truth, table | {column: np.zeros(rows)})[column]
        scale = NOISE[column] * np.sqrt((clean**2).mean())
        tables[words] = table | {column: clean + scale * random.normal(size=rows)}
    return tables


def joined(tables: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """One table of several; NaN where one of them lacks a column."""
    names = dict.fromkeys(n for table in tables for n in table)
    return {
        n: np.concatenate([t.get(n, np.full(len(t["pressure"]), np.nan)) for t in tables])
        for n in names
    }


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("--figures", type=Path, default=DOCS / "figures", metavar="FOLDER")
    parser.add_argument("--pages", action="store_true", help="fill the table into the page")
    args = parser.parse_args()
    loaded = scene.load("paper")
    space = parameters.design_space(loaded.hand, "2d")
    mine = finger.of_design(loaded, space.params(space.from_units([110.0, 0.0])), 0)
    every = measure(mine.of_material(**TRUTH))
    steps = list(every)
    rows = [["measured", *(f"{label} ± %" for label in LABELS.values()), "next"]]
    intervals = []
    for k in range(len(steps)):
        table = joined([every[s] for s in steps[: k + 1]])
        fit = finger.fit(mine, table)
        advised = finger.advice(mine, fit, table)[0]
        widths = [f"{100 * fit.sd[n]:.2g}" if n in fit.names else "–" for n in LABELS]
        rows.append([("" if k == 0 else "and ") + steps[k], *widths, advised.words])
        intervals.append({n: np.divide(fit.interval[n], TRUTH[n]) for n in fit.names})
    text = output.markdown(rows)
    print(text)
    if args.pages:
        output.fill(DOCS / "measurements.md", text, "bench")
    print(draw(steps, intervals, args.figures))
    return 0


def draw(steps: list[str], intervals: list[dict[str, np.ndarray]], folder: Path) -> Path:
    """The 90 % intervals over the truth after each measurement."""
    figure = output.new_figure(8.4, 2.8)
    axes = figure.subplots(1, 1)
    for k, (step, ends) in enumerate(zip(steps, intervals, strict=True)):
        for column, name in enumerate(LABELS):
            if name in ends:
                label = step if name == "shear_modulus" else None
                x = column + 0.15 * (k - 1.5)
                axes.plot([x, x], ends[name], f"C{k}", lw=4, solid_capstyle="butt", label=label)
    axes.axhline(1, color="k", lw=0.5)
    axes.set_xticks(range(len(LABELS)), list(LABELS.values()))
    axes.set(yscale="log", ylabel="90 % interval over the truth", yticks=[0.5, 0.7, 1, 1.4, 2])
    axes.set_yticklabels(["0.5", "0.7", "1", "1.4", "2"])
    axes.minorticks_off()
    axes.legend(title="and then", fontsize=8)
    return output.save_figure(figure, folder / "bench.png")


if __name__ == "__main__":
    sys.exit(main())
