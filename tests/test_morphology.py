"""Beam theory of a finger against quadrature and closed forms."""

import numpy as np
import pytest
from scipy import integrate

from codesign_jax import scene
from codesign_jax.model import morphology
from codesign_jax.types import Params, Tip


def section(height=0.020, wall=0.005, width=0.020, shear_modulus=70e3, density=1070.0):
    """Python floats in, Python floats out: float64 whatever jax's mode."""
    return morphology.beam(height, wall, width=width, shear_modulus=shear_modulus, density=density)


def wall_integral(height, wall, width, weight):
    """Integral of weight(y, z) over the wall, by strips: outer rectangle less chamber."""

    def rectangle(y0, y1, half):
        return integrate.dblquad(lambda z, y: weight(y, z), y0, y1, -half, half, epsabs=1e-16)[0]

    inner = rectangle(wall, height - wall, width / 2 - wall)
    return rectangle(0, height, width / 2) - inner


@pytest.mark.parametrize("height, wall, width", [(0.02, 0.005, 0.02), (0.025, 0.002, 0.024)])
def test_section_integrals(height, wall, width):
    """Area and second moments are the integrals that they stand for; quadrature is exact here.

    Torsion is Bredt's: 4 A^2 d / s of the area A within the wall's middle line of length s.
    """
    beam = section(height, wall, width)
    young = 4 * 70e3
    bending = wall_integral(height, wall, width, lambda y, z: y**2)
    lateral = wall_integral(height, wall, width, lambda y, z: (z + width / 2) ** 2)
    area = wall_integral(height, wall, width, lambda y, z: 1.0)
    assert beam.bending == pytest.approx(young * bending, rel=1e-6)
    assert beam.lateral == pytest.approx(young * lateral, rel=1e-6)
    assert beam.line_density == pytest.approx(1070 * area, rel=1e-6)
    wide, high = width - wall, height - wall
    assert beam.torsion == pytest.approx(70e3 * 2 * (wide * high) ** 2 * wall / (wide + high))
    chamber = (width - 2 * wall) * (height - 2 * wall)
    assert beam.moment_per_pressure == pytest.approx(chamber * height / 2)


@pytest.mark.parametrize("links", [1, 2, 7])
def test_segments_are_a_finger_cut_in_pieces(links):
    """Mass, centre and inertia about the base of one block as long; its springs in series."""
    hand = scene.load("paper").hand
    params = Params(*np.array([[0.09, 0.13], [0.018, 0.021], [0.004, 0.005]]), 0.0, None, None)
    beams = morphology.finger_beams(hand, params, links)
    found = morphology.segments(hand, params, links)
    length, height, mass = params.length, params.height, beams.line_density[:, 0] * params.length
    joint = np.cumsum(found.offset, 1)
    # A joint stands in the middle of each segment.
    np.testing.assert_allclose(joint, np.outer(length, (np.arange(links) + 0.5) / links))
    start = np.concatenate([0 * joint[:, :1], joint], 1)
    np.testing.assert_allclose(start[:, 1:], (start + found.extent)[:, :-1], rtol=1e-12)
    centre = start + found.extent / 2
    np.testing.assert_allclose(found.mass.sum(1), mass)
    np.testing.assert_allclose((found.mass * centre).sum(1), mass * length / 2)
    about = (found.inertia[..., 1] + found.mass * centre**2).sum(1)
    np.testing.assert_allclose(about, mass * (length**2 / 3 + height**2 / 12))
    for name, rigidity in (("bend", "bending"), ("lateral", "lateral"), ("twist", "torsion")):
        stiffness, damping = morphology.joint_springs(hand, params, beams, links, (name,))
        whole = length / getattr(beams, rigidity)[:, 0]
        np.testing.assert_allclose(links / stiffness[:, 0, 0], whole)
        np.testing.assert_allclose(damping, hand.material.damping_time * stiffness)
    spheres = morphology.sphere_places(found.extent, 3)
    assert spheres.shape == (2, links, 3)
    np.testing.assert_allclose(spheres.mean(2), found.extent[:, 1:] / 2)
    np.testing.assert_allclose(np.diff(spheres, axis=2).max(2), found.extent[:, 1:] / 3)


def tapered():
    """Two fingers of the paper's hand whose sections shrink towards the tips."""
    hand = scene.load("paper").hand
    base = Params(*np.array([[0.09, 0.13], [0.022, 0.021], [0.005, 0.004]]), 0.0, None, None)
    tip = Tip(np.array([0.013, 0.016]), np.array([0.003, 0.0035]), np.array([0.016, 0.02]))
    return hand, base._replace(tip=tip)


def test_a_tapered_finger_is_the_integral_of_its_sections():
    """Mass, centre and compliance by SciPy's quadrature over the sections, as links go to many."""
    hand, params = tapered()
    for f in range(2):

        def beam(s, f=f):
            base = np.array([params.height[f], params.wall[f], hand.section.width])
            h, d, w = base + s * (np.array([v[f] for v in params.tip]) - base)
            m = hand.material
            return h, morphology.beam(
                h, d, width=w, shear_modulus=m.shear_modulus, density=m.density
            )

        def integral(weight, f=f):
            return params.length[f] * integrate.quad(weight, 0, 1, epsabs=1e-14)[0]

        mass = integral(lambda s: beam(s)[1].line_density)
        along = integral(lambda s, f=f: params.length[f] * s * beam(s)[1].line_density) / mass
        up = integral(lambda s: beam(s)[0] / 2 * beam(s)[1].line_density) / mass
        bend = integral(lambda s: beam(s)[1].moment_per_pressure / beam(s)[1].bending)
        for links in (1, 3, 10):
            found = morphology.segments(hand, params, links)
            start = np.concatenate([[0], np.cumsum(found.offset[f])])
            assert found.mass[f].sum() == pytest.approx(mass, rel=1e-12)
            centre = start + found.along[f]
            assert (centre * found.mass[f]).sum() / mass == pytest.approx(along, rel=1e-12)
            assert (found.up[f] * found.mass[f]).sum() / mass == pytest.approx(up, rel=1e-12)
            # Midpoints: the error of a joint's angle goes with the square of its segment.
            beams = morphology.finger_beams(hand, params, links)
            springs, _ = morphology.joint_springs(hand, params, beams, links, ("bend",))
            chain = (beams.moment_per_pressure[f] / springs[f, :, 0]).sum()
            assert chain == pytest.approx(bend, rel=0.12 / links**2)
        free = morphology.free_bends(hand, params._replace(pressure=np.full(2, 1e5)))
        assert free[f] == pytest.approx(1e5 * bend, rel=1e-4)
