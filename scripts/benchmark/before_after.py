"""Grasps a second of two checkouts, measured alternately in one run: before, after, before, ...

git worktree add /tmp/before COMMIT
python -m scripts.benchmark.before_after --before /tmp/before --worlds 60
python -m scripts.benchmark.before_after --before /tmp/before --worlds 1728 16384

Whole grasps of the best particle of each concurrent run with 23 parameters, or of --designs, in
the default scene, each in trials of its own.  A process for each checkout compiles first; then they
take turns, so that one of them works at a time.  The quotient within a round is what counts.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any


def serve(designs: str, sizes: list[int], overrides: list[str]) -> None:
    """Simulates grasps of the package that is imported, once for every line of standard input."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from codesign_jax import provenance, rollout
    from codesign_jax import scene as scenes
    from codesign_jax.engines import make_engine
    from codesign_jax.scene import keypaths, parameters

    with np.load(designs, allow_pickle=False) as stored:
        particles, cost = stored["final_particles"][-1], stored["test_exclude"][-1]
    best = particles[np.arange(len(cost)), np.nanargmin(cost, axis=1)]
    scene = scenes.load("paper", overrides=keypaths.parse(overrides))
    space, engine = parameters.design_space(scene.hand, "23d"), make_engine("structured", scene)
    programs = {}
    for worlds in sizes:
        chosen = jnp.asarray(best[np.arange(worlds) % len(best)], jnp.float32)
        params = jax.jit(jax.vmap(space.params))(chosen)
        trials = rollout.sample_trials(scene, jax.random.key(0), worlds)
        run = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t)[0])
        programs[worlds] = run.lower(params, trials).compile(), params, trials
    print(json.dumps({**provenance.git_state(), **provenance.environment()}), flush=True)
    for line in sys.stdin:
        program, params, trials = programs[int(line)]
        start = time.perf_counter()
        found = jax.block_until_ready(program(params, trials))
        seconds = time.perf_counter() - start
        kept = float((np.asarray(found.cost) == 0).mean())
        print(json.dumps({"seconds": seconds, "kept": kept}), flush=True)


def start(folder: Path, args: argparse.Namespace) -> subprocess.Popen:
    """A process that serves a checkout."""
    # -P: this folder has a module named as a package, warp.
    command = [
        sys.executable,
        "-P",
        str(Path(__file__).resolve()),
        "--serve",
        *map(str, args.worlds),
    ]
    command += ["--designs", str(args.designs.resolve())]
    if folder.resolve() == Path().resolve():
        command += [part for value in args.set for part in ("--set", value)]
    path = os.pathsep.join([str(folder.resolve()), os.environ.get("PYTHONPATH", "")])
    settings = {"PYTHONPATH": path, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, env=os.environ | settings, stdin=pipe, stdout=pipe, text=True
    )


def answer(process: subprocess.Popen, question: str = "") -> dict[str, Any]:
    """The next line of a process, after a question."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(question)
    process.stdin.flush()
    line = process.stdout.readline()
    if not line:
        sys.exit(f"error: a process ended: {process.args}")
    return json.loads(line)


def main() -> None:
    """Command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--before", type=Path, help="folder of the other checkout")
    parser.add_argument("--worlds", type=int, nargs="+", default=[60])
    parser.add_argument("--rounds", type=int, default=5)
    designs = Path(__file__).parents[2] / "docs/data/experiments/23d.npz"
    parser.add_argument("--designs", type=Path, default=designs)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of after")
    parser.add_argument("--out", type=Path, default=Path("runs/before_after.json"))
    parser.add_argument("--serve", type=int, nargs="+", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve:
        return serve(str(args.designs), args.serve, args.set)
    if args.before is None:
        parser.error("--before is missing")
    sides = {"before": start(args.before, args), "after": start(Path(), args)}
    found: dict[str, Any] = {"command": " ".join(sys.argv), "rounds": []}
    found |= {name: answer(process) for name, process in sides.items()}
    for worlds in args.worlds:
        rounds = []
        for _ in range(args.rounds + 1):  # the first one of a process warms up
            rounds.append({k: answer(p, f"{worlds}\n") for k, p in sides.items()})
        ratios = [r["before"]["seconds"] / r["after"]["seconds"] for r in rounds[1:]]
        row = {"worlds": worlds, "times": statistics.median(ratios), "least": min(ratios)}
        for name in sides:
            best = min(r[name]["seconds"] for r in rounds[1:])
            row[name] = {"grasps_per_s": worlds / best, "kept": rounds[-1][name]["kept"]}
        found["rounds"].append(row | {"ratios": ratios})
        print(json.dumps(row), flush=True)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    for process in sides.values():
        process.terminate()


if __name__ == "__main__":
    main()
