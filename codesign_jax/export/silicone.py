"""What a workshop must know of a silicone: how it is sold, mixed, poured and cured."""

from typing import NamedTuple

from codesign_jax.scene.hand import Material


class Silicone(NamedTuple):
    """A silicone as it is worked."""

    name: str  # what it is sold as
    mix: tuple[float, float]  # parts A and B by weight
    pot_life: float  # time after mixing in which it pours [min], at 23 degrees
    cure_time: float  # time until it leaves the mould [h], at 23 degrees
    shear_modulus: float  # G under the linear law [Pa], docs/measurements.md

    def __str__(self) -> str:
        a, b = self.mix
        return (
            f"{self.name} (mix {a:g} A : {b:g} B by weight, pours for {self.pot_life:g} min, "
            f"leaves the mould after {self.cure_time:g} h at 23 °C)"
        )


SOURCE = "the maker's technical bulletins (Smooth-On, Dragon Skin and Ecoflex series)"
"""Where mix, pot life and time of cure come from."""
SILICONES = {
    "dragon_skin_10": Silicone("Dragon Skin 10 Medium", (1, 1), 20, 5, 31.9e3),
    "dragon_skin_20": Silicone("Dragon Skin 20", (1, 1), 25, 4, 88.8e3),
    "dragon_skin_30": Silicone("Dragon Skin 30", (1, 1), 45, 16, 126e3),
    "ecoflex_00_30": Silicone("Ecoflex 00-30", (1, 1), 45, 4, 8.9e3),
    "ecoflex_00_50": Silicone("Ecoflex 00-50", (1, 1), 18, 3, 12.6e3),
}


def of_material(material: Material) -> Silicone | None:
    """The silicone that a hand names, or None where its material is numbers alone."""
    return SILICONES.get(getattr(material, "silicone", None) or "")


def nearest(material: Material) -> Silicone:
    """The silicone whose modulus is nearest to the hand's, by their ratio."""
    mine = material.shear_modulus

    def distance(other: Silicone) -> float:
        return max(mine / other.shear_modulus, other.shear_modulus / mine)

    return min(SILICONES.values(), key=distance)
