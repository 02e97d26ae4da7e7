"""Mass properties of a closed mesh and the frame in which its inertia is diagonal."""

import itertools
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

# Products of inertia below this fraction of the trace are rounding of a symmetric body, whose axes
# stay those of its file.
_SYMMETRIC = 1e-6


class MassProperties(NamedTuple):
    """A body; its frame sits at the centre of mass along the principal axes."""

    volume: float  # volume [m^3]
    centre: np.ndarray  # centre of mass in the file's frame [m], shape (3,)
    axes: np.ndarray  # principal axes as columns, in the file's frame, a rotation, shape (3, 3)
    inertia: np.ndarray  # principal moments per mass [m^2], shape (3,)


def body(
    vertices: np.ndarray,
    faces: np.ndarray,
    centre: np.ndarray | None = None,
    tensor: np.ndarray | None = None,
) -> MassProperties:
    """Mass properties of a watertight mesh, those of a homogeneous body where none are given.

    Args:
      centre: Centre of mass in the file's frame [m], shape (3,).
      tensor: Inertia about the centre of mass per mass [m^2], in the file's axes, shape (3, 3).
    """
    # Near the origin and of order one: products of five lengths in metres drown in rounding.
    middle = vertices.mean(0)
    scale = np.ptp(vertices, axis=0).max()
    unit = trimesh.Trimesh((vertices - middle) / scale, faces, process=False).mass_properties
    if tensor is None:
        tensor = np.asarray(unit["inertia"]) / unit["volume"] * scale**2
    axes = principal_axes(np.asarray(tensor))
    return MassProperties(
        volume=float(unit["volume"] * scale**3),
        centre=np.asarray(unit["center_mass"]) * scale + middle if centre is None else centre,
        axes=axes,
        inertia=np.diag(axes.T @ tensor @ axes).copy(),
    )


def principal_axes(tensor: np.ndarray) -> np.ndarray:
    """Rotation whose columns are the principal axes, of the 24 that are the nearest to none."""
    off = np.abs(tensor - np.diag(np.diag(tensor))).max()
    if off <= _SYMMETRIC * np.trace(tensor):
        return np.eye(3)
    vectors = np.linalg.eigh(tensor)[1]
    candidates = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = vectors[:, list(order)] * signs
            if np.linalg.det(axes) > 0:
                candidates.append(axes)
    return max(candidates, key=np.trace)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z) with w >= 0 of a rotation matrix, shape (4,)."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(canonical=True), 1)
