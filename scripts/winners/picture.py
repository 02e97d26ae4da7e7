"""The grasps of designs as a hand that could be built: depths, what stays stuck, and pictures.

python -m scripts.winners.picture runs/search/23d-screened-cma-es.npz --count 12 --out runs/picture
python -m scripts.winners.picture --random 20 --out runs/picture_random

A file is what `scripts.search` keeps (what its last mark recommends to each seed) or the 23d.npz or
2d.npz of `scripts.experiments` (the best particle of each run).  Every design meets fresh trials in
the default scene.  --out gets picture.json, and a film strip of each design's first trials with the
moments at which a finger was deepest; --video adds an animation.  12 designs in 6 trials take a few
minutes on two cores.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, rollout, sampling
from codesign_jax import scene as scenes
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.commands import common
from codesign_jax.engines import make_engine
from codesign_jax.report.animation import Replay, replay, write_gif, write_strip
from codesign_jax.scene import InputError, Scene, keypaths, parameters
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Status, failed
from scripts.shared import depths, output, provenance

STREAM_PICTURE = 0x70696374
"""Stream of these trials ("pict"): no search has met them."""
EVERY = 5
"""Every how many steps fingers are looked for in one another."""
LASTING = 0.5
"""How long a finger is so deep in another that it is counted apart [s]."""
PALM_LIMIT, SHARE_LIMIT = 2e-3, 1 / 3
"""Depth in the palm [m], and in a finger as a share of its section, that are counted."""


def recommended(path: Path, count: int) -> np.ndarray:
    """Designs of a file [SI], shape (design, parameter).

    Args:
      path: The file.
      count: Number of designs, the first ones.

    Raises:
      InputError: If the file has none.
    """
    with np.load(path, allow_pickle=False) as stored:
        marks = [int(n.removeprefix("designs")) for n in stored if n.startswith("designs")]
        if marks:
            found = stored[f"designs{max(marks)}"]
        elif "final_particles" in stored:
            particles, cost = stored["final_particles"][-1], stored["test_exclude"][-1]
            found = particles[np.arange(len(cost)), np.nanargmin(cost, axis=1)]
        else:
            raise InputError([f"{path} has no designs of scripts.search or scripts.experiments"])
    return found[:count]


def drawn(scene: Scene, space: DesignSpace, count: int, seed: int) -> np.ndarray:
    """Random designs [SI], shape (design, parameter)."""
    key = jax.random.key(seed)
    return np.asarray(sampling.draw(scene, space, key, first=0, n=count, num_trials=1).designs)


def measured(scene: Scene, grasp: Replay) -> dict[str, Any]:
    """What is told of a grasp: its end, and how deep fingers are from the inflation on."""
    params, trial, outcome = grasp.params, grasp.trial, grasp.outcome
    bad = bool(failed(outcome.status))
    found: dict[str, Any] = {
        "object": scene.objects.object[int(trial.shape)].name,
        "kept": bool(not bad and outcome.cost < SUCCESS_COST),
        "stuck": bool(int(outcome.status) & Status.STUCK),
        "failed": bad,
    }
    h, start = scene.discretization.timestep, int(scene.last_step("approach"))
    at = depths.poses(depths.compiled(scene, params, trial), grasp.qpos[start:])
    palm = depths.in_palm(scene, params, at)
    some = depths.Poses(*(v[::EVERY] for v in at))
    deep, share = depths.in_fingers(scene, params, some)
    return found | {
        "palm_mm": round(1e3 * float(palm.max()), 2),
        "palm_at_s": round(h * (start + int(palm.argmax())), 2),
        "palm_deep_s": round(h * int((palm > PALM_LIMIT).sum()), 2),
        "finger_mm": round(1e3 * float(deep.max()), 2),
        "finger_share": round(float(share.max()), 3),
        "finger_at_s": round(h * (start + EVERY * int(share.argmax())), 2),
        "finger_deep_s": round(h * EVERY * int((share > SHARE_LIMIT).sum()), 2),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares and depths of all grasps."""
    kept = [r for r in rows if r["kept"]]

    def of(key: str, limit: float) -> dict[str, Any]:
        values = np.array([r[key] for r in kept] or [0.0])
        return {"most": float(values.max()), "beyond": int((values > limit).sum())}

    return {
        "grasps": len(rows),
        "kept": len(kept),
        "stuck": sum(r["stuck"] for r in rows),
        "failed": sum(r["failed"] for r in rows),
        "palm_mm": of("palm_mm", 1e3 * PALM_LIMIT),
        "finger_mm": of("finger_mm", np.inf),
        "finger_share": of("finger_share", SHARE_LIMIT),
        "finger_deep_s": of("finger_deep_s", LASTING),
    }


def told(found: dict[str, Any]) -> str:
    """The summary in sentences."""
    s = found["summary"]
    palm, share = s["palm_mm"], s["finger_share"]
    return (
        f"{s['kept']} of {s['grasps']} grasps kept, {s['stuck']} STUCK, {s['failed']} failed. "
        f"In kept grasps a vertex is at most {palm['most']:.1f} mm in the palm, in "
        f"{palm['beyond']} of them more than {1e3 * PALM_LIMIT:.0f} mm; a finger is at most "
        f"{s['finger_mm']['most']:.1f} mm in another, {share['most']:.2f} of its section, in "
        f"{share['beyond']} more than a third, in {s['finger_deep_s']['beyond']} of them for more "
        f"than {LASTING} s."
    )


def pictures(
    scene: Scene, grasps: list[Replay], rows: list[dict[str, Any]], path: Path, video: bool
) -> None:
    """Draws grasps at the ends of phases, and where palm and fingers were deepest."""
    p = scene.phases
    ends = (p.approach, (p.approach + p.inflate) / 2, p.inflate, p.lift, p.disturb)
    worst = [max(rows, key=lambda r: r[key]) for key in ("palm_mm", "finger_share")]
    deepest = (worst[0]["palm_at_s"], worst[1]["finger_at_s"])
    times = (*ends, (p.disturb + scene.end_time) / 2, scene.end_time, *deepest)
    write_strip(scene, grasps, path.with_suffix(".png"), times=times, size=(300, 300))
    if video:
        write_gif(scene, grasps, path.with_suffix(".gif"))


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("files", type=Path, nargs="*", help="designs of several files, in turn")
    parser.add_argument("--count", type=int, default=12, help="designs of each file")
    parser.add_argument("--random", type=int, default=0, help="random designs as well")
    parser.add_argument("--preset", default="23d", help="the designs' parameters")
    parser.add_argument("--trials", type=int, default=6, help="of a design, objects in turn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shown", type=int, default=3, help="trials of a strip; 0 for no pictures")
    parser.add_argument("--video", action="store_true", help="an animation beside each strip")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, required=True)
    provenance.add_commit(parser)
    args = parser.parse_args(arguments)
    common.use_compilation_cache()
    scene = scenes.load("paper", overrides=keypaths.parse(args.set))
    space = parameters.design_space(scene.hand, args.preset)
    parts = [(str(path), recommended(path, args.count)) for path in args.files]
    if args.random:
        parts.append(("random", drawn(scene, space, args.random, args.seed)))
    designs = [(f"{name} {i}", v) for name, part in parts for i, v in enumerate(part)]
    if not designs:
        raise InputError(["give a file with designs, or --random 20"])
    key = codesign.stream_key(jax.random.key(args.seed), STREAM_PICTURE, 0)
    trials = rollout.sample_trials(scene, key, args.trials)
    engine, every = make_engine("structured", scene), []
    found: dict[str, Any] = {"designs": [], **provenance.results(args.commit)}
    for number, (name, vector) in enumerate(designs):
        grasps = replay(scene, engine, space.params(jnp.asarray(vector)), trials)
        rows = [measured(scene, grasp) for grasp in grasps]
        every += rows
        found["designs"].append({"name": name, "vector": vector.tolist(), "grasps": rows})
        found["summary"] = summary(every)
        output.write_json(args.out / "picture.json", found)
        own = summary(rows)
        print(f"{number} {name}: {own}", flush=True)
        if args.shown:
            path = args.out / f"{number:02d}"
            pictures(scene, grasps[: args.shown], rows[: args.shown], path, args.video)
    print(told(found))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ValueError as error:
        sys.exit(f"error: {error}")
