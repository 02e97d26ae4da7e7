"""One process that goes on: many structures, many episodes, threads, Ctrl-C."""

import functools
import os
import random
import signal
import threading
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from scripts.faults import finished
from scripts.faults.bench import Bench
from scripts.faults.campaigns import Campaign
from scripts.faults.store import Result

_DATA = Path(__file__).parents[2] / "tests" / "data"
"""Two fingers and a sphere, which compile in half of the paper's time."""
MOST_MAPS = 30_000
"""Memory maps that a process of any number of structures stays below; Linux allows 65,530."""
_FLAGS = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
if metadata.version("jaxlib").startswith("0.10."):  # others end the process that has this flag
    _FLAGS += " --xla_cpu_use_fusion_emitters=false"
QUICK = (
    ("XLA_FLAGS", _FLAGS),
    ("CODESIGN_KERNEL_OPTIMIZATION", "0"),
    ("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0"),
)
"""Variables with which programs compile sooner: the number of maps is the same."""
_SHORT = {"inflate": 0.06, "lift": 0.08, "disturb": 0.1, "ungrasp": 0.12, "deflate_time": 0.01}


def _resources() -> dict[str, float]:
    """Memory maps, megabytes, file descriptors and threads of this process."""
    status = Path("/proc/self/status").read_text()
    values = {n: v.split() for n, _, v in (line.partition(":") for line in status.splitlines())}
    with open("/proc/self/maps") as file:
        maps = sum(1 for _ in file)
    return {
        "memory maps": maps,
        "MB": round(int(values["VmRSS"][0]) / 1024),
        "file descriptors": len(os.listdir("/proc/self/fd")),
        "threads": int(values["Threads"][0]),
    }


def _simulate(overrides: dict[str, Any], key: int = 0, **scene_of: Any) -> Any:
    """Outcomes of two designs in one trial of a scene.

    Args:
      overrides: Values of the scene.
      key: Root of the trial's noise.
      **scene_of: Hand and objects, as of `scene.load`.
    """
    import jax

    from codesign_jax import codesign, scene
    from codesign_jax.scene.parameters import design_space

    world = scene.load("paper_spheres", overrides=overrides, **scene_of)
    space = design_space(world.hand, "2d")
    evaluate = codesign.Task(world, space, 1).evaluate
    designs = np.repeat(np.asarray(space.default(), np.float32)[None], 2, 0)
    return jax.tree.map(np.asarray, evaluate(designs, jax.random.key(key)))


def structures(bench: Bench, number: int) -> Result:
    """A scene of another structure than all before: links and steps, which kernels are made for."""
    steps = {"approach": 0.04 + 0.01 * (number // 2)}
    phases = {k: v + 0.01 * (number // 2) for k, v in _SHORT.items() if k != "deflate_time"}
    overrides = {
        "discretization": {"links": 2 + number % 2},
        "phases": {**steps, **phases, "deflate_time": 0.01},
    }
    found = _simulate(overrides, hand_name=_DATA / "pinch.toml", object_set=_DATA / "sphere.toml")
    most = _resources()
    if not np.isfinite(found.cost).all():
        return Result("not finite", str(overrides), most=most)
    if most["memory maps"] > MOST_MAPS:
        return Result("too many maps", str(most), most=most)
    return Result("simulated", "", most=most)


_FIRST: dict[str, dict[str, float]] = {}


def alike(bench: Bench, number: int) -> Result:
    """A scene that differs from the others in its numbers only."""
    overrides = {"discretization": {"links": 3}, "gravity": 9.0 + 0.1 * number}
    _simulate(overrides)
    now = _resources()
    first = _FIRST.setdefault("alike", now)
    more = now["memory maps"] - first["memory maps"]
    word = "nothing new" if more < 100 else "more maps"
    return Result(word, str(now), most={"more memory maps": more})


def episodes(bench: Bench, number: int) -> Result:
    """A run of three hundred episodes: it keeps three steps, and nothing grows."""
    words = finished.arguments("filter", episodes="300")
    with bench.scratch() as scratch:
        bench.command(*finished.arguments("filter"), "--out", scratch / "short")
        before = _resources()
        said = bench.command(*words, "--out", scratch / "run")
        after = _resources()
        kept = len([*(scratch / "run" / "checkpoints").glob("*.sha256")])
        size = sum(p.stat().st_size for p in (scratch / "run" / "checkpoints").rglob("*"))
    most = {f"more {name}": after[name] - before[name] for name in before}
    most |= {"steps": kept, "kB": round(size / 1024)}
    grown = most["more MB"] > 200 or most["more file descriptors"] > 20
    grown = grown or most["more memory maps"] > 1000
    if said.code or said.traceback:
        return Result("failed", said.text, most=most)
    return Result("grown" if kept != 3 or grown else "flat", str(most), most=most)


@functools.cache
def _alone() -> list[bytes]:
    """What each thread is to find, by its number."""
    return [_simulate({"discretization": {"links": 3}}, k).cost.tobytes() for k in range(4)]


def threads(bench: Bench, number: int) -> Result:
    """Four threads simulate with one program at once: each finds what it would find alone."""
    expected, found, errors = _alone(), dict[tuple[int, int], bytes](), list[str]()

    def work(thread: int) -> None:
        try:
            for call in range(4):
                key = (thread + call + number) % 4
                cost = _simulate({"discretization": {"links": 3}}, key).cost
                found[thread, call] = cost.tobytes() if cost.tobytes() != expected[key] else b""
        except Exception as error:
            errors.append(repr(error))

    _together([functools.partial(work, k) for k in range(4)])
    wrong = [key for key, value in found.items() if value]
    if errors or wrong or len(found) != 16:
        return Result("wrong", f"{errors} {wrong}", {"calls": 16})
    return Result("same", "", {"calls": 16})


def compiling(bench: Bench, number: int) -> Result:
    """Three threads compile programs of different structures at once."""
    errors: list[str] = []

    def work(links: int) -> None:
        try:
            phases = {k: v + 0.01 * number for k, v in _SHORT.items() if k != "deflate_time"}
            phases |= {"approach": 0.05 + 0.01 * number, "deflate_time": 0.01}
            cost = _simulate({"discretization": {"links": links}, "phases": phases}).cost
            if not np.isfinite(cost).all():
                errors.append("not finite")
        except Exception as error:
            errors.append(repr(error))

    _together([functools.partial(work, links) for links in (2, 3, 4)])
    return Result("wrong", str(errors)) if errors else Result("simulated")


def _together(works: list[Any]) -> None:
    begun = [threading.Thread(target=work) for work in works]
    for thread in begun:
        thread.start()
    for thread in begun:
        thread.join()


def _stopped(bench: Bench, words: list[str], moment: float) -> Result:
    """A command that Ctrl-C ends, and the same command again in the same process."""
    timer = threading.Timer(moment, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        said = bench.command(*words)
        timer.cancel()
        timer.join()
    except KeyboardInterrupt:  # it came as the command had ended
        said = None
    if said is not None and (said.traceback or said.code not in (0, 130)):
        return Result("traceback", f"after {moment:.2f} s: status {said.code}: {said.text}")
    again = bench.command(*words)
    tally = {"stopped": int(said is not None and said.code == 130)}
    if again.code or again.traceback:
        return Result("blocked", f"after {moment:.2f} s: {again.text}", tally)
    return Result("again", "", tally)


def stopped(bench: Bench, number: int) -> Result:
    """Ctrl-C while `evaluate` simulates, then the same again."""
    words = ["evaluate", "--scene", "paper_spheres", *finished.LINKS, "--trials", "600"]
    if not number:
        bench.command(*words)
    return _stopped(bench, words, random.Random(f"stopped {number}").uniform(0.1, 3.0))


def stopped_compiling(bench: Bench, number: int) -> Result:
    """Ctrl-C while `evaluate` traces and compiles another structure, then the same again."""
    phases = [f"phases.{k}={v + 0.01 * number:.3f}" for k, v in _SHORT.items() if "def" not in k]
    phases += [f"phases.approach={0.05 + 0.01 * number:.3f}", "phases.deflate_time=0.01"]
    links = f"discretization.links={5 + number % 2}"
    words = ["evaluate", "--scene", "paper_spheres", "--trials", "1", "--set", links, *phases]
    return _stopped(bench, words, random.Random(f"compiling {number}").uniform(0.2, 6.0))


CAMPAIGNS = (
    Campaign(
        "structures",
        300,
        structures,
        "simulated",
        size=300,
        limit=300,
        alone=True,
        environment=QUICK,
    ),
    Campaign("alike", 8, alike, "nothing new", size=8, alone=True),
    Campaign("episodes", 1, episodes, "flat", limit=900),
    Campaign("threads", 10, threads, "same", size=10, tries="calls"),
    Campaign(
        "threads-compile",
        2,
        compiling,
        "simulated",
        size=2,
        limit=600,
        alone=True,
        environment=QUICK,
    ),
    Campaign("stopped", 8, stopped, "again", size=8, limit=300),
    Campaign(
        "stopped-compiling",
        12,
        stopped_compiling,
        "again",
        size=12,
        limit=600,
        alone=True,
        environment=(*QUICK, ("CODESIGN_CACHE", "off")),
    ),
)
