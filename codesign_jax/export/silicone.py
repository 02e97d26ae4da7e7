"""What a workshop must know of a hand's silicone; `scene.silicones` has the silicones."""

from codesign_jax.scene import silicones
from codesign_jax.scene.hand import Material
from codesign_jax.scene.silicones import Silicone

SOURCE = "the maker's technical bulletins (Smooth-On, Dragon Skin and Ecoflex series)"
"""Where mix, pot life and time of cure come from."""


def words(silicone: Silicone) -> str:
    """How a silicone is sold, mixed, poured and cured."""
    a, b = silicone.mix
    return (
        f"{silicone.name} (mix {a:g} A : {b:g} B by weight, pours for {silicone.pot_life:g} min, "
        f"leaves the mould after {silicone.cure_time:g} h at 23 °C [maker])"
    )


def of_material(material: Material) -> Silicone | None:
    """The silicone that a hand names, or None where its material is numbers alone."""
    return silicones.get(material.silicone) if material.silicone else None


def nearest(material: Material, *, neo_hookean: bool) -> Silicone:
    """The silicone whose walls bend most like the hand's, by the ratio of their moduli.

    Args:
      neo_hookean: Whether the hand's modulus belongs to the neo-Hookean law, as in its scene.
    """
    mine = material.shear_modulus
    if not neo_hookean:
        mine *= silicones.EQUAL_BEND  # the silicones' law is the neo-Hookean one

    def distance(other: Silicone) -> float:
        return max(mine / other.shear_modulus, other.shear_modulus / mine)

    return min(silicones.SILICONES.values(), key=distance)
