"""Joins parts of an experiment, each with other runs, and the fresh trials of their winners.

python -m scripts.experiments.join 23d runs/a runs/b --out docs/data/experiments/elements

The runs of the parts follow one another: where one ends with seed 19, the next begins with 20.  The
provenance is that of the first part; the others' is in its list `parts`.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from scripts.experiments import results, simulate

COMMON = ("strategies", "parameters")
"""Arrays that all parts share."""
BY_RUN = ("first", "seeds", "seed_cost", "seed_candidates", "particle_cost")
"""Arrays whose first axis is that of the runs; it is the second one of all others."""


def _shared(part: results.Study) -> dict[str, Any]:
    """What the settings of all parts say: all but their runs and the digest of the scene.

    The digest changes with the version of the package.
    """
    differ = ("plan", "seed", "scene_sha256")
    plan = {k: v for k, v in part.plan.items() if k != "runs"}
    return plan | {k: v for k, v in part.notes["settings"].items() if k not in differ}


def join(parts: list[results.Study]) -> tuple[simulate.Arrays, dict[str, Any]]:
    """Arrays and notes of the whole experiment.

    Raises:
      ValueError: If the parts differ in more than their runs and versions, or their seeds do not
        follow one another.
    """
    notes: dict[str, Any] = parts[0].notes | {"grasps": sum(p.notes["grasps"] for p in parts)}
    seed = parts[0].notes["settings"]["seed"]
    for part in parts:
        if _shared(part) != _shared(parts[0]):
            raise ValueError(f"{_shared(part)} is no part of {_shared(parts[0])}")
        if part.notes["settings"]["seed"] != seed:
            raise ValueError(
                f"a part begins with seed {part.notes['settings']['seed']}, not {seed}"
            )
        seed += part.plan["runs"]
    runs = sum(part.plan["runs"] for part in parts)
    notes["settings"] = notes["settings"] | {"plan": parts[0].plan | {"runs": runs}}
    others = [{k: v for k, v in part.notes.items() if k != "parts"} for part in parts[1:]]
    notes["parts"] = [*parts[0].notes.get("parts", ()), *others]
    arrays = {}
    for name, values in parts[0].data.items():
        if name in COMMON:
            arrays[name] = values
            continue
        axis = 0 if name in BY_RUN else 1
        arrays[name] = np.concatenate([part.data[name] for part in parts], axis)
    return arrays, notes


def join_fresh(
    name: str, parts: list[tuple[simulate.Arrays, dict[str, Any]]]
) -> tuple[simulate.Arrays, dict[str, Any]]:
    """Fresh trials of the whole experiment; what the first part has of others stays.

    Accuracies and objects that a part lacks are left out.
    """
    (first, notes), *others = parts
    arrays = {k: v for k, v in first.items() if not k.startswith(f"{name}|")}
    arrays[f"{name}|strategies"] = first[f"{name}|strategies"]
    for key in first:
        if key.startswith(f"{name}|") and key.count("|") == 2 and all(key in o for o, _ in others):
            arrays[key] = np.concatenate([first[key], *(o[key] for o, _ in others)], axis=1)
    return arrays, {"runs": [*notes["runs"], *(run for _, n in others for run in n["runs"])]}


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("experiment", choices=["2d", "23d"])
    parser.add_argument("parts", type=Path, nargs="+", help="folders, in the order of their seeds")
    parser.add_argument("--out", type=Path, required=True, help="folder")
    args = parser.parse_args()
    studies = [results.load_study(part, args.experiment) for part in args.parts]
    parts = [study for study in studies if study is not None]
    if len(parts) < len(args.parts):
        parser.error(f"a folder holds no {args.experiment}")
    arrays, notes = join(parts)
    fresh = [results.load(part, "fresh") for part in args.parts]
    simulate.write(args.out, args.experiment, arrays, notes)
    whole = [part for part in fresh if part is not None]
    if len(whole) == len(args.parts):
        simulate.write(args.out, "fresh", *join_fresh(args.experiment, whole))
    print(json.dumps(notes["settings"]["plan"]))


if __name__ == "__main__":
    main()
