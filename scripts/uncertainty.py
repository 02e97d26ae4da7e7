"""Hands searched under what is known of the constants, against hands searched at its middle.

python -m scripts.uncertainty --out runs/uncertainty                      # again to go on
python -m scripts.uncertainty --constants posterior.toml --preset full    # of a finger of one's own

Each seed is searched twice, with constants that are drawn for every trial and with the middle of
their distributions, and both designs are judged in the same fresh trials, each of which has a hand
of its own: constants drawn from the table, in place of the true ones that nobody knows.  Prints the
table of docs/uncertainty.md and draws docs/figures/uncertainty.png.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

from codesign_jax import cli, verdict
from codesign_jax import scene as scenes
from codesign_jax.commands import common, flags
from codesign_jax.runs import cases
from codesign_jax.scene import draws, silicones
from scripts.shared import output, provenance, statistics

DOCS = Path(__file__).parents[1] / "docs"
STREAM = 0x74727468
"""Root of the trials that judge ("trth")."""
MODULUS = "hand.material.shear_modulus"
ARMS = {"under the distribution": "drawn", "at its middle": "middle"}


def middle(table: draws.Constants) -> list[str]:
    """KEY=VALUE of a scene whose constants are in the middle of their distributions."""
    scene = scenes.load(overrides=draws.nominal(table))
    middle_scene = draws.applied(
        scene, table, [float(entry.deviation(0.0)) for entry in table.constant]
    )
    law = silicones.LAWS[bool(scene.effects.neo_hookean)]
    named = {("hand", "material", "law"): law} | draws.nominal(table)
    words = [f"{'.'.join(path)}={value}" for path, value in named.items()]
    if not any(word.startswith(MODULUS) for word in words):
        words.append(f"{MODULUS}={middle_scene.hand.material.shear_modulus:.9g}")
    for entry in table.constant:
        if entry.change != "value" and entry.key != MODULUS:
            words += [f"{key}={value:.9g}" for key, value in _numbers(middle_scene, entry.path)]
    return words


def _numbers(table: object, path: tuple[str, ...], place: str = "") -> list[tuple[str, float]]:
    """Key paths and numbers that a key means."""
    if not path:
        return [(place, float(table))]  # type: ignore[arg-type]
    if isinstance(table, tuple):
        every = [_numbers(entry, path, f"{place}.{i}") for i, entry in enumerate(table)]
        return [pair for pairs in every for pair in pairs]
    where = f"{place}.{path[0]}" if place else path[0]
    return _numbers(getattr(table, path[0]), path[1:], where)


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("--constants", default="unmeasured", metavar="TABLE")
    parser.add_argument("--preset", default="full")
    parser.add_argument("--pairs", type=int, default=30)
    parser.add_argument("--grasps", type=int, default=600, help="that judge each design")
    parser.add_argument("--sizes", nargs="+", default=[], metavar="FLAG", help="of optimize")
    parser.add_argument("--out", type=Path, default=Path("runs/uncertainty"), metavar="FOLDER")
    parser.add_argument("--figures", type=Path, default=DOCS / "figures", metavar="FOLDER")
    parser.add_argument("--pages", action="store_true", help="fill the table into the page")
    args = parser.parse_args()
    table = draws.read(args.constants)
    arms = {"drawn": ["--constants", args.constants], "middle": ["--set", *middle(table)]}
    sizes = [word if word.isdecimal() else f"--{word}" for word in args.sizes]
    shares = {}
    for words, arm in ARMS.items():
        folder = args.out / arm
        line = ["optimize", "--preset", args.preset, "--seeds", f"0-{args.pairs - 1}"]
        line += ["--reference-trials", "0", "--out", str(folder), *arms[arm], *sizes]
        if code := cli.main(line):
            return code
        runs = sorted(p for p in folder.iterdir() if p.is_dir())
        shares[words] = [judged(run, args) for run in runs]
    rows, differences = compared(shares)
    text = output.markdown(rows)
    print(text)
    output.write_json(args.out / "uncertainty.json", {"rows": rows, **shares})
    if args.pages:
        output.fill(DOCS / "uncertainty.md", text, "pairs")
    print(draw(shares, differences, args.figures))
    return 0


def judged(run: Path, args: argparse.Namespace) -> tuple[float, float]:
    """Share of grasps that a run's design keeps with drawn constants, and in the middle of them."""
    shares = []
    words = tuple(middle(draws.read(args.constants)))
    drawing = flags.TrialFlags(constants=args.constants)
    for given in (drawing, flags.TrialFlags(constants="none", overrides=(words,))):
        case = cases.case_of_run(run, overrides=common.changes(given))
        outcome = case.simulate(args.grasps, jax.random.key(STREAM))
        shares.append(float(verdict.kept(outcome).mean()))
    return shares[0], shares[1]


def compared(shares: dict[str, list[tuple[float, float]]]) -> tuple[list[list[str]], np.ndarray]:
    """The table, and the paired differences of the shares with drawn constants."""
    rows = [["searched", "kept with drawn constants %", "the worst seed %", "kept in the middle %"]]
    for words, pairs in shares.items():
        drawn, at_middle = 100 * np.array(pairs).T
        rows.append([words, f"{drawn.mean():.1f}", f"{drawn.min():.0f}", f"{at_middle.mean():.1f}"])
    first, second = (np.array(pairs)[:, 0] for pairs in shares.values())
    difference = 100 * (first - second)
    interval = statistics.bootstrap(lambda rows: difference[rows].mean(-1), len(difference))
    text = f"{difference.mean():+.1f} ({interval.low:+.1f} to {interval.high:+.1f})"
    rows.append([f"difference, {len(difference)} pairs", text, "", ""])
    return rows, difference


def draw(shares: dict, differences: np.ndarray, folder: Path) -> Path:
    """The kept share of each pair, one kind of search over the other."""
    figure = output.new_figure(3.6, 3.4)
    axes = figure.subplots(1, 1)
    over, under = (100 * np.array(pairs)[:, 0] for pairs in shares.values())
    axes.plot(under, over, "o", ms=4)
    low = min(over.min(), under.min()) - 2
    axes.plot([low, 100], [low, 100], "k", lw=0.5)
    axes.set(xlabel="kept, searched at the middle [%]", ylabel="kept, searched under all [%]")
    axes.set_title(f"{(differences > 0).sum()} of {len(differences)} pairs above", fontsize=9)
    return output.save_figure(figure, folder / "uncertainty.png")


if __name__ == "__main__":
    sys.exit(main())
