"""The cases of the study and their sizes."""

import dataclasses
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scripts.accuracy import beam, decision, impulse, steps, timing, tip
from scripts.accuracy.settings import (
    HULL,
    LINKS,
    PRESETS,
    STANDARD,
    TIMESTEPS,
    Setting,
    one_at_a_time,
    sweep,
)
from scripts.accuracy.store import Case

PARTS = ("tip", "step", "impulse", "decision", "time")


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is simulated.

    Attributes:
      name: Name.
      timesteps: Time steps of the reference [ms]: the reference and one that confirms it.
      links: Links of the reference.
      confirm_links: Links that confirm it.
      hands: Hands of the parts tip, step and impulse.
      seconds: Simulated time of the part tip.
      states: States of each hand in the part step.
      particles: Particles of a population.
      trials: Trials of a particle.
      block: Trials of a case of MuJoCo C.
      worlds: Worlds that are timed, by engine; on a GPU `gpu_worlds`.
      gpu_worlds: Worlds that are timed on a GPU.
      window: Time steps that are timed.
      repeats: Timed calls.
      finest: Shortest time step of a setting [ms].
      most_links: Most links of a setting.
      engines: Engines of the parts tip, step and impulse besides MuJoCo C.
    """

    name: str
    timesteps: tuple[float, float]
    links: int
    confirm_links: int
    hands: int
    seconds: float
    states: int
    particles: int
    trials: int
    block: int
    worlds: dict[str, int]
    gpu_worlds: dict[str, int]
    window: int
    repeats: int
    finest: float = 1.0
    most_links: int = 40


_GPU = {"structured": 16_384, "mujoco": 96, "mjx": 1_728}
SIZES = {
    "full": Size(
        "full", (0.1, 0.05), 40, 80, 12, 2.4, 40, 60, 24, 6,
        {"structured": 480, "mujoco": 60, "mjx": 12}, _GPU, 50, 5,
    ),
    "quick": Size(
        "quick", (0.5, 0.25), 20, 40, 3, 1.0, 8, 12, 6, 6,
        {"structured": 240, "mujoco": 24, "mjx": 6}, _GPU, 50, 5, 2.0, 20,
    ),
    "tiny": Size(
        "tiny", (2.0, 1.0), 4, 5, 2, 0.3, 2, 3, 3, 3,
        {"structured": 4, "mujoco": 4, "mjx": 4}, _GPU, 3, 2, 5.0, 3,
    ),
}  # fmt: skip


def cases(
    size: Size, parts: Sequence[str], engines: Sequence[str], data: Path, *, gpu: bool
) -> list[Case]:
    """The cases of a study, the most telling ones first.

    Args:
      size: Sizes.
      parts: Some of `PARTS`.
      engines: Some of `ENGINES`.
      data: Folder with the particles of the reproduction.
      gpu: Whether the structured engine runs on a GPU.
    """
    make = {
        "tip": _tip,
        "step": _step,
        "impulse": _impulse,
        "decision": partial(_decision, data=data),
        "time": partial(_time, gpu=gpu),
    }
    found = [case for part in PARTS if part in parts for case in make[part](size, engines)]
    return list({case.key: case for case in found}.values())


def reference(size: Size, *, confirm: str = "") -> Setting:
    """Setting of the reference of the parts tip and impulse, or one that confirms it.

    Args:
      size: Sizes.
      confirm: "timestep" for a halved step, "links" for more links.
    """
    step = size.timesteps[confirm == "timestep"]
    links = size.confirm_links if confirm == "links" else size.links
    return Setting("mujoco", timestep=step, links=links, iterations=0)


def settings(size: Size, engine: str) -> list[Setting]:
    """Settings of an engine that a size affords."""
    if engine == "mjx":  # a minute of compilation each: the standard setting alone
        found = [Setting("mjx"), Setting("mjx", precision="float64"), Setting("mjx", iterations=1)]
    else:
        found = one_at_a_time(engine)
    if size.name == "tiny":
        found = [Setting(engine, links=2), Setting(engine, links=2, timestep=20, keep_contact=True)]
    return list(dict.fromkeys(s for s in found if _affordable(size, s)))


def _affordable(size: Size, setting: Setting) -> bool:
    return setting.timestep >= size.finest and setting.links <= size.most_links


def _references(size: Size) -> list[tuple[Setting, str]]:
    return [(reference(size, confirm=c), c or "reference") for c in ("", "timestep", "links")]


def _tip(size: Size, engines: Sequence[str]) -> list[Case]:
    found = []

    def add(setting: Setting, *more: str) -> None:
        found.append(Case("tip", setting, more, partial(_tips, setting, size)))

    tiny = size.name == "tiny"
    for links in LINKS[:2] if tiny else LINKS:
        run = partial(beam.errors, links, (1.0, 10.0), (90.0, 180.0))
        found.append(Case("beam", Setting("mujoco", links=links), (), run))
    for setting, role in _references(size):
        add(setting, role)
    for engine in ("mujoco", *(e for e in engines if e == "structured")):
        every = settings(size, engine)
        if engine == "structured":  # the same equations as MuJoCo C: their rounding is what is new
            every = [s for s in every if s in (every[0], Setting(precision="float64"))]
            every += [Setting(timestep=size.finest, links=min(20, size.most_links))]
        for setting in every:
            # In the air neither spheres nor the limit of iterations matter.
            if setting.spheres == 1 and setting.iterations is None:
                add(setting)
    if tiny:
        return found
    for step in TIMESTEPS:  # the error of time alone, and that of links alone
        add(Setting("mujoco", timestep=step, links=size.links), "at the reference's links")
    for links in LINKS:
        if links < size.links:
            fine = Setting("mujoco", timestep=size.timesteps[0], links=links)
            add(fine, "at the reference's time step")
    return found


def _tips(setting: Setting, size: Size) -> dict[str, Any]:
    tips = tip.motion(setting, size.hands, size.seconds)
    return {"tips_mm": [round(1e3 * float(v), 5) for v in tips[:, ::TIP_STRIDE].ravel()]} | {
        "shape": list(tips[:, ::TIP_STRIDE].shape)
    }


TIP_STRIDE = 5
"""Every so many of the compared states are kept: ten a second."""


def _step(size: Size, engines: Sequence[str]) -> list[Case]:
    found = []
    for engine in engines:
        every = settings(size, engine)
        # What the error of a step depends on is the solver; discretizations share its equations.
        base = every[0]
        kept = [s for s in every if replace(s, iterations=None, precision="float32") == base]
        kept += [replace(base, iterations=0, precision="float64")] * (engine == "structured")
        kept += [s for s in every if (s.timestep, s.links) in ((1.0, 20), (10.0, 5), (10.0, 20))]
        found += [
            Case("step", s, (), partial(steps.measure, s, size.hands, size.states))
            for s in dict.fromkeys(kept)
        ]
    return found


def _impulse(size: Size, engines: Sequence[str]) -> list[Case]:
    found = [(s, (role,)) for s, role in _references(size) if role != "links"]
    for engine in ("mujoco", *(e for e in engines if e == "structured")):
        every = settings(size, engine)
        if engine == "structured":
            # MuJoCo C's error stands for the rest; it has no hull.
            every = [s for s in every if s in (every[0], Setting(precision="float64"), HULL)]
        found += [(s, ()) for s in every]
    return [
        Case("impulse", s, more, partial(_forces, s, size.hands)) for s, more in found
    ]  # fmt: skip


def _forces(setting: Setting, hands: int) -> dict[str, Any]:
    return impulse.summary(*impulse.forces(setting, hands))


def _decision(size: Size, engines: Sequence[str], *, data: Path) -> list[Case]:
    found = []

    def add(setting: Setting, first: int, trials: int, *more: str) -> None:
        names = POPULATIONS if setting.engine == "structured" else POPULATIONS[:1]
        moved = MOVED in more
        run = partial(_decide, setting, names, first, trials, size.particles, data, moved)
        more = (" and ".join(names), f"trials {first} to {first + trials - 1}", *more)
        found.append(Case("decision", setting, more, run))

    if "structured" in engines:
        every = settings(size, "structured")
        if size.name == "full":
            every += [Setting(timestep=0.5, links=40), Setting(timestep=2.0, links=40)]
            every += sweep(STANDARD, iterations=(0,))
        add(every[0], 0, size.trials)
        add(every[0], 0, size.trials, MOVED)
        for setting in every[1:]:
            add(setting, 0, size.trials)
    if "mujoco" in engines:
        base = settings(size, "mujoco")[0]
        blocks = range(0, size.trials, size.block)
        for more in ((), (MOVED,)):
            for first in blocks:
                add(base, first, size.block, *more)
        fast = Setting("mujoco", links=5, spheres=2)
        fine = Setting("mujoco", timestep=1.0, links=20)
        for setting in (s for s in (fast, fine) if _affordable(size, s)):
            for first in blocks[:2]:  # a fine grasp costs twenty of the standard ones
                add(setting, first, size.block)
    return found


POPULATIONS = ("spread", "late")
MOVED = "moved 1 um"


def _decide(setting, names, first, trials, particles, data, moved) -> dict[str, Any]:
    every = decision.populations(data, particles)
    designs = np.concatenate([every[n] for n in names])
    found = decision.simulate(setting, designs, first, trials, moved=moved)
    return found | {"populations": list(names)}


def _time(size: Size, engines: Sequence[str], *, gpu: bool) -> list[Case]:
    batch = size.gpu_worlds if gpu else size.worlds
    found, timed = [], [e for e in engines if e != "mjx"]
    every = settings(size, "structured")
    if size.name != "tiny":  # a preset's cost is wanted at every size
        every = list(dict.fromkeys([*every, *PRESETS.values()]))
    for setting in every:
        if setting.precision == "float64" or setting.keep_contact:
            continue
        each = [replace(setting, engine=e) for e in timed]
        if setting.extra:
            each = [s for s in each if s.engine == "structured"]
        if not each:
            continue
        if setting == settings(size, "structured")[0]:
            each += [replace(setting, engine=e) for e in engines if e == "mjx"]
            if "structured" in engines:
                each.append(replace(setting, precision="float64"))
        run = partial(timing.measure, each, batch, size.window, size.repeats)
        found.append(Case("time", setting, tuple(timing.name(s) for s in each), run))
    return found
