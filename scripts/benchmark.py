"""Whole grasps a second, of this engine with random and with good designs, and of its peers.

python -m scripts.benchmark --json docs/data/rates_cpu.json     # three minutes on two idle cores
python -m scripts.benchmark --page                              # the tables of the pages

On a GPU the batches are larger, and MuJoCo Warp is measured where it is installed.  A file that
exists is extended, and a case that is measured again is replaced, so that another MuJoCo can be
measured into the same file from another environment (--engines mujoco).  Of several calls the
shortest counts: other programs make a call longer and never shorter.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import cost, rollout, sampling, scene
from codesign_jax.engines import make_engine
from codesign_jax.scene import Scene, parameters
from codesign_jax.types import Outcome, failed
from scripts.shared import evidence, output, provenance, work

ROOT = Path(__file__).parents[1]
FILES = "docs/data/rates_*.json"
PAGES = {"docs/comparison.md": ("peers",), "docs/performance.md": ("rates", "measured", "peers")}
"""Pages with the marks of the tables that they hold."""
BATCHES = {
    60: " (an episode of the paper with 2 parameters)",
    360: " (an episode of the paper with 23 parameters)",
}
DESIGNS = {"random": "random designs", "winners": "winners"}
SPHERES = {"surface": "spheres"}
"""What engines without the skinned hull can simulate of the default scene."""
CASES: dict[str, tuple[str, dict[str, Any], tuple[str, ...], tuple[str, ...]]] = {
    "paper": ("paper", {}, ("random", "winners"), ("structured",)),
    "paper_spheres": ("paper_spheres", {}, ("mixed",), ("structured", "mujoco", "warp")),
    "paper with spheres": ("paper", SPHERES, ("mixed",), ("structured", "mujoco", "warp")),
}
"""Scenes: file, effects, designs and engines."""
WORLDS = {"cpu": {"": (60, 360), "mixed": (120,)}, "gpu": {"": (60, 360, 1728, 16384)}}
WORLDS["gpu"]["mixed"] = (1728,)
SECONDS = 10.0
"""Time after which no further call begins."""
JUDGED = 360
"""Grasps whose verdicts are kept, to be compared between engines."""


def make_worlds(chosen: Scene, designs: str, count: int) -> work.Worlds:
    """Hands and trials; every design meets other objects and noise.

    Args:
      chosen: The scene.
      designs: "random" (uniform over the 23 parameters), "winners", or "mixed" (half random, half
        good ones of two parameters).
      count: Number of grasps.
    """
    if designs == "mixed":
        return work.make_worlds(chosen, count)
    space = parameters.design_space(chosen.hand, "23d").of_table
    key = jax.random.key(work.SEED)
    objects = len(chosen.objects.object)
    trials = rollout.sample_trials(chosen, key, count)
    if designs == "winners":
        vectors = work.winners()
        index = np.arange(count)
        trials = trials._replace(shape=(index + index // len(vectors)) % objects)
        vectors = vectors[index % len(vectors)]
    else:
        drawn = sampling.draw(chosen, space, key, first=0, n=-(-count // objects), num_trials=1)
        vectors = np.repeat(np.asarray(drawn.designs), objects, axis=0)[:count]
    params = jax.vmap(space.params)(jnp.asarray(vectors, jnp.float32))
    return work.Worlds(*jax.tree.map(np.asarray, (params, trials)))


class JaxProgram:
    """A function of arrays, compiled in `compile_s`."""

    def __init__(self, function: Callable, *args: Any):
        begin = time.perf_counter()
        self.args = args
        self.compiled = jax.jit(function).lower(*args).compile()
        self.compile_s = time.perf_counter() - begin

    def run(self) -> tuple[Any, float]:
        """Runs once; returns results and seconds on the host's clock."""
        begin = time.perf_counter()
        result = jax.block_until_ready(self.compiled(*self.args))
        return result, time.perf_counter() - begin


def _program(chosen: Scene, engine: str, worlds: work.Worlds) -> Any:
    """What runs the grasps: `run` returns outcomes, or a trace of Warp's, and seconds."""
    if engine == "warp":
        from scripts.benchmark_warp import WarpProgram

        fields, ctrl = work.inputs(chosen, worlds)
        return WarpProgram(chosen, fields, np.asarray(ctrl))
    simulator = make_engine(engine, chosen)
    return JaxProgram(lambda p, t: rollout.simulate(chosen, simulator, p, t)[0], *worlds)


def _outcomes(chosen: Scene, result: Any) -> Outcome:
    if not isinstance(result, Outcome):  # Warp's trace is judged outside of its timing
        result = jax.vmap(lambda t: cost.outcome(chosen, t))(jax.tree.map(jnp.asarray, result))
    return jax.tree.map(np.asarray, result)


def measure(chosen: Scene, designs: str, engine: str, count: int, calls: int) -> dict[str, Any]:
    """Times one batch, compiled and warmed up before."""
    program = _program(chosen, engine, make_worlds(chosen, designs, count))
    result, first = program.run()
    seconds: list[float] = []
    while not seconds or (len(seconds) < calls and sum(seconds) + first < SECONDS):
        result, taken = program.run()
        seconds.append(round(taken, 4))
    outcomes = _outcomes(chosen, result)
    bad = np.asarray(failed(outcomes.status))
    kept = (outcomes.cost < 0.01) & ~bad
    return {
        "seconds": seconds,
        "grasps_per_s": round(count / min(seconds), 1),
        "compile_s": round(program.compile_s, 1),
        "kept": round(float(kept.mean()), 4),
        "failed": int(bad.sum()),
        "verdicts": "".join(map(str, kept[:JUDGED].astype(int))),
    }


def named(engine: str) -> str:
    """The engine's name with the version of a peer."""
    peers = {"mujoco": f"MuJoCo C {mujoco.__version__}", "mjx": "MJX", "warp": "MuJoCo Warp"}
    package = {"mjx": "mujoco-mjx", "warp": "mujoco-warp"}.get(engine)
    return peers.get(engine, engine) + (f" {metadata.version(package)}" if package else "")


# --- tables ---------------------------------------------------------------------------------------


def replaced(records: list[dict[str, Any]], new: dict[str, Any]) -> list[dict[str, Any]]:
    """The records with a new one in place of the same case's older one."""

    def key(record: dict[str, Any]) -> list:
        return [record[k] for k in ("scene", "designs", "engine", "worlds")]

    return [r for r in records if key(r) != key(new)] + [new]


def read() -> list[dict[str, Any]]:
    return [json.loads(path.read_text()) for path in sorted(ROOT.glob(FILES))]


def machine(run: dict[str, Any]) -> str:
    """What measured, such as "2 CPU cores" and "one H100"."""
    if run["platform"] == "cpu":
        return f"{run['cpus']} CPU cores"
    return f"one {run['device'].removeprefix('NVIDIA ').split()[0]}"


def newest(files: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The file that was measured last, of each platform."""
    ordered = sorted(files, key=lambda content: content["runs"][0]["date"])
    return [*{content["runs"][0]["platform"]: content for content in ordered}.values()]


def rates(files: list[dict[str, Any]]) -> str:
    """Grasps a second in the default scene: batches against machines and designs, in Markdown."""
    cells: dict[tuple[str, str], dict[int, str]] = {}
    files = newest(files)
    for content in files:
        for record in content["records"]:
            if record["scene"] == "paper" and record["engine"] == "structured":
                column = machine(content["runs"][record["run"]]), DESIGNS[record["designs"]]
                rate = record["grasps_per_s"]
                worlds = record["worlds"]
                text = f"{_rounded(rate)} ({_rounded(worlds / rate)} s)"
                cells.setdefault(column, {})[worlds] = text
    columns = sorted(cells, key=lambda c: list(DESIGNS.values()).index(c[1]))
    columns.sort(key=lambda c: [machine(f["runs"][0]) for f in files].index(c[0]))
    sizes = sorted({n for column in cells.values() for n in column})
    rows = [
        [
            "grasps a second (time of a batch)",
            *(f"{where}, {designs}" for where, designs in columns),
        ]
    ]
    for n in sizes:
        rows.append([f"{n:,} grasps{BATCHES.get(n, '')}", *(cells[c].get(n, "–") for c in columns)])
    return output.markdown(rows)


def machines(files: list[dict[str, Any]]) -> str:
    """What measured the default scene's rates, in a line; the files have the commits."""
    lines: dict[str, None] = {}
    for content in newest(files):
        for record in content["records"]:
            run = content["runs"][record["run"]]
            if record["scene"] == "paper":
                lines[f"{machine(run)}, version {_version(run)}, JAX {run['jax']}"] = None
    return f"Measured on {'; on '.join(lines)} (`docs/data/rates_*.json`)."


def peers(files: list[dict[str, Any]]) -> str:
    """This engine beside each peer: the same grasps on the same machine, in Markdown."""
    head = "scene, machine, peer, peer's grasps a second, this engine's, times as many"
    rows = [[*head.split(", "), "same verdicts", "the same where either keeps the object"]]
    rows[0] += ["version"]
    for content in files:
        for theirs in content["records"]:
            if theirs["engine"] == "structured":
                continue
            ours = _beside(content["records"], theirs)
            where = machine(content["runs"][theirs["run"]])
            where += f", {theirs['worlds']:,} grasps" if theirs["worlds"] else ""
            numbers = [theirs["grasps_per_s"], ours["grasps_per_s"]]
            shown = [_rounded(n) for n in numbers]
            ratio = f"{numbers[1] / numbers[0]:.0f}"
            verdicts = list(zip(ours["verdicts"], theirs["verdicts"], strict=True))
            kept = [pair for pair in verdicts if "1" in pair]
            same = [_same(verdicts), _same(kept)]
            version = _version(content["runs"][ours["run"]])
            rows.append([theirs["scene"], where, theirs["engine"], *shown, ratio, *same, version])
    return output.markdown(rows)


def _version(run: dict[str, Any]) -> str:
    """The package's version that a run measured."""
    return run.get("version", evidence.FIRST_VERSION)


def _beside(records: Iterable[dict[str, Any]], theirs: dict[str, Any]) -> dict[str, Any]:
    alike = [theirs[k] for k in ("scene", "designs", "worlds")]
    [ours] = [
        r
        for r in records
        if [r[k] for k in ("scene", "designs", "worlds")] == alike and r["engine"] == "structured"
    ]
    return ours


def _same(pairs: list[tuple[str, str]]) -> str:
    return f"{sum(ours == theirs for ours, theirs in pairs)} of {len(pairs)}"


def _rounded(number: float) -> str:
    return f"{float(f'{number:.2g}'):,.0f}" if number >= 10 else f"{number:#.2g}"


TABLES = {"rates": rates, "measured": machines, "peers": peers}


def fill_pages() -> None:
    files = read()
    for page, marks in PAGES.items():
        for mark in marks:
            output.fill(ROOT / page, TABLES[mark](files), mark)


# --- the command ----------------------------------------------------------------------------------


def arguments() -> argparse.Namespace:
    parser = provenance.parser(__doc__)
    parser.add_argument("--json", type=Path, default=Path("runs/rates.json"))
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE")
    parser.add_argument("--engines", nargs="+", help="instead of those of a case, such as mjx")
    parser.add_argument("--worlds", type=int, nargs="+", help="sizes of batches")
    parser.add_argument("--calls", type=int, default=5)
    parser.add_argument("--page", action="store_true", help="fill in the tables of docs/data")
    return parser.parse_args()


def main() -> None:
    """Measures the cases and writes the file after each, or fills in the tables."""
    args = arguments()
    if args.page:
        return fill_pages()
    # Warp allocates beside JAX, which otherwise takes most of the device's memory.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    content = (
        json.loads(args.json.read_text()) if args.json.exists() else {"runs": [], "records": []}
    )
    content["runs"].append(provenance.measurement(args.commit))
    platform = content["runs"][-1]["platform"]
    warp = content["runs"][-1]["warp"]
    for name in args.cases:
        file, effects, kinds, engines = CASES[name]
        chosen = scene.load(file, overrides={"effects": effects})
        # MuJoCo C would be measured on the host's cores, Warp's kernels are for GPUs.
        never = "mujoco" if platform == "gpu" else "warp"
        engines = [e for e in args.engines or engines if e != never and (e != "warp" or warp)]
        usual = WORLDS["cpu" if platform == "cpu" else "gpu"]
        sizes = args.worlds or usual.get(kinds[0], usual[""])
        for designs in kinds:
            for engine in engines:
                for count in sizes:
                    begin = time.perf_counter()
                    new = {"scene": name, "designs": designs, "engine": named(engine)}
                    new |= {"worlds": count, "run": len(content["runs"]) - 1}
                    new |= measure(chosen, designs, engine, count, args.calls)
                    content["records"] = replaced(content["records"], new)
                    output.write_json(args.json, content)
                    words = f"{new['grasps_per_s']} grasps/s, kept {new['kept']:.0%}"
                    took = time.perf_counter() - begin
                    print(name, designs, named(engine), count, words, f"({took:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
