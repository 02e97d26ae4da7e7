"""Which bending law measured silicones follow: linear or neo-Hookean.

The strain energy of a wall is taken to depend on I1 alone, so that uniaxial tension, where the
nominal stress is g(I1) (lambda - lambda^-2) with I1 = lambda^2 + 2 / lambda, gives g, and with it
the stress g(I1) (lambda - lambda^-3) in plane strain, where I1 = lambda^2 + lambda^-2 + 1. No
parameter is fitted up to there. Each law then has the G whose moments fit the section's best.

python -m scripts.silicones
"""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import integrate, interpolate, optimize

DATA = Path(__file__).parent.parent / "docs" / "data" / "silicones.csv"
HEIGHT, WALL, WIDTH = 0.020, 0.005, 0.024
"""Section of the default hand's 2D design [m]."""
STRAINS = np.array([0.25, 0.5, 0.75, 1.0, 1.25, 1.5])
"""Strains of the outermost fibre, at which moments are compared."""


def measured() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Strain and stress [Pa] of each silicone, shape (row,)."""
    lines = [n for n in DATA.read_text(encoding="utf-8").splitlines() if n[0] != "#"]
    (_, *names), *rows = csv.reader(lines)
    strain, *stress = np.array(rows, float).T
    return {name: (strain, 1e3 * s) for name, s in zip(names, stress, strict=True)}


def moment(stress: Callable[[np.ndarray], np.ndarray], strain: float) -> float:
    """Moment of the section [N m] about its inextensible layer.

    Args:
      stress: Nominal stress [Pa] of stretches, shape (y,).
      strain: Of the outermost fibre.
    """
    found = 0.0
    for low, high, width in (
        (0.0, WALL, WIDTH),
        (WALL, HEIGHT - WALL, 2 * WALL),
        (HEIGHT - WALL, HEIGHT, WIDTH),
    ):
        y = np.linspace(low, high, 401)
        found += width * integrate.simpson(stress(1 + strain * y / HEIGHT) * y, x=y)
    return float(found)


LAWS = {"linear": lambda s: 4 * (s - 1), "neo-Hookean": lambda s: s - s**-3}
"""Stress in plane strain over G."""


def compare(strain: np.ndarray, stress: np.ndarray) -> dict[str, tuple[float, np.ndarray]]:
    """Of each law G [Pa], and the relative error of the curvature at each of `STRAINS`."""
    stretch = 1 + strain
    energy = interpolate.PchipInterpolator(
        stretch**2 + 2 / stretch, stress / (stretch - stretch**-2)
    )

    def plane(s: np.ndarray) -> np.ndarray:
        first = s**2 + s**-2 + 1
        return energy(np.clip(first, energy.x[0], energy.x[-1])) * (s - s**-3)

    moments = np.array([moment(plane, e) for e in STRAINS])
    found = {}
    for name, law in LAWS.items():
        own = np.array([moment(law, e) for e in STRAINS])
        modulus = float(np.exp(np.log(moments / own).mean()))
        bent = [
            optimize.brentq(lambda e, m=m, law=law, g=modulus: g * moment(law, e) - m, 1e-3, 10)
            for m in moments
        ]
        found[name] = modulus, np.array(bent) / STRAINS - 1
    return found


def main() -> None:
    """Prints the table of docs/measurements.md."""
    print("| silicone | law | G [kPa] | " + " | ".join(f"{e:.0%}" for e in STRAINS) + " |")
    print("|---" * (3 + len(STRAINS)) + "|")
    for name, data in measured().items():
        for law, (modulus, errors) in compare(*data).items():
            row = " | ".join(f"{100 * e:+.0f}" for e in errors)
            print(f"| {name} | {law} | {1e-3 * modulus:.3g} | {row} |")


if __name__ == "__main__":
    main()
