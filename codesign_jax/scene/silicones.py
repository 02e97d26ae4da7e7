"""Silicones by name: law, modulus, density and damping, each with its source and interval.

A shear modulus belongs to a bending law, so that a name gives both.  `docs/measurements.md` has
these numbers as tables, which `tests/test_docs.py` compares with them.

>>> from codesign_jax.scene import silicones
>>> rubber = silicones.get("dragon_skin_10")
>>> rubber.law, rubber.shear_modulus, rubber.interval  # Pa
('neo_hookean', 88000.0, (88000.0, 101000.0))
>>> silicones.get("dragonskin")
Traceback (most recent call last):
codesign_jax.scene.schema.InputError: silicone 'dragonskin' unknown; valid: ...
"""

import dataclasses
from typing import Any, NamedTuple

from codesign_jax.scene import schema

LINEAR, NEO_HOOKEAN = LAWS = ("linear", "neo_hookean")
"""Bending laws of a wall, as `material.law` names them."""
PSI = 6894.757
"""A pound per square inch [Pa]."""
EQUAL_BEND = 1.776
"""Neo-Hookean over linear modulus of walls that bend alike: moments of the default section agree
best between 25 and 150 % of strain, see `scripts.reality.fitted_law`."""


class Silicone(NamedTuple):
    """A silicone.

    Attributes:
      name: What it is sold as.
      law: Bending law that `shear_modulus` belongs to, one of `LAWS`.
      shear_modulus: G [Pa].
      interval: Lowest and highest G that measurements give [Pa].
      source: Measurements behind G and its interval.
      density: Density of the mixed and cured rubber [kg/m^3].
      damping_time: Kelvin-Voigt damping time beta [s].
      damping_interval: Lowest and highest damping time measured [s]; None where nobody has.
      crosshead_modulus: Neo-Hookean G of the tension tests in docs/data/silicones.csv, whose strain
        is the crosshead's and so too large [Pa].
      modulus_100: Stress at 100 % of strain by the data sheet [psi].
      mix: Parts A and B by weight.
      pot_life: Time after mixing in which it pours [min], at 23 degrees Celsius as `cure_time`.
      cure_time: Time until it leaves the mould [h].
      shore: Hardness by the data sheet.
    """

    name: str
    law: str
    shear_modulus: float
    interval: tuple[float, float]
    source: str
    density: float
    damping_time: float
    damping_interval: tuple[float, float] | None
    crosshead_modulus: float
    modulus_100: float
    mix: tuple[float, float]
    pot_life: float
    cure_time: float
    shore: str

    @property
    def sheet_modulus(self) -> float:
        """Neo-Hookean G of the data sheet's stress at 100 %, G (2 - 1/4) [Pa]."""
        return self.modulus_100 * PSI / 1.75

    @property
    def damping_kind(self) -> str:
        """Whether the damping time is measured or chosen."""
        return "chosen" if self.damping_interval is None else "measured"


_BETWEEN = "between tension by crosshead strain (low) and data sheet (high); geometric mean"
_DAMPING = 3e-3  # Dragon Skin 10's, also where nobody measured: silicones' loss factors are alike

SILICONES = {
    "dragon_skin_10": Silicone(
        name="Dragon Skin 10 Medium",
        law=NEO_HOOKEAN,
        shear_modulus=88e3,
        interval=(88e3, 101e3),
        source="cantilever of ETH Zurich, drops and periods; data sheet 87 kPa",
        density=1070.0,
        # Its loss factor is 0.13 and 0.11 at 3.4 and 7.7 Hz, where beta is 6.2 and 2.4 ms.
        damping_time=_DAMPING,
        damping_interval=(2.4e-3, 6.2e-3),
        crosshead_modulus=56.8e3,
        modulus_100=22.0,
        mix=(1.0, 1.0),
        pot_life=20.0,
        cure_time=5.0,
        shore="10 A",
    ),
    "dragon_skin_20": Silicone(
        name="Dragon Skin 20",
        law=NEO_HOOKEAN,
        shear_modulus=175e3,
        interval=(158e3, 193e3),
        source=_BETWEEN,
        density=1080.0,
        damping_time=_DAMPING,
        damping_interval=None,
        crosshead_modulus=158e3,
        modulus_100=49.0,
        mix=(1.0, 1.0),
        pot_life=25.0,
        cure_time=4.0,
        shore="20 A",
    ),
    "dragon_skin_30": Silicone(
        name="Dragon Skin 30",
        law=NEO_HOOKEAN,
        shear_modulus=275e3,
        interval=(224e3, 339e3),
        source=_BETWEEN,
        density=1080.0,
        damping_time=_DAMPING,
        damping_interval=None,
        crosshead_modulus=224e3,
        modulus_100=86.0,
        mix=(1.0, 1.0),
        pot_life=45.0,
        cure_time=16.0,
        shore="30 A",
    ),
    "ecoflex_00_30": Silicone(
        name="Ecoflex 00-30",
        law=NEO_HOOKEAN,
        shear_modulus=27.6e3,
        interval=(25e3, 31e3),
        source="planar tension (plane strain) of EPFL to 125 %",
        density=1070.0,
        damping_time=_DAMPING,
        damping_interval=None,
        crosshead_modulus=15.8e3,
        modulus_100=10.0,
        mix=(1.0, 1.0),
        pot_life=45.0,
        cure_time=4.0,
        shore="00-30",
    ),
    "ecoflex_00_50": Silicone(
        name="Ecoflex 00-50",
        law=NEO_HOOKEAN,
        shear_modulus=32.4e3,
        interval=(22.2e3, 47.3e3),
        source=_BETWEEN,
        density=1070.0,
        damping_time=_DAMPING,
        damping_interval=None,
        crosshead_modulus=22.2e3,
        modulus_100=12.0,
        mix=(1.0, 1.0),
        pot_life=18.0,
        cure_time=3.0,
        shore="00-50",
    ),
}
"""Silicones by the names that `material` of a hand file takes."""

_GIVEN = ("law", "shear_modulus", "density", "damping_time")
"""Keys of `[material]` that a silicone's name stands for."""


def get(name: str) -> Silicone:
    """The silicone of a name, as `material` of a hand file has it.

    Raises:
      InputError: If there is none; the message lists those that there are.
    """
    if name not in SILICONES:
        raise schema.InputError.of("unknown", f"silicone {schema.shown(name)} {_unknown()}")
    return SILICONES[name]


def _unknown() -> str:
    names = ", ".join(SILICONES)
    return f"unknown; valid: {names}; another one has a law, and a shear_modulus that fits its data"


def prepare(table: dict[str, Any], changes: dict[tuple[str, ...], Any]) -> None:
    """Writes `material = NAME` as the table that it stands for, in a hand file and in changes.

    Where changes name a silicone, the file's own numbers of another one go.

    Args:
      table: A hand file's table; changed in place, as is the next.
      changes: Overrides by key path within it.
    """
    if isinstance(table.get("material"), str):
        table["material"] = {"silicone": table["material"]}
    if isinstance(changes.get(("material",)), str):
        changes["material", "silicone"] = changes.pop(("material",))
    material = table.get("material")
    if ("material", "silicone") in changes and isinstance(material, dict):
        for key in _GIVEN:
            material.pop(key, None)


def complete(table: dict[str, Any], where: str, problems: list[str]) -> None:
    """Gives a hand file's `[material]` the numbers of the silicone that it names.

    Law and modulus come together: both from the name, or both as numbers of the file's own, which
    are then those of a batch of that silicone.  Density and damping may stand beside a name.

    Args:
      table: The hand file's table, which is changed in place.
      where: Name of the file in messages.
    """
    material = table.get("material")
    if not isinstance(material, dict) or "silicone" not in material:
        return
    name = material["silicone"]
    path = f"{where}.material"
    known = isinstance(name, str) and name in SILICONES
    if not known:
        problems.append(
            schema.Problem("unknown", f"{path}.silicone = {schema.shown(name)} {_unknown()}")
        )
        material["silicone"] = name = next(iter(SILICONES))  # for the other problems of the file
    mine = SILICONES[name]
    pair = [key for key in ("shear_modulus", "law") if key in material]
    if known and len(pair) == 1:
        [key] = pair
        other = "law" if key == "shear_modulus" else "shear_modulus"
        sentence = (
            f"{path}.{key} = {schema.shown(material[key])} stands beside silicone = {name!r}, "
            f"which has {mine.shear_modulus / 1e3:g} kPa under the law {mine.law!r}: a modulus "
            f"belongs to its law; give {other} as well, or leave one of the two out"
        )
        problems.append(schema.Problem("conflict", sentence))
    for key in _GIVEN:
        material.setdefault(key, getattr(mine, key))


def law_problem(neo_hookean: bool | None, material: Any, where: str) -> str | None:
    """A warning if the scene's bending law differs from the law of the hand's modulus, or None.

    Args:
      neo_hookean: The scene's `effects.neo_hookean`; None where it leaves the law to the hand.
      material: The hand's `Material`.
      where: Name of the scene in messages.
    """
    if neo_hookean is None or material.law is None or of_law(material.law) == neo_hookean:
        return None
    source = f" (silicone {material.silicone!r})" if material.silicone else ""
    sentence = (
        f"{where}.effects.neo_hookean = {str(neo_hookean).lower()} stands against "
        f"hand.material.law = {material.law!r}{source}: a modulus belongs to its law; leave out "
        "effects.neo_hookean, or give hand.material.law and hand.material.shear_modulus"
    )
    return schema.Problem("conflict", sentence)


def under(scene: Any, *, neo_hookean: bool) -> Any:
    """A scene under a bending law, with the modulus of walls that bend alike if it is another one.

    Args:
      scene: A `Scene`; its numbers may be traced.
    """
    if scene.effects.neo_hookean == neo_hookean:
        return scene
    material = scene.hand.material
    factor = EQUAL_BEND if neo_hookean else 1 / EQUAL_BEND
    modulus = material.shear_modulus * factor
    law = LAWS[neo_hookean]
    material = dataclasses.replace(material, shear_modulus=modulus, law=law, silicone=None)
    return dataclasses.replace(
        scene,
        hand=dataclasses.replace(scene.hand, material=material),
        effects=dataclasses.replace(scene.effects, neo_hookean=neo_hookean),
    )


def of_law(law: str | None) -> bool:
    """Value of `effects.neo_hookean` for a law; without a law walls are linear."""
    return law == NEO_HOOKEAN
