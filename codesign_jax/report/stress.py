"""What a builder should know of a design: what it keeps under other conditions, and warnings."""

from typing import NamedTuple

import numpy as np

from codesign_jax.model import morphology
from codesign_jax.model.overlap import Overlaps
from codesign_jax.report.statistics import wilson
from codesign_jax.scene import Scene
from codesign_jax.types import Params

STRAIN = 1.5
"""Largest strain at which the silicones of docs/measurements.md were measured."""
DEEP = 3e-3
"""Overlap [m] from which on it is told: less is within the contact's own softness."""
TURN = 2 * np.pi


class Stress(NamedTuple):
    """Grasps of one design under other conditions.

    Attributes:
      conditions: What was changed, once for each set of numbers that was simulated.
      kept: Grasps that kept the object, shape (set,).
      trials: Grasps of each set.
      warnings: What the grasps as they are say of the design itself.
    """

    conditions: tuple[str, ...]
    kept: np.ndarray
    trials: int
    warnings: tuple[str, ...]

    @property
    def head(self) -> tuple[str, str, str]:
        """Names of the columns of `rows`."""
        return "condition", "kept", "95 % interval"

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """A row for each condition; of several sets what the worst and the best one keep."""
        found = []
        for name in dict.fromkeys(self.conditions):
            kept = self.kept[[condition == name for condition in self.conditions]]
            total = self.trials * kept.size
            share, low, high = wilson(int(kept.sum()), total)
            what = ""
            if kept.size > 1:
                low, high, what = kept.min() / self.trials, kept.max() / self.trials, ", by draw"
            span = f"{100 * low:.0f} to {100 * high:.0f} %{what}"
            found.append((name, f"{100 * share:.0f} % of {total}", span))
        return found

    def lines(self) -> list[str]:
        """The rows as aligned text."""
        rows = [("", *self.head[1:]), *self.rows]
        widths = [max(len(row[k]) for row in rows) for k in range(3)]
        cells = [(a.ljust(widths[0]), b.rjust(widths[1]), c) for a, b, c in rows]
        return ["  " + "  ".join(row).rstrip() for row in cells]


def of_design(scene: Scene, params: Params) -> list[str]:
    """Warnings of a design itself, of which nothing is simulated.

    Args:
      scene: The scene.
      params: Its parameters, numbers.
    """
    found: list[str] = []
    for f, bend in enumerate(morphology.free_bends(scene.hand, params)):
        limit = scene.hand.pressure_limit.of(float(params.height[f]), float(params.wall[f]))
        if float(params.pressure[f]) > 0.99 * limit:
            found.append(f"finger {f}: its pressure is at its limit, {limit / 1e3:.0f} kPa")
        if bend > TURN:
            found.append(
                f"finger {f} bends by {np.degrees(bend):.0f}° without load, more than a turn"
            )
    roll, pitch, yaw = np.asarray(params.arm, float)[3:]
    up = np.cos(roll) * np.cos(pitch) + np.sin(roll) * np.sin(yaw) * np.sin(pitch)
    rim = scene.hand.palm.radius * np.sqrt(1 - min(up**2, 1.0))
    low = scene.arm.zero_height + float(params.arm[2]) - rim
    if low < 0:
        found.append(f"the palm's rim is commanded {-1e3 * low:.0f} mm below the table")
    return found


def of_bends(strain: np.ndarray, held: np.ndarray) -> list[str]:
    """Warnings of walls that stretch and fingers that coil in kept grasps.

    Args:
      strain: Strain of the walls, shape (grasp, state, finger, link).
      held: Bend of the joints while the object is held [rad], shape (grasp, state, finger, link).
    """
    if not strain.size:
        return []
    found, most = [], strain.max((0, 1, 3))
    for f in np.flatnonzero(most > STRAIN):
        found.append(
            f"finger {f}: its walls stretch by {100 * most[f]:.0f} % in grasps, more than the "
            f"{100 * STRAIN:.0f} % up to which silicones were measured"
        )
    angles = np.median(held.sum(-1), 1).max(0)
    for f in np.flatnonzero(angles > TURN):
        found.append(
            f"finger {f} bends by {np.degrees(angles[f]):.0f}° in grasps, more than a turn"
        )
    return found


def of_overlaps(scene: Scene, params: Params, depths: list[Overlaps]) -> list[str]:
    """Warnings of fingers that stand in something while the object is held.

    Args:
      scene: The scene.
      params: The hand.
      depths: Overlaps of a grasp each.
    """
    if not depths:
        return []
    fingers = np.concatenate([d.fingers for d in depths]).max(0)
    palm = np.concatenate([d.palm for d in depths]).max(0)
    thin = np.minimum(np.asarray(params.height), scene.hand.section.width)
    found = []
    for i, j in np.argwhere(fingers > DEEP):
        deep = f"{1e3 * fingers[i, j]:.0f} mm"
        if i == j:
            found.append(
                f"finger {i} stands {deep} deep in itself: the simulation has no such contact"
            )
        elif fingers[i, j] > thin[j] / 3 and (fingers[i, j] >= fingers[j, i] or i < j):
            found.append(f"finger {i} stands {deep} deep in finger {j}, more than a third of it")
    for f in np.flatnonzero(palm > DEEP):
        found.append(f"finger {f} stands {1e3 * palm[f]:.0f} mm deep in the palm")
    return found
