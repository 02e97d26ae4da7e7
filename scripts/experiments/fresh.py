"""Every strategy's best final particles on fresh trials, at several accuracies.

python -m scripts.experiments.fresh --experiments 23d --accuracies standard,reference
python -m scripts.experiments.fresh --experiments 23d --objects household --label meshes   # adds
python -m scripts.experiments.fresh --report --page docs/notes/results.md
python -m scripts.experiments.fresh --report --data docs/data/experiments/elements   # its tables

An optimiser picks what the errors of its simulation favour (the winner's curse), so the order of
the strategies is looked at once more: the particle of each run that tested best meets trials that
no run has met, once as it was designed and once at a finer accuracy, the same trials in each.
Results go to fresh.npz and fresh.json beside the experiments; what is there is not run again.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout, scene, use_compilation_cache
from codesign_jax.codesign import stream_key
from codesign_jax.engines import NAMES, make_engine
from codesign_jax.scene import keypaths, parameters
from codesign_jax.statistics import wilson
from codesign_jax.types import failed
from scripts.experiments import results
from scripts.experiments.simulate import write
from scripts.shared import output, provenance, statistics

STREAM_FRESH = 0x66726573
"""Stream of the noise of these trials ("fres"): none of them was met in a run."""

EXPERIMENTS = ("2d", "23d")


def winners(data: Path, name: str) -> tuple[list[str], np.ndarray]:
    """The final particle of each run that tested best.

    Returns:
      Names of the strategies, and particles [SI units] of shape (strategy, run, parameter).
    """
    study = results.load_study(data, name)
    if study is None or not study.tested:
        raise FileNotFoundError(f"{data} holds no {name} with a final test")
    best = np.argmin(study.data["test_exclude"], axis=-1)
    chosen = np.take_along_axis(study.data["final_particles"], best[..., None, None], axis=2)
    return study.strategies, chosen[:, :, 0]


def simulate(
    the_scene: scene.Scene, engine: str, every: dict[str, np.ndarray], trials: int
) -> dict[str, Any]:
    """Simulates the particles of all experiments as one batch of worlds.

    Returns:
      `NAME|cost` (float16) and `NAME|status`, shape (strategy, run, trial).
    """
    params = []
    for name, particles in every.items():
        space = parameters.design_space(the_scene.hand, name)
        flat = jnp.asarray(particles.reshape(-1, particles.shape[-1]), jnp.float32)
        params.append(jax.jit(jax.vmap(space.params))(flat))
    joined = jax.tree.map(lambda *v: jnp.concatenate(v), *params)
    drawn = rollout.sample_trials(the_scene, stream_key(jax.random.key(0), STREAM_FRESH, 0), trials)
    simulator = make_engine(engine, the_scene)
    outcome = jax.jit(lambda p, t: rollout.evaluate(the_scene, simulator, p, t))(joined, drawn)
    arrays = {}
    start = 0
    for name, particles in every.items():
        shape = particles.shape[:2]
        count = int(np.prod(particles.shape[:2]))
        part = slice(start, start + count)
        arrays[f"{name}|cost"] = np.asarray(outcome.cost[part], np.float16).reshape(*shape, trials)
        arrays[f"{name}|status"] = np.asarray(outcome.status[part], np.uint8).reshape(
            *shape, trials
        )
        start += count
    return arrays


def run(args: argparse.Namespace) -> None:
    """Simulates at the accuracies that the file does not have yet."""
    path = args.data / "fresh.npz"
    arrays = dict(np.load(path)) if path.exists() else {}
    notes: dict[str, Any] = {"runs": []}
    if path.exists():
        notes = json.loads(path.with_suffix(".json").read_text())
    chosen = {name: winners(args.data, name) for name in args.experiments}
    arrays |= {f"{name}|strategies": np.array(names) for name, (names, _) in chosen.items()}
    every = {name: particles for name, (_, particles) in chosen.items()}
    for accuracy in args.accuracies:
        label = accuracy if args.engine == "structured" else f"{args.engine}, {accuracy}"
        label += f", {args.label}" if args.label else ""
        if all(f"{name}|{label}|cost" in arrays for name in every):
            continue
        overrides = keypaths.parse(args.set)
        arguments = {"accuracy": accuracy, "object_set": args.objects, "overrides": overrides}
        the_scene = scene.load(args.scene, **arguments)
        new = simulate(the_scene, args.engine, every, args.trials)
        for key, value in new.items():
            name, kind = key.split("|")
            arrays[f"{name}|{label}|{kind}"] = value
        made = provenance.results(args.commit)
        notes["runs"].append({"label": label, "experiments": list(every), **made})
        write(args.data, "fresh", arrays, notes)
        print(f"{label}: {sum(new[f'{n}|cost'].size for n in every):,} grasps", flush=True)


def summary(data: Path) -> str:
    """The tables of what was simulated, one an experiment."""
    loaded = results.load(data, "fresh")
    if loaded is None:
        raise FileNotFoundError(f"{data} holds no fresh.npz")
    arrays = loaded[0]
    text = []
    for name in EXPERIMENTS:
        labels = [k.split("|")[1] for k in arrays if k.startswith(f"{name}|") and "cost" in k]
        if labels:
            text += [_table(name, arrays, labels)]
    return "\n\n".join(text)


def _table(name: str, arrays: dict[str, np.ndarray], labels: Sequence[str]) -> str:
    """Kept grasps and runs of each strategy; differences to the first label and the last strategy.

    They are differences in the same trials: fewer trials are the first ones of more.
    """
    head = ["strategy"]
    for i, label in enumerate(labels):
        head += [f"{label}: grasps kept", "runs whose particle keeps all"]
        head += [f"change from {labels[0]}, points"] if i else []
    rows = [head]
    strategies = [str(s) for s in arrays[f"{name}|strategies"]]
    for s, strategy in enumerate(strategies):
        cells = [strategy]
        for i, label in enumerate(labels):
            kept, good = _grasps(arrays, name, label)[:, s]
            share = kept.sum(-1) / np.maximum(good.sum(-1), 1)
            whole = wilson(int((share == 1).sum()), share.size)
            cells += [f"{100 * share.mean():.1f} %"]
            cells += [f"{int((share == 1).sum())} of {share.size} [{100 * whole.low:.0f}, "]
            cells[-1] += f"{100 * whole.high:.0f} %]"
            if i:
                before = _grasps(arrays, name, labels[0], kept.shape[-1])[:, s]
                cells += [_difference((kept, good), before)]
        rows.append(cells)
    trials = arrays[f"{name}|{labels[0]}|cost"].shape[-1]
    return (
        f"{name}: {trials} fresh trials of each run's best particle\n\n{output.markdown(rows)}\n\n"
        f"{name}: grasps kept by {strategies[-1]}, less those of another strategy, points\n\n"
        f"{_against_last(name, arrays, labels)}"
    )


def _against_last(name: str, arrays: dict[str, np.ndarray], labels: Sequence[str]) -> str:
    """The last strategy's share less that of each other one; runs of one number are pairs."""
    strategies = [str(s) for s in arrays[f"{name}|strategies"]]
    rows = [["strategy", *labels]]
    for s, strategy in enumerate(strategies[:-1]):
        tables = [_grasps(arrays, name, label) for label in labels]
        rows.append([strategy, *(_difference(t[:, -1], t[:, s]) for t in tables)])
    return output.markdown(rows)


def _difference(of: Sequence[np.ndarray], to: Sequence[np.ndarray]) -> str:
    """Points by which the share of kept grasps differs, its interval over runs and trials.

    Args:
      of: Kept grasps and grasps that did not fail, each of shape (run, trial).
      to: The same of what is subtracted.
    """

    def points(*tables: np.ndarray) -> list[float]:
        shares = [t.sum(-1) for t in tables]
        of, to = (100 * k / np.maximum(g, 1) for k, g in (shares[:2], shares[2:]))
        return [float((of - to).mean())]

    [middle] = statistics.two_way(points, *of, *to)
    return f"{middle.value:+.1f} [{middle.low:+.1f}, {middle.high:+.1f}]"


def _grasps(
    arrays: dict[str, np.ndarray], name: str, label: str, trials: int | None = None
) -> np.ndarray:
    """Kept grasps, and grasps that did not fail, shape (2, strategy, run, trial)."""
    cost, status = (arrays[f"{name}|{label}|{kind}"][..., :trials] for kind in ("cost", "status"))
    good = ~failed(status)
    return np.stack([(cost == 0) & good, good])


def parse() -> argparse.Namespace:
    parser = provenance.parser(__doc__)
    names = lambda text: text.split(",")  # noqa: E731 - three options read the same
    parser.add_argument("--data", type=Path, default=Path("docs/data/experiments"))
    parser.add_argument("--scene", default="paper", help="that of the experiments")
    parser.add_argument("--experiments", type=names, default=list(EXPERIMENTS))
    parser.add_argument("--accuracies", type=names, default=["standard", "reference"])
    parser.add_argument("--engine", choices=NAMES, default="structured")
    parser.add_argument("--trials", type=int, default=24)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--objects", help="object set instead of the scene's")
    parser.add_argument("--label", help="what --set changes, in the names of the results")
    parser.add_argument("--report", action="store_true", help="print the tables and stop")
    parser.add_argument("--page", type=Path, help="page whose table is filled in")
    return parser.parse_args()


def main() -> int:
    args = parse()
    try:
        if not args.report:
            use_compilation_cache()
            run(args)
        text = summary(args.data)
    except (scene.InputError, FileNotFoundError) as error:
        sys.exit(f"error: {error}")
    print(text)
    if args.page:
        law = args.data.name if args.data.name in results.LAWS else ""
        output.fill(args.page, text, f"fresh {law}".strip())
    return 0


if __name__ == "__main__":
    sys.exit(main())
