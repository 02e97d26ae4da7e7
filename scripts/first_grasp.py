"""Times the first result of a new process: this checkout against an older one, cold and warm.

    python -m scripts.first_grasp OLD [--pairs 2] [--json runs/first_grasp.json]

OLD is a commit, or a folder with its source.  Each process does what README's eight lines do until
their first line: an episode of the scene `paper`.  The checkouts take turns, A B A B.  *Cold* finds
no program or kernel on disk, *warm* those of the cold process before it.  The table has wall time,
the processor time of all threads, which other processes disturb less, and where it went; a stage's
includes that of what runs beside it, such as LLVM beside XLA.
"""

import argparse
import collections
import compileall
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]

STAGES = {
    "trace of the kernel": ("codesign_jax.compiler.launch", "kernel_jaxpr"),
    "writer": ("codesign_jax.compiler.cpu", "block_code"),
    "LLVM": ("codesign_jax.compiler.handlers", "compile"),
    "writer for a GPU": ("codesign_jax.compiler.thread", "write"),
    "PTX": ("codesign_jax.compiler.thread", "assembly"),
    "driver": ("codesign_jax.compiler.gpu", "load"),
    "XLA": ("jax._src.compiler", "backend_compile_and_load"),
}
"""Functions whose time is told, by what they do; one that a checkout lacks has none."""


IGNORED = ("JAX_COMPILATION_CACHE_DIR", "PYTHONDONTWRITEBYTECODE")
"""Environment variables that no user has: programs elsewhere, and sources compiled at each start,
which takes seconds."""


def worker() -> None:
    """The process that is timed; prints seconds of processor and wall by stage as JSON."""
    begun = float(os.environ["FIRST_GRASP_BEGUN"])
    spent: dict[str, float] = collections.defaultdict(float)
    calls: dict[str, int] = collections.defaultdict(int)

    import jax
    import numpy as np

    import codesign_jax
    from codesign_jax import Task, codesign, parameters, scene

    codesign_jax.use_compilation_cache()
    for stage, place in STAGES.items():
        _time(stage, *place, spent, calls)
    grasping = scene.load("paper")
    space = parameters.design_space(grasping.hand, "2d")
    task = Task(grasping, space, trials=3)
    optimizer = codesign.make_filter(space)
    spent["imports, scene"] = time.process_time()
    if "--imports" in sys.argv:
        print(json.dumps({"seconds": spent}))
        return
    state = optimizer.init(jax.random.key(0), space.from_units([130.0, 150.0]), num_particles=10)
    state, info = task.episode(optimizer, state)
    costs = np.asarray(info.outcomes.cost)
    spent["total"] = time.process_time()
    spent["wall"] = time.time() - begun
    start = time.process_time()
    jax.block_until_ready(task.episode(optimizer, state)[1].outcomes.cost)
    spent["second episode"] = time.process_time() - start
    print(json.dumps({"seconds": spent, "calls": calls, "cost": float(costs.mean())}))


def _time(stage: str, module: str, name: str, spent: dict, calls: dict) -> None:
    """Adds up the processor time of a module's function."""
    try:
        home: Any = __import__(module, fromlist=[name])
        function: Callable = getattr(home, name)
    except (ImportError, AttributeError):
        return

    def timed(*arguments: Any, **options: Any) -> Any:
        start = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            spent[stage] += time.process_time() - start
            calls[stage] += 1

    setattr(home, name, timed)


def measured(source: Path, caches: Path, *flags: str) -> dict[str, Any]:
    """What a worker prints with the package of a checkout and caches below a folder."""
    environment = {k: v for k, v in os.environ.items() if k not in IGNORED}
    environment |= {"PYTHONPATH": str(source), "XDG_CACHE_HOME": str(caches)}
    environment["FIRST_GRASP_BEGUN"] = str(time.time())
    command = [sys.executable, str(Path(__file__).resolve()), "--worker", *flags]
    done = subprocess.run(command, cwd=source, env=environment, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def compare(sources: dict[str, Path], pairs: int) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Measurements by checkout and by `cold` or `warm`, in turns."""
    every = {name: {"cold": [], "warm": []} for name in sources}
    for source in sources.values():  # an installed package has its bytecode, and so have others
        compileall.compile_dir(source / "codesign_jax", quiet=1)
        with tempfile.TemporaryDirectory() as caches:
            measured(source, Path(caches), "--imports")
    for _ in range(pairs):
        for name, source in sources.items():
            with tempfile.TemporaryDirectory() as caches:
                for state, of in every[name].items():
                    of.append(measured(source, Path(caches)))
                    seconds = of[-1]["seconds"]
                    words = f"{seconds['wall']:.1f} s wall, {seconds['total']:.1f} s processor"
                    print(f"{name} {state}: {words}", file=sys.stderr, flush=True)
    return every


def table(every: dict[str, dict[str, list[dict[str, Any]]]]) -> list[list[str]]:
    """Rows of the least seconds of each stage, with a head."""
    columns = [(name, state) for state in ("cold", "warm") for name in every]
    rows = [["seconds, least of all", *(f"{name}, {state}" for name, state in columns)]]
    for stage in ("wall", "total", "imports, scene", *STAGES, "second episode"):
        cells = []
        for name, state in columns:
            values = [m["seconds"].get(stage, 0.0) for m in every[name][state]]
            cells.append(f"{min(values):.2f}")
        rows.append([stage if stage != "total" else "processor", *cells])
    return rows


def main() -> int:
    """Measures, and prints the table."""
    from scripts.agree import sides
    from scripts.shared import output

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("old", help="commit, or folder with its source")
    parser.add_argument("--pairs", type=int, default=2, help="processes of each, cold and warm")
    parser.add_argument("--json", type=Path, help="file for all measurements")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sources = {"old": sides.checkout(arguments.old, Path(folder)), "new": ROOT}
        every = compare(sources, arguments.pairs)
    if arguments.json:
        output.write_json(arguments.json, every)
    print(output.markdown(table(every)))
    return 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        worker()
    else:
        sys.exit(main())
