"""A finger's section by finite elements beside exact solutions."""

import dataclasses

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from scipy import optimize

from scripts.section import elements
from scripts.section.elements import Model, Section

G = 88e3


def test_derivatives():
    section = Section(sides=(2, 2, 2, 2), winding_angle=0.2, slack=1e-2)
    model = Model(section)
    random = np.random.default_rng(0)
    state = model.state + 1e-4 * random.standard_normal(model.state.shape)
    state[-4:] += [0.01, 3.0, 5.0, 2.0]
    model.pressure = 30e3
    way = 1e-3 * random.standard_normal(state.shape)
    way[-4:] *= 100
    _, gradient, hessian = model.derivatives(state)
    step = 1e-4
    after = model.derivatives(state + step * way)
    before = model.derivatives(state - step * way)
    # Central differences: their error is of second order in the step.
    assert gradient @ way == pytest.approx((after[0] - before[0]) / (2 * step), rel=1e-6)
    expected = hessian @ way
    difference = (after[1] - before[1]) / (2 * step)
    np.testing.assert_allclose(difference, expected, atol=1e-5 * np.abs(expected).max())


def exact_tube(pressure: float, outer: float, inner: float) -> float:
    """Stretch of a closed, incompressible neo-Hookean tube whose outer radius cannot change."""

    points, weights = np.polynomial.legendre.leggauss(20)
    radius = (outer + inner + (outer - inner) * points) / 2
    area = np.pi * radius * (outer - inner) * weights

    def energy(stretch: float) -> float:
        hoop = (outer**2 - (outer**2 - radius**2) / stretch) / radius**2
        return float(area @ (G / 2 * (stretch**2 + hoop + 1 / (hoop * stretch**2) - 3)))

    def residual(stretch: float) -> float:
        step = 1e-5
        force = (energy(stretch + step) - energy(stretch - step)) / (2 * step)
        return force - pressure * np.pi * outer**2

    return optimize.brentq(residual, 1.0, 5.0)


@pytest.mark.parametrize(
    ("layers", "around"),
    [(1, 4), pytest.param(2, 6, marks=pytest.mark.slow)],
)
def test_round_tube(layers, around):
    """Elements of 1 mm are within 1e-3 of the exact stretch, on two meshes."""
    section = Section(
        width=20e-3,
        height=20e-3,
        wall=4e-3,
        bulk_ratio=1e5,
        thread_stiffness=1e7,
        fabric_stiffness=0.0,
        slack=1e-6,
        layers=layers,
        sides=(around,) * 4,
        round=True,
    )
    model = Model(section)
    for pressure in (20e3, 50e3, 100e3):
        model.reach(pressure, steps=4, twist=0.0, bend=0.0, lateral=0.0)
        expected = exact_tube(pressure, 10e-3, 6e-3) - 1
        assert model.stretch - 1 == pytest.approx(expected, rel=1e-3)


def torsion_constant(width: int, height: int, wall: int) -> float:
    """Saint-Venant's torsion constant of a box by Prandtl's function; sides in cells."""
    y, z = np.meshgrid(np.arange(width + 1), np.arange(height + 1), indexing="ij")
    margin = np.minimum(np.minimum(y, width - y), np.minimum(z, height - z))
    count = int(((margin > 0) & (margin < wall)).sum())
    number = np.where(margin >= wall, count, -1)
    number[(margin > 0) & (margin < wall)] = np.arange(count)
    rows = []
    columns = []
    values = []
    inside = (margin > 0) & (margin < wall)
    hole = margin >= wall
    for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beside = np.roll(number, way, axis)
        for nodes in (inside, hole & np.roll(inside, way, axis)):
            rows += [number[nodes], number[nodes][beside[nodes] >= 0]]
            columns += [number[nodes], beside[nodes][beside[nodes] >= 0]]
            values += [np.ones(nodes.sum()), -np.ones((beside[nodes] >= 0).sum())]
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    matrix = scipy.sparse.csc_matrix(entries, (count + 1, count + 1))
    # Around the hole the flux passes the middles of the cells beside it.
    area = (width - 2 * wall + 1) * (height - 2 * wall + 1)
    right = np.append(np.full(count, 2.0), 2.0 * area)
    phi = scipy.sparse.linalg.spsolve(matrix, right)
    return 2 * (phi[:-1].sum() + phi[-1] * area)


@pytest.mark.parametrize(
    ("wall", "sides"),
    [
        (5.0, (6, 4, 6, 4)),
        pytest.param(2.5, (8, 6, 8, 6), marks=pytest.mark.slow),
        pytest.param(7.0, (8, 6, 8, 6), marks=pytest.mark.slow),
    ],
)
def test_box(wall, sides):
    """Of rubber alone: bending by beam theory to 1e-3, twist by Prandtl's function to 2 %."""
    section = Section(wall=wall * 1e-3, thread_stiffness=0.0, fabric_stiffness=0.0, sides=sides)
    model = Model(section)
    model.solve(0.0, twist=0.0, bend=0.0, lateral=0.0)
    twist, bend, lateral = np.diag(model.stiffness())
    width, height = 24.0, 20.0
    chamber = width - 2 * wall, height - 2 * wall
    upright = (width * height**3 - chamber[0] * chamber[1] ** 3) / 12 * 1e-12
    across = (height * width**3 - chamber[1] * chamber[0] ** 3) / 12 * 1e-12
    assert bend == pytest.approx(3 * G * upright, rel=1e-3)
    assert lateral == pytest.approx(3 * G * across, rel=1e-3)
    cells = 6  # per mm
    exact = torsion_constant(*(round(cells * v) for v in (width, height, wall)))
    assert twist == pytest.approx(G * exact / (1e3 * cells) ** 4, rel=0.02)


def test_two_meshes():
    """A finer mesh bends by 2 % more at most, and its chamber's volume follows from its energy."""
    bends = []
    for layers, sides in ((2, (4, 4, 4, 4)), (2, (8, 6, 8, 6))):
        model = Model(Section(layers=layers, sides=sides))
        model.reach(20e3, steps=2, twist=0.0, lateral=0.0)
        bends.append(model.kappa[1])
    assert bends[1] == pytest.approx(bends[0], rel=0.02)
    energy = model.energy()
    volume = model.volume()
    held = dict(zip(elements.CURVATURES, model.kappa, strict=True))
    model.solve(20.1e3, **held)
    # By virtual work: the volume is the energy's slope by pressure; of first order in the step.
    assert (energy - model.energy()) / 100 == pytest.approx(volume, rel=3e-3)


def test_thread_inside_the_wall_has_a_layer():
    section = Section(thread_depth=0.3)
    assert 0.3 in section.depths()
    with pytest.raises(ValueError):
        Model(dataclasses.replace(section, layers=1))


def test_no_equilibrium():
    model = Model(Section(layers=1, sides=(2, 2, 2, 2)))
    with pytest.raises(elements.NoEquilibrium):
        model.solve(1e6, twist=0.0, bend=0.0, lateral=0.0)
    assert model.pressure == 0.0
