"""The section of a finger: stiffness, mass and moment of pressure of a beam, and its strain.

Section frame: y = height above the inextensible bottom layer, z = width, x along the finger.  The
outer section is width x height with walls of equal thickness around one air chamber.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax


class Beam(NamedTuple):
    """Properties of a finger as a beam; every entry has the shape of the section's dimensions.

    Attributes:
      bending: Stiffness EI_b about the inextensible bottom layer [N m^2].
      lateral: Stiffness EI_lat about the side on which the fabric is taut [N m^2].
      torsion: Stiffness G J [N m^2].
      line_density: Mass per length [kg/m].
      moment_per_pressure: Bending moment per gauge pressure A_c y_c [m^3].
    """

    bending: jax.Array
    lateral: jax.Array
    torsion: jax.Array
    line_density: jax.Array
    moment_per_pressure: jax.Array


def beam(
    height: jax.Array, wall: jax.Array, *, width: float, shear_modulus: float, density: float
) -> Beam:
    """Returns the beam properties of a rectangular hollow section.

    Args:
      height: Outer height h [m], any shape; h > 2 wall.
      wall: Wall thickness d [m], same shape.
      width: Outer width w [m]; w > 2 wall.
      shear_modulus: G of the silicone [Pa].
      density: rho of the silicone [kg/m^3].

    Returns:
      The properties, with
        EI_b = 4 G [w h^3 - w_c ((h-d)^3 - d^3)] / 3: second moment about the bottom layer,
        EI_lat = 4 G [I_z + A (w/2)^2]: the fabric resists tension only, so the neutral axis is the
        side, G J with J = 4 A_m^2 d / U (Bredt, thin wall; thick walls are up to 25 % stiffer),
        M_p / p = A_c h/2 by virtual work, independent of curvature and load.
    """
    h = height
    d = wall
    w = width
    chamber_width = w - 2 * d
    chamber_height = h - 2 * d
    chamber_area = chamber_width * chamber_height
    area = w * h - chamber_area
    second_moment = (w * h**3 - chamber_width * ((h - d) ** 3 - d**3)) / 3
    lateral_centroid = (h * w**3 - chamber_height * chamber_width**3) / 12
    lateral_moment = lateral_centroid + area * (w / 2) ** 2
    middle_area = (w - d) * (h - d)
    perimeter = 2 * (w + h - 2 * d)
    torsion_constant = 4 * middle_area**2 * d / perimeter
    return Beam(
        bending=4 * shear_modulus * second_moment,
        lateral=4 * shear_modulus * lateral_moment,
        torsion=shear_modulus * torsion_constant,
        line_density=density * area,
        moment_per_pressure=chamber_area * h / 2,
    )


def softening(curvature: Any, height: Any, wall: Any, *, width: Any) -> Any:
    """Share of the linear bending moment that a neo-Hookean section lacks at large curvature.

    With the stretch lambda = 1 + kappa y of a fibre at height y above the inextensible layer, held
    in plane strain by the threads, a neo-Hookean wall carries the moment
      M(kappa) = G int (lambda - lambda^-3) y dA = E I kappa (1 - s(kappa)).
    The integral over a block of width b from 0 to y is, with e = kappa y,
      b y^3 kappa (4/3 - r(e)),  r(e) = e (3 + 2 e) / (2 (1 + e)^2),
    so that s is [w h^3 r(kappa h) - w_c ((h-d)^3 r(kappa (h-d)) - d^3 r(kappa d))] / (4 I_0): 0 at
    small strain, at most 3/4, and free of G.  Bent backwards (kappa < 0) thin walls wrinkle before
    the rubber stiffens; there the linear law stays [ours].

    Args:
      curvature: Curvature kappa [1/m], any shape; a JAX or NumPy array, as the others.
      height: Outer height h [m], broadcasting to it.
      wall: Wall thickness d [m], likewise.
      width: Outer width w [m].
    """
    return _lacking(
        lambda e: e * (3 + 2 * e) / (2 * (1 + e) ** 2), curvature, height, wall, width=width
    )


def softening_energy(curvature: Any, height: Any, wall: Any, *, width: Any) -> Any:
    """Share of the linear bending energy that it lacks; `softening`'s integral, and its arguments.

    A neo-Hookean block of width b from 0 to y stores G/2 int (lambda^2 + lambda^-2 - 2) dA per
    length, 2/3 G b y^3 kappa^2 (1 - 3/4 e / (1 + e)) with e = kappa y, so that the moment
    M = dU / d kappa of the energy U = E I kappa^2 / 2 (1 - u) has in u the sum of `softening` with
    e / (1 + e) in the place of r(e).
    """
    return _lacking(lambda e: e / (1 + e), curvature, height, wall, width=width)


def _lacking(
    of_strain: Callable[[Any], Any], curvature: Any, height: Any, wall: Any, *, width: Any
) -> Any:
    """[w h^3 f(kappa h) - w_c ((h-d)^3 f(kappa (h-d)) - d^3 f(kappa d))] / (4 I_0) of f(e)."""
    kappa = curvature * (curvature > 0)
    inner = height - wall
    chamber = width - 2 * wall

    def missing(y: Any) -> Any:
        return y**3 * of_strain(kappa * y)

    second_moment = (width * height**3 - chamber * (inner**3 - wall**3)) / 3
    lacking = width * missing(height) - chamber * (missing(inner) - missing(wall))
    return lacking / (4 * second_moment)


def strain_pressure(
    strain: float, height: Any, wall: Any, *, width: float, shear_modulus: float, neo_hookean: bool
) -> Any:
    """Pressure at which the top wall of a free finger has a strain, kappa h [Pa].

    The inverse of the free curvature kappa = p M_p / (E I (1 - s)): at a strain the softening s of
    the neo-Hookean law is known, so that both laws have a closed form.

    Args:
      height: Outer height h [m], any shape.
      wall: Wall thickness d [m], same shape.
      width: Outer width w [m].
      shear_modulus: G of the silicone [Pa].
      neo_hookean: Whether the bending law is that of a neo-Hookean wall, else the linear one.
    """
    section = beam(height, wall, width=width, shear_modulus=shear_modulus, density=1.0)
    curvature = strain / height
    moment = section.bending * curvature
    if neo_hookean:
        moment *= 1 - softening(curvature, height, wall, width=width)
    return moment / section.moment_per_pressure
