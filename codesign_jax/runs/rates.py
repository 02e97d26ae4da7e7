"""How long grasps will take, from rates that were measured earlier; nothing is simulated for it.

The commands that simulate many grasps add their rate and compile time to a file in the user's
cache. Where none fits, rates measured for docs/performance.md stand in.
"""

import contextlib
import dataclasses
import datetime
import hashlib
import json
import math
import os
import statistics

import jax

from codesign_jax import caches, files
from codesign_jax.runs.scene_files import scene_texts
from codesign_jax.runs.settings import Settings
from codesign_jax.scene import Scene

_KEPT = 200


@dataclasses.dataclass(frozen=True)
class Work:
    """What a rate depends on.

    Attributes:
      engine: Engine.
      device: What it computes on, e.g. "cpu x2".
      contacts: The kinds of contact that cost differently: "spheres" or "hull" of the fingers,
        "+fingers" with contact between them, "+meshes" with mesh objects.
      steps: Time steps of a grasp.
      links: Links of all fingers.
      grasps: Grasps simulated at once.
      scene: Digest of the scene.
      structure: Digest of what of the scene programs are compiled for.
    """

    engine: str
    device: str
    contacts: str
    steps: int
    links: int
    grasps: int
    scene: str = ""
    structure: str = ""


@dataclasses.dataclass(frozen=True)
class Rate:
    """A measurement.

    Attributes:
      work: What was simulated.
      grasps_per_second: Wall time of whole episodes, saving included.
      compile_seconds: Tracing and compiling, or loading what had been compiled before; None if it
        was not measured.
      source: When or where it was measured.
    """

    work: Work
    grasps_per_second: float
    compile_seconds: float | None
    source: str


@dataclasses.dataclass(frozen=True)
class Estimate:
    """An estimate of a run and what it is based on.

    Attributes:
      grasps_per_second: Expected rate.
      compile_seconds: Expected time before the first grasp, None if it is not known.
      basis: The measurement that it comes from, in words.
    """

    grasps_per_second: float
    compile_seconds: float | None
    basis: str


_ELSEWHERE = "measured on another machine, docs/performance.md"


def _shipped(
    engine: str, device: str, grasps: int, rate: float, seconds: float | None, kind: str = "spheres"
) -> Rate:
    return Rate(Work(engine, device, kind, 900, 40, grasps), rate, seconds, _ELSEWHERE)


# Two cores of an AMD EPYC and one H200: docs/performance.md has the same numbers and how they were
# measured; compile times of the default scene are those of docs/data/gpu_suite_h200.json.
_REFERENCE = (
    _shipped("structured", "cpu x2", 60, 498.4, 4.9),
    _shipped("structured", "cpu x2", 60, 60.6, None, "hull+fingers"),
    _shipped("structured", "gpu x1", 1728, 877.5, 10.0, "hull+fingers"),
    _shipped("mujoco", "cpu x2", 60, 11.1, 1.6),
    _shipped("mjx", "cpu x2", 12, 0.08, 43.9),
    _shipped("structured", "gpu x1", 1728, 7154.0, 10.3),
)


def work(scene: Scene, settings: Settings, *, runs: int = 1, devices: int | None = None) -> Work:
    """What an episode is, on this machine.

    Args:
      scene: The scene.
      settings: Settings of a run.
      runs: Runs that are simulated at once.
      devices: Devices that simulate; None for all.
    """
    grasps = settings.particles * settings.trials * runs
    return batch_work(scene, settings.engine, grasps, devices=devices)


def batch_work(scene: Scene, engine: str, grasps: int, *, devices: int | None = None) -> Work:
    """What grasps simulated at once are, on this machine.

    Args:
      scene: The scene.
      engine: Name of the engine.
      grasps: How many.
      devices: Devices that simulate; None for all.
    """
    e, meshes = scene.effects, any(shape.mesh for shape in scene.objects.object)
    parts = [str(e.surface), *["fingers"] * bool(e.finger_finger), *["meshes"] * meshes]
    return Work(
        engine,
        _device(engine, devices),
        "+".join(parts),
        scene.num_steps,
        scene.num_fingers * scene.discretization.links,
        grasps,
        _digest(scene),
        _digest(scene.structure),
    )


def _digest(scene: Scene) -> str:
    texts = "".join(scene_texts(scene).values())
    return hashlib.sha256(texts.encode()).hexdigest()[:16]


def _device(engine: str, devices: int | None) -> str:
    platform = "cpu" if engine == "mujoco" else jax.default_backend()
    if platform != "cpu":
        return f"{platform} x{devices or jax.local_device_count()}"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"cpu x{cores or 1}"


def keep(work: Work, grasps_per_second: float, compile_seconds: float) -> None:
    """Keeps a measurement in the user's cache; one that cannot be written is left out."""
    today = datetime.date.today().isoformat()
    entry = Rate(work, grasps_per_second, compile_seconds, f"measured on this machine on {today}")
    if not caches.enabled():
        return
    kept = [r for r in measured() if r.work != work][-_KEPT + 1 :]
    with contextlib.suppress(OSError), files.atomically(_path()) as part:
        content = [dataclasses.asdict(r) for r in [*kept, entry]]
        part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def measured() -> list[Rate]:
    """The user's measurements, oldest first; a damaged file counts as none."""
    if not caches.enabled():
        return []
    try:
        stored = json.loads(_path().read_text(encoding="utf-8"))
        return [Rate(**(entry | {"work": Work(**entry["work"])})) for entry in stored]
    except (OSError, ValueError, TypeError, KeyError):
        return []


def estimate(work: Work) -> Estimate | None:
    """Scales the most similar measurement; None if nothing like it was ever measured.

    Rates go with the steps and the links of a grasp (docs/performance.md has exponents near one),
    on CPUs with the cores, and on GPUs with the grasps at once of each up to the measured number.
    """
    same = [r for r in measured() if _alike(r.work, work) and r.work.device == work.device]
    kind = work.device.split(" ")[0]
    shipped = [r for r in _REFERENCE if _alike(r.work, work) and r.work.device.startswith(kind)]
    if not same and not shipped:
        return None
    best = min(same or shipped, key=lambda r: _distance(r.work, work))
    rate = best.grasps_per_second * (best.work.steps * best.work.links) / (work.steps * work.links)
    if kind == "cpu":
        rate *= _count(work.device) / _count(best.work.device)
    else:
        devices = _count(work.device) / _count(best.work.device)
        rate *= devices * min(1.0, work.grasps / devices / best.work.grasps)
    basis = f"{best.grasps_per_second:.3g} grasps/s {_at(best)}"
    if dataclasses.replace(best.work, scene=work.scene, structure=work.structure) != work:
        basis += ", scaled to these steps, links and batch"
    return Estimate(rate, _compile_seconds(same or shipped, work), basis)


def seconds(work: Work) -> float | None:
    """Expected time of so many grasps at once, with compiling or loading; None if not known."""
    found = estimate(work)
    if found is None or found.compile_seconds is None:
        return None
    return found.compile_seconds + work.grasps / found.grasps_per_second


def _compile_seconds(alike: list[Rate], work: Work) -> float | None:
    """Time to compile or load: the program's own last one, or the median of others'.

    Single measurements are no guide: a computer that is busy with something else takes many times
    as long.
    """
    times = [(r, r.compile_seconds) for r in alike if r.compile_seconds is not None]
    own = [seconds for r, seconds in times if _program(r.work) == _program(work)]
    if own:
        return own[-1]
    return statistics.median(seconds for _, seconds in times) if times else None


def _at(rate: Rate) -> str:
    w = rate.work
    sizes = f"{w.steps} steps, {w.links} links, {w.grasps} grasps at once, {w.device}"
    return f"({rate.source}: {sizes})"


def _alike(a: Work, b: Work) -> bool:
    return (a.engine, a.contacts) == (b.engine, b.contacts)


def _program(work: Work) -> tuple:
    """What a compiled program depends on; scenes that differ in numbers alone share it."""
    return work.structure, work.grasps, work.engine, work.device


def _distance(a: Work, b: Work) -> float:
    """How far apart two pieces of work are, in octaves of size; another scene counts as one."""
    pairs = ((a.steps, b.steps), (a.links, b.links), (a.grasps, b.grasps))
    return sum(abs(math.log2(x / y)) for x, y in pairs) + (a.scene != b.scene)


def _count(device: str) -> int:
    return int(device.rsplit("x", 1)[1])


def _path():
    return caches.folder() / "rates.json"
