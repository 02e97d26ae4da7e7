"""Exact solutions for tubes and boxes of rubber."""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy import optimize


def tube_stretch(pressure: float, outer: float, inner: float, modulus: float) -> float:
    """Stretch of a closed, incompressible neo-Hookean tube whose outer radius cannot change."""

    points, weights = np.polynomial.legendre.leggauss(20)
    radius = (outer + inner + (outer - inner) * points) / 2
    area = np.pi * radius * (outer - inner) * weights

    def energy(stretch: float) -> float:
        hoop = (outer**2 - (outer**2 - radius**2) / stretch) / radius**2
        return float(area @ (modulus / 2 * (stretch**2 + hoop + 1 / (hoop * stretch**2) - 3)))

    def residual(stretch: float) -> float:
        step = 1e-5
        force = (energy(stretch + step) - energy(stretch - step)) / (2 * step)
        return force - pressure * np.pi * outer**2

    return optimize.brentq(residual, 1.0, 5.0)


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
