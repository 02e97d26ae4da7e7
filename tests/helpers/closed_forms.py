"""Laws of a bent section by quadrature."""

from scipy import integrate

WIDTH, G = 0.020, 70e3
"""Width of the section [m] and shear modulus [Pa] of the paper's fingers."""


def moment(kappa, height, wall):
    """The neo-Hookean moment by quadrature over the section [N m]."""

    def density(y):
        stretch = 1 + kappa * y
        hollow = wall < y < height - wall
        return G * (stretch - stretch**-3) * y * (2 * wall if hollow else WIDTH)

    edges = [0, wall, height - wall, height]
    return sum(integrate.quad(density, a, b)[0] for a, b in zip(edges, edges[1:], strict=False))
