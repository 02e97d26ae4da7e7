"""Hands searched under what is known of the constants, against hands searched at its middle.

python -m scripts.uncertainty --out runs/uncertainty                 # again to go on
python -m scripts.uncertainty --constants posterior.toml             # of a finger of one's own

Each seed is searched twice, with constants that are drawn for every trial and with the middle of
their distributions, and both designs are judged in the same fresh trials, each of which has a hand
of its own: constants drawn from the table, in place of the true ones that nobody knows.  Prints the
table of docs/uncertainty.md and draws docs/figures/uncertainty.png.  All seeds go in lock step, as
in scripts.search.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from codesign_jax import scene as scenes
from codesign_jax import use_compilation_cache
from codesign_jax.engines import make_engine
from codesign_jax.optimize import DEFAULT
from codesign_jax.scene import Scene, draws
from codesign_jax.scene.parameters import design_space
from scripts.shared import lock_step, output, provenance, statistics

DOCS = Path(__file__).parents[1] / "docs"
ARMS = {"under the distribution": "drawn", "at its middle": "middle"}
"""Kinds of searches by their words in the table, and names of their scenes."""


def main() -> int:
    args = parse()
    use_compilation_cache()
    worlds = worlds_of(draws.read(args.constants))
    start = time.monotonic()
    studies = make_studies(worlds, args)
    for arm, study in studies.items():

        def progress(_: int, arm: str = arm, study: lock_step.Study = study) -> None:
            seconds = time.monotonic() - start
            print(f"{arm}: episode {study.done}/{study.marks[-1]}, {seconds:.0f} s", flush=True)

        study.run(progress)
    kept = {words: judge_designs(studies, arm, worlds) for words, arm in ARMS.items()}
    rows, differences = compare(kept)
    text = output.markdown(rows)
    print(text)
    grasps = studies["drawn"].row()["grasps"][-1]
    result: dict[str, Any] = {"constants": args.constants, "preset": args.preset}
    result |= {"grasps of a search": grasps, "grasps that judge": args.grasps}
    result |= {"seconds": round(time.monotonic() - start), "rows": rows, "kept": kept}
    result["provenance"] = provenance.results(args.commit)
    output.write_json(args.out / "uncertainty.json", result)
    if args.pages:
        output.fill(DOCS / "uncertainty.md", text, "pairs")
    print(draw(kept, differences, args.figures))
    return 0


def parse() -> argparse.Namespace:
    parser = provenance.parser(__doc__)
    parser.add_argument("--constants", default="unmeasured", metavar="TABLE")
    parser.add_argument("--preset", default="23d")
    parser.add_argument("--pairs", type=int, default=30)
    parser.add_argument("--budget", type=int, default=2400, help="grasps of a search, all counted")
    parser.add_argument("--grasps", type=int, default=400, help="that judge each design")
    parser.add_argument("--optimizer", default=DEFAULT, help="as of scripts.search")
    parser.add_argument("--out", type=Path, default=Path("runs/uncertainty"), metavar="FOLDER")
    parser.add_argument("--figures", type=Path, default=DOCS / "figures", metavar="FOLDER")
    parser.add_argument("--pages", action="store_true", help="fill the table into the page")
    return parser.parse_args()


def worlds_of(table: draws.Constants) -> dict[str, Scene]:
    """The scene with drawn constants, and with those in the middle of their distributions.

    Both have the same structure, and so the same programs: in the second scene the distributions
    have no width.
    """
    constants: dict[Any, Any] = {("drawn",): draws.plain(table)}
    scene = scenes.load(overrides=draws.nominal(table) | constants)
    return {"drawn": scene, "middle": dataclasses.replace(scene, drawn=middle(table))}


def middle(table: draws.Constants) -> draws.Constants:
    """The table with the middle of each distribution in place of the distribution."""
    entries = []
    for entry in table.constant:
        if entry.mean is not None:
            entries.append(dataclasses.replace(entry, sd=0.0))
        else:
            value = float(entry.middle)
            entries.append(dataclasses.replace(entry, low=value, high=value))
    return dataclasses.replace(table, constant=tuple(entries))


def make_studies(worlds: dict[str, Scene], args: argparse.Namespace) -> dict[str, lock_step.Study]:
    """The searches of all seeds in each scene, new or from the files of the folder."""
    space = design_space(worlds["drawn"].hand, args.preset)
    case = lock_step.make_case(args.optimizer, space, args.preset)
    name = f"{args.preset}-{Path(args.constants).stem}"
    studies = {}
    for arm, scene in worlds.items():
        studies[arm] = lock_step.Study(
            case,
            scene,
            make_engine("structured", scene),
            space,
            seeds=args.pairs,
            budget=args.budget,
            tests=args.grasps,
            marks=1,
            path=args.out / f"{name}-{arm}.npz",
        )
    # One program simulates both: its numbers are those of the scene that it gets.
    studies["middle"].programs = studies["drawn"].programs
    return studies


def judge_designs(
    studies: dict[str, lock_step.Study], arm: str, worlds: dict[str, Scene]
) -> dict[str, list[float]]:
    """Share of grasps that the design of each seed keeps in each scene, in the same trials."""
    study = studies[arm]
    last = study.marks[-1]
    kept = {}
    for name, scene in worlds.items():
        # A search's own scene has judged its designs already.
        shares = study.kept[last] if name == arm else study.judge(study.designs[last], scene)
        kept[name] = shares.tolist()
    return kept


def compare(kept: dict[str, dict[str, list[float]]]) -> tuple[list[list[str]], np.ndarray]:
    """The table, and the paired differences of the shares with drawn constants [%]."""
    rows = [["searched", "kept with drawn constants %", "the worst seed %", "kept in the middle %"]]
    for words, shares in kept.items():
        drawn = 100 * np.array(shares["drawn"])
        at_middle = 100 * np.mean(shares["middle"])
        rows.append([words, f"{drawn.mean():.1f}", f"{drawn.min():.0f}", f"{at_middle:.1f}"])
    first, second = kept.values()
    cells = []
    for name in ("drawn", "middle"):
        difference = 100 * (np.array(first[name]) - np.array(second[name]))
        cells.append(with_interval(difference))
    rows.append([f"difference, {len(first['drawn'])} pairs", cells[0], "", cells[1]])
    return rows, 100 * (np.array(first["drawn"]) - np.array(second["drawn"]))


def with_interval(differences: np.ndarray) -> str:
    """Mean of paired differences, and its interval from resampled pairs."""
    interval = statistics.bootstrap(lambda pairs: differences[pairs].mean(-1), len(differences))
    return f"{interval.value:+.1f} ({interval.low:+.1f} to {interval.high:+.1f})"


def draw(kept: dict[str, dict[str, list[float]]], differences: np.ndarray, folder: Path) -> Path:
    """The kept share of each pair, one kind of search over the other."""
    figure = output.new_figure(3.6, 3.4)
    axes = figure.subplots(1, 1)
    under, at_middle = (100 * np.array(shares["drawn"]) for shares in kept.values())
    axes.plot(at_middle, under, "o", ms=4)
    low = min(under.min(), at_middle.min()) - 2
    axes.plot([low, 100], [low, 100], "k", lw=0.5)
    axes.set(xlabel="kept, searched at the middle [%]", ylabel="kept, searched under all [%]")
    axes.set_title(f"{(differences > 0).sum()} of {len(differences)} pairs above", fontsize=9)
    return output.save_figure(figure, folder / "uncertainty.png")


if __name__ == "__main__":
    sys.exit(main())
