"""The cases of the study and their sizes."""

import dataclasses
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from scripts.accuracy import beam, decision, impulse, timing, tip
from scripts.accuracy.settings import (
    FINGERS,
    HULL,
    LINKS,
    PRESETS,
    REFERENCE,
    STANDARD,
    TIMESTEPS,
    Setting,
    one_at_a_time,
    own_limits,
    standard_of,
)
from scripts.accuracy.store import Case

PARTS = ("tip", "impulse", "decision", "time")


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is simulated.

    Attributes:
      name: Name.
      timesteps: Time steps of the reference [ms]: the reference and one that confirms it.
      links: Links of the reference.
      confirm_links: Links that confirm it.
      hands: Hands of the parts tip and impulse.
      seconds: Simulated time of the part tip.
      particles: Particles of a population.
      trials: Trials of a late particle at the presets.
      fewer: Trials of a late particle elsewhere.
      worlds: Worlds that are timed, by engine; on a GPU `gpu_worlds`.
      gpu_worlds: Worlds that are timed on a GPU.
      window: Time steps that are timed.
      repeats: Timed calls.
      finest: Shortest time step of a setting [ms].
      most_links: Most links of a setting.
    """

    name: str
    timesteps: tuple[float, float]
    links: int
    confirm_links: int
    hands: int
    seconds: float
    particles: int
    trials: int
    fewer: int
    worlds: dict[str, int]
    gpu_worlds: dict[str, int]
    window: int
    repeats: int
    finest: float = 1.0
    most_links: int = 40


_GPU = {"structured": 16_384, "mujoco": 96, "mjx": 1_728}
SIZES = {
    "full": Size(
        "full", (0.1, 0.05), 40, 80, 12, 2.4, 60, 200, 100,
        {"structured": 480, "mujoco": 60, "mjx": 12}, _GPU, 50, 5,
    ),
    "quick": Size(
        "quick", (0.5, 0.25), 20, 40, 3, 1.0, 12, 12, 12,
        {"structured": 240, "mujoco": 24, "mjx": 6}, _GPU, 50, 5, 2.0, 20,
    ),
    "tiny": Size(
        "tiny", (2.0, 1.0), 4, 5, 2, 0.3, 3, 3, 3,
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
        "impulse": _impulse,
        "decision": partial(_decision, data=data),
        "time": partial(_time, gpu=gpu),
    }
    found = [case for part in PARTS if part in parts for case in make[part](size, engines)]
    return list({case.key: case for case in found}.values())


def reference(size: Size, *, confirm: str = "") -> Setting:
    """Setting of the reference of the part tip, or one that confirms it.

    Args:
      size: Sizes.
      confirm: "timestep" for a halved step, "links" for more links.
    """
    step = size.timesteps[confirm == "timestep"]
    links = size.confirm_links if confirm == "links" else size.links
    return Setting("mujoco", timestep=step, links=links, damping="least", iterations=0)


def settings(size: Size, engine: str) -> list[Setting]:
    """Settings of an engine that a size affords."""
    base = standard_of(engine)
    if engine == "mjx":  # a minute of compilation each: the standard setting alone
        found = [base, replace(base, precision="float64"), replace(base, iterations=1)]
    else:
        found = one_at_a_time(engine)
    if size.name == "tiny":
        found = [replace(base, links=2), replace(base, links=2, timestep=20, keep_contact=True)]
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
        # In the air neither the surface nor its constants nor the limit of iterations matter.
        every = [replace(s, surface=HULL) for s in settings(size, engine)]
        every = [s for s in every if not s.extra and s.iterations is None]
        if engine == "structured":  # the same equations as MuJoCo C: their rounding is what is new
            every = [every[0], Setting(precision="float64"), PRESETS["reference"]]
        for setting in dict.fromkeys(every):
            if _affordable(size, setting):
                add(setting)
    if tiny:
        return found
    limit = reference(size)
    for step in TIMESTEPS:  # the error of time alone, and that of links alone
        for damping in ("least", "added"):
            add(replace(limit, timestep=step, damping=damping), "at the reference's links")
    for links in LINKS:
        if links < size.links:
            add(replace(limit, links=links), "at the reference's time step")
    return found


def _tips(setting: Setting, size: Size) -> dict[str, Any]:
    tips = tip.motion(setting, size.hands, size.seconds)
    return {"tips_mm": [round(1e3 * float(v), 5) for v in tips[:, ::TIP_STRIDE].ravel()]} | {
        "shape": list(tips[:, ::TIP_STRIDE].shape)
    }


TIP_STRIDE = 5
"""Every so many of the compared states are kept: ten a second."""


def _impulse(size: Size, engines: Sequence[str]) -> list[Case]:
    """Of the hull: engines without it have no such force."""
    if "structured" not in engines:
        return []
    step, finer = size.timesteps
    limit = Setting(
        timestep=step, links=min(20, size.links), damping="least", iterations=0, precision="float64"
    )
    found = [(limit, ("reference",)), (replace(limit, timestep=finer), ("timestep",))]
    every = settings(size, "structured")
    found += [(s, ()) for s in every if s.surface.startswith("hull") and FINGERS not in s.extra]
    return [Case("impulse", s, more, partial(_forces, s, size.hands)) for s, more in found]


def _forces(setting: Setting, hands: int) -> dict[str, Any]:
    return impulse.summary(*impulse.forces(setting, hands))


def _decision(size: Size, engines: Sequence[str], *, data: Path) -> list[Case]:
    """A setting's populations together: they share its program."""
    found = []

    def add(setting: Setting, *asked: tuple[str, int, bool]) -> None:
        run = partial(_decide, setting, asked, size, data)
        words = [f"{n} {trials}" + " moved" * moved for n, trials, moved in asked]
        found.append(Case("decision", setting, tuple(words), run))

    for setting in _decided(size) if "structured" in engines else ():
        preset = setting in PRESETS.values()
        asked = [("late", size.trials if preset else size.fewer, False)]
        usual = setting.iterations is None and setting.axes == 3
        if preset or (setting.work <= 20 and usual):
            asked.append(("late", size.fewer, True))
        if setting.work <= 20 and not setting.wide:
            asked.append(("spread", size.fewer, False))
        if preset:
            asked.append(("spread", size.fewer, True))
        add(setting, *asked)
    if "mujoco" in engines:
        few = max(1, size.fewer // 16)
        add(standard_of("mujoco"), ("spread", few, False), ("spread", few, True))
        add(replace(standard_of("mujoco"), timestep=max(1.0, size.finest)), ("spread", few, False))
    return found


def _decided(size: Size) -> list[Setting]:
    """Settings of the part decision, those that take longest first."""
    found = settings(size, "structured")
    if size.name == "full":
        found += [s for knob in own_limits().values() for s in knob]
        found += [replace(STANDARD, iterations=0), replace(REFERENCE, timestep=1.0)]
        found += [REFERENCE, replace(REFERENCE, precision="float32", links=40)]
    return sorted(dict.fromkeys(found), key=lambda s: -s.work)


def _decide(setting: Setting, asked: Sequence[tuple], size: Size, data: Path) -> dict[str, Any]:
    every = decision.populations(data, size.particles)
    requests = [decision.Request(name, every[name], *rest) for name, *rest in asked]
    return decision.simulate(setting, requests, size.fewer)


def _time(size: Size, engines: Sequence[str], *, gpu: bool) -> list[Case]:
    batch = size.gpu_worlds if gpu else size.worlds
    found: list[tuple[Setting, list[Setting]]] = []
    every = settings(size, "structured")
    if size.name != "tiny":  # a preset's cost is wanted at every size
        every += PRESETS.values()
    if "structured" in engines:
        for setting in dict.fromkeys(every):
            if setting.precision == "float32" and not setting.keep_contact:
                wide = [replace(setting, precision="float64")] * (setting == every[0])
                found.append((setting, [setting, *wide]))
    for setting in settings(size, "mujoco") if "mujoco" in engines else ():
        # Beside our own spheres: the others have no hull.
        if not setting.keep_contact and not setting.extra:
            mine = [replace(setting, engine="structured")] * ("structured" in engines)
            more = [setting] + [replace(setting, engine="mjx")] * (
                "mjx" in engines and setting == standard_of("mujoco")
            )
            found.append((setting, mine + more))
    return [
        Case("time", setting, tuple(timing.name(s) for s in each),
             partial(timing.measure, each, batch, size.window, size.repeats))
        for setting, each in found
    ]  # fmt: skip
