"""Designs for objects that they were not made with: each object of a set is held out in turn.

A fold's search simulates all objects but one, in the noise of `--robust`, and what it recommends
meets the one that was held out: in that noise, and in the set's own.  Beside it stand designs that
were made with other objects, such as the paper's three (`--others`, files of `scripts.search`).

All folds are one program, as the object of a trial is data.  The same command goes on where it
stopped.  `--report` writes the table of docs/notes/search.md.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, objects, optimize, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.engines import make_engine
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import design_space
from codesign_jax.types import failed
from scripts.search.study import STREAM_JUDGE, UNFINISHED, Study, make_case
from scripts.shared import provenance, tables
from scripts.shared.output import write_json

PAGE = Path("docs/notes/search.md")


def folds(count: int) -> np.ndarray:
    """Objects that each fold's search sees, shape (fold, object); fold f does not see f."""
    return np.array([np.delete(np.arange(count), f) for f in range(count)])


def kept(
    study: Study, designs: np.ndarray, noise: Scene, shapes: np.ndarray, trials: int
) -> np.ndarray:
    """Share of fresh grasps that each design keeps of each object, shape (design, object).

    Args:
      study: What simulates.
      designs: Designs, shape (design, parameter).
      noise: Scene whose noise the trials have.
      shapes: Objects for each design, shape (design, object).
      trials: Trials with each object.
    """
    keys = jax.vmap(lambda s: codesign.stream_key(jax.random.key(s), STREAM_JUDGE))(
        jnp.arange(len(designs))
    )
    drawn = study.drawn(keys, trials * shapes.shape[1], shapes, noise)
    found = study.outcomes(jnp.asarray(designs)[:, None], drawn)
    good = ~failed(np.asarray(found.status)) & (np.asarray(found.cost) < SUCCESS_COST)
    return good.reshape(len(designs), trials, shapes.shape[1]).mean(1)


def judged(study: Study, usual: Scene, others: dict[str, np.ndarray], trials: int) -> dict:
    """What the folds' designs keep of what they saw and did not see, and others of everything.

    Args:
      study: The finished study of all folds.
      usual: The scene with the set's own noise; the study's has that of `--robust`.
      others: Designs that were made with other objects, by name.
      trials: Trials with an object that was held out; seen ones get a seventh of that, at least.
    """
    count = len(usual.objects.object)
    designs = study.designs[study.marks[-1]]
    out = np.arange(len(designs)) // (len(designs) // count)
    found: dict[str, Any] = {"held_out": out.tolist()}
    for name, noise in (("robust", study.scene), ("usual", usual)):
        unseen = kept(study, designs, noise, out[:, None], trials)
        seen = kept(study, designs, noise, study.shapes, max(1, trials // study.shapes.shape[1]))
        found[name] = {"unseen": unseen[:, 0].tolist(), "seen": seen.mean(1).tolist()}
        for other, theirs in others.items():
            every = np.tile(np.arange(count), (len(theirs), 1))
            each = kept(study, theirs, noise, every, max(1, trials // count))
            found[name][other] = each.tolist()
    return found


def table(row: dict[str, Any]) -> str:
    """A row for each object that was held out, and the median fold."""
    names, out = row["objects"], np.array(row["held_out"])
    others = [name for name in row["usual"] if name not in ("seen", "unseen")]
    head = ["held out", "kept, unseen", "kept, unseen, `--robust` noise", "kept of the seven seen"]
    head += [f"`{name}` keeps of it" for name in others]

    def line(which: np.ndarray | slice, objects: np.ndarray | int) -> list[str]:
        own = [row["usual"]["unseen"], row["robust"]["unseen"], row["usual"]["seen"]]
        theirs = [np.array(row["usual"][name])[:, objects] for name in others]
        return [f"{np.median(np.array(v)[which]):.3f}" for v in own] + [
            f"{np.median(v):.3f}" for v in theirs
        ]

    found = [head, *([name, *line(out == i, i)] for i, name in enumerate(names))]
    medians = [
        [np.median(np.array(v)[out == i]) for i in range(len(names))]
        for v in (row["usual"]["unseen"], row["robust"]["unseen"], row["usual"]["seen"])
    ]
    theirs = [np.median(np.array(row["usual"][name]), axis=0) for name in others]
    found.append(["median fold", *(f"{np.median(v):.3f}" for v in (*medians, *theirs))])
    return tables.markdown(found)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(prog="scripts.search.unseen", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="file of what is done, .npz")
    parser.add_argument("--objects", default="household")
    parser.add_argument("--preset", default="23d")
    parser.add_argument("--optimizer", default=optimize.DEFAULT, help="as of scripts.search")
    parser.add_argument("--seeds", type=int, default=3, help="searches of each fold")
    parser.add_argument("--budget", type=int, default=5250, help="grasps of a search")
    parser.add_argument("--trials", type=int, default=200, help="grasps of the object held out")
    parser.add_argument("--others", nargs="*", default=[], help="NAME=FILE.npz of scripts.search")
    parser.add_argument("--most", type=int, default=24, help="designs of each of the others")
    parser.add_argument("--minutes", type=float, help="time after which no step begins")
    parser.add_argument("--chunk", type=int, help="most grasps of a call")
    parser.add_argument("--report", action="store_true", help="fill in the page and stop")
    parser.add_argument("--page", type=Path, default=PAGE)
    provenance.add_commit(parser)
    args = parser.parse_args(arguments)
    result = args.out.with_suffix(".json")
    if args.report:
        tables.fill(args.page, table(json.loads(result.read_text())), "unseen")
        return 0
    use_compilation_cache()
    begin = time.monotonic()
    usual = scenes.load("paper", object_set=args.objects)
    noise = {f"objects.noise.{n}": v for n, v in dataclasses.asdict(objects.ROBUST).items()}
    scene = scenes.load("paper", object_set=args.objects, overrides=noise)
    count, space = len(scene.objects.object), design_space(scene.hand, args.preset)
    shapes = np.repeat(folds(count), args.seeds, axis=0)
    case = make_case(args.optimizer, space, args.preset, count - 1)
    engine = make_engine("structured", scene)
    chunk = args.chunk or (512 if jax.default_backend() == "cpu" else 16_384)
    how = {"seeds": len(shapes), "tests": count - 1, "marks": 1, "chunk": chunk, "shapes": shapes}
    study = Study(case, scene, engine, space, budget=args.budget, **how, path=args.out)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    grasps = 0
    while not study.finished:
        if args.minutes is not None and time.monotonic() - begin > 60 * args.minutes:
            print(f"after {study.done} episodes; the same command goes on", flush=True)
            return UNFINISHED
        grasps += study.step()
        study.save()
        rate = grasps / (time.monotonic() - begin)
        print(f"episode {study.done}/{study.marks[-1]}, {rate:.0f} grasps/s", flush=True)
    others = {}
    for pair in args.others:
        other, _, path = pair.partition("=")
        with np.load(path) as stored:
            last = max(int(n.removeprefix("designs")) for n in stored if n.startswith("designs"))
            others[other] = stored[f"designs{last}"][: args.most]
    row = {"optimizer": case.name, "objects": [s.name for s in scene.objects.object]}
    row |= {"grasps": study.row()["grasps"][-1], "seeds": args.seeds, "trials": args.trials}
    row |= judged(study, usual, others, args.trials)
    write_json(result, row | {"provenance": provenance.results(args.commit)})
    print(table(row))
    return 0


if __name__ == "__main__":
    sys.exit(main())
