"""The effects of a scene, and the engines that simulate each.

Effects are static: one that is off has no joint, contact or branch in the compiled program.  An
engine that cannot do what a scene asks for refuses the scene when it is built.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from codesign_jax.scene.schema import InputError, Problem

ENGINES = ("structured", "mujoco", "mjx")
"""Names of the engines; `engines.make_engine` builds them."""


class Effect(NamedTuple):
    """An effect's description."""

    meaning: str  # what is simulated, in a line
    # Why an engine cannot do a value of the effect, by engine and value
    refused: Mapping[str, Mapping[Any, str]] = {}
    hull: bool = False  # whether it acts with the surface "hull" alone
    # What the model is like that `codesign export` writes for plain MuJoCo, which lacks the effect
    plain: str = ""


_PRESCRIBED = (
    "MuJoCo's bodies that move as prescribed stand still to contacts, and the heavy wrist that "
    "replaces one needs float64"
)

_SKIN = "its geoms are rigid parts of single bodies"

_SPRINGS = "the springs of its joints are constants of a rollout"

EFFECTS: Mapping[str, Effect] = {
    "lateral_bending": Effect("fingers bend sideways"),
    "twist": Effect("fingers twist about their length"),
    "wrist": Effect(
        "compliant wrist; without it the palm is at the arm frame",
        {"mjx": {False: _PRESCRIBED}},
    ),
    "finger_object": Effect("fingers touch the object"),
    "palm_object": Effect("the palm touches the object"),
    "finger_table": Effect("fingers touch the table"),
    "palm_table": Effect("the palm touches the table"),
    "object_table": Effect("the object rests on the table"),
    "table": Effect("the plane z = 0; without it hand and object touch only the scene's fixtures"),
    "finger_finger": Effect("fingers touch one another"),
    "finger_palm": Effect("fingers touch the palm's disc"),
    "finger_itself": Effect("fingers touch themselves, with the hull", hull=True),
    "surface": Effect(
        "contact surface of the fingers: spheres, or the hull of the whole finger",
        {"mjx": {"hull": _SKIN}, "mujoco": {"hull": _SKIN}},
    ),
    "friction": Effect(
        "friction of all contacts: none or coulomb",
        {"mjx": {"none": "MJX has no frictionless contacts with elliptic cones"}},
    ),
    "friction_memory": Effect(
        "with the hull, held contacts do not creep: friction is kept from step to step",
        hull=True,
        plain="held contacts creep",
    ),
    "disturb": Effect("the arm is shaken after the lift"),
    "ungrasp": Effect("the fingers release the object at the end"),
    "neo_hookean": Effect(
        "rubber at large strain: fingers soften as they bend; if not set, the bending law of the "
        "hand's material applies",
        plain="joints have the linear bending law, with the modulus that bends walls equally",
    ),
    "lateral_threshold": Effect(
        "pressure resists sideways bending up to a moment",
        {"mujoco": {True: _SPRINGS}, "mjx": {True: _SPRINGS}},
        plain="pressure does not resist sideways bending",
    ),
    "pressure_dynamics": Effect("chambers fill with a lag, within the limits of the supply"),
    "air_mass": Effect(
        "valves meter the mass of air: its pressure falls as a chamber grows",
        {"mujoco": {True: _SPRINGS}, "mjx": {True: _SPRINGS}},
        plain="pressures equal the commands, whatever the volumes of the chambers",
    ),
    "section_growth": Effect(
        "with the hull, sections of fingers grow with their pressure",
        hull=True,
        plain="sections keep their size under pressure",
    ),
    "gravity": Effect("everything has weight"),
}


def refusals(effects: Any, engine: str) -> dict[str, str]:
    """Returns why an engine cannot do a scene's effects, by effect; empty if it can."""
    values = dataclasses.asdict(effects)
    reasons = {name: EFFECTS[name].refused.get(engine, {}).get(v) for name, v in values.items()}
    return {name: reason for name, reason in reasons.items() if reason}


def refuse(effects: Any, engine: str) -> None:
    """Checks that an engine can do what a scene asks for."""
    problems = []
    for name, reason in refusals(effects, engine).items():
        able = [e for e in ENGINES if name not in refusals(effects, e)]
        sentence = (
            f"not supported by engine {engine}: effects.{name} = {setting(effects, name)} "
            f"({reason}); use engine {' or '.join(able)}"
        )
        problems.append(Problem("unsupported", sentence))
    if problems:
        raise InputError(problems)


def setting(effects: Any, name: str) -> str:
    """An effect's value as in a scene file."""
    value = getattr(effects, name)
    return str(value).lower() if isinstance(value, bool) else repr(value).replace("'", '"')


def state(effects: Any, name: str, engine: str) -> str:
    """An effect in a scene and an engine: on, off, the model chosen, unsupported, or no hull."""
    refused = refusals(effects, engine)
    if name in refused:
        return f"unsupported ({setting(effects, name)})"
    if EFFECTS[name].hull and "surface" in refused:
        return "no hull"
    value = getattr(effects, name)
    return {True: "on", False: "off"}.get(value, str(value))
