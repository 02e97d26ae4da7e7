"""Repairs of a triangle mesh: only on request, and with a line for everything that was changed.

trimesh closes holes of at most four edges; manifold3d takes only what is closed already.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from codesign_jax.scene.meshes.surface import turned_alike, winding

_MERGE = 1e-5  # vertices closer than this fraction of the size are one


def repair(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Merges vertices, drops degenerate and duplicate faces, turns faces alike and closes holes."""
    report: list[str] = []
    vertices, faces = _merge(vertices, faces, report)
    faces = _drop(faces, report)
    if not len(faces):
        return vertices, faces, report
    alike, part = turned_alike(faces)
    faces, turned = alike, (alike != faces).any(1)
    vertices, faces, part = _close(vertices, faces, part, report)
    faces, outwards = _turn_outwards(vertices, faces, part)
    turned = np.concatenate([turned, np.zeros(len(faces) - len(turned), bool)]) ^ outwards
    if turned.any():
        report.append(f"turned {turned.sum()} of {len(faces)} faces, so that all point outwards")
    return vertices, faces, report


def _merge(
    vertices: np.ndarray, faces: np.ndarray, report: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    near = _MERGE * np.ptp(vertices, axis=0).max()
    pairs = KDTree(vertices).query_pairs(near, output_type="ndarray")
    if not len(pairs):
        return vertices, faces
    ones = np.ones(len(pairs), bool)
    n = len(vertices)
    count, group = connected_components(coo_array((ones, tuple(pairs.T)), shape=(n, n)))
    report.append(f"merged {n - count} vertices into their neighbours")
    first = np.unique(group, return_index=True)[1]
    return vertices[first], group[faces]


def _drop(faces: np.ndarray, report: list[str]) -> np.ndarray:
    a, b, c = faces.T
    _, first = np.unique(np.sort(faces, 1), axis=0, return_index=True)
    once = np.isin(np.arange(len(faces)), first)
    keep = (a != b) & (b != c) & (c != a) & once
    if not keep.all():
        report.append(f"dropped {(~keep).sum()} degenerate or duplicate faces")
    return faces[keep]


def half_edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges of the faces, edge k of face f in row 3 f + k, shape (3 face, 2)."""
    return np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)


def _close(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, report: list[str]):
    """Closes each hole by a fan around its middle; holes that touch each other are left open."""
    directed = {(int(i), int(j)): f // 3 for f, (i, j) in enumerate(half_edges(faces))}
    rim = {i: j for (j, i) in directed if (i, j) not in directed}  # backwards, as the filling runs
    while rim:
        loop = [next(iter(rim))]
        while rim and loop[-1] in rim:
            loop.append(rim.pop(loop[-1]))
        if loop[0] != loop[-1] or len(loop) < 4:
            continue
        loop.pop()
        owner = part[directed[loop[1], loop[0]]]
        if len(loop) == 3:
            new = [loop]
        else:
            vertices = np.vstack([vertices, vertices[loop].mean(0)])
            middle = len(vertices) - 1
            new = [[a, b, middle] for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
        faces = np.vstack([faces, new])
        part = np.concatenate([part, [owner] * len(new)])
        report.append(f"closed a hole of {len(loop)} edges")
    return vertices, faces, part


def _turn_outwards(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray):
    """Turns parts inside out but cavities, parts in an odd number of others; also which faces."""
    corner = vertices[faces] - vertices.mean(0)
    a = corner[:, 0]
    b = corner[:, 1]
    c = corner[:, 2]
    names, part_index = np.unique(part, return_inverse=True)
    volume = np.bincount(part_index, weights=np.einsum("fi,fi->f", a, np.cross(b, c)))
    each = [faces[part_index == k] for k in range(len(names))]
    firsts = vertices[[mine[0, 0] for mine in each]]
    enclosed = [abs(winding(vertices, mine, firsts)) > 0.5 for mine in each]
    np.fill_diagonal(around := np.array(enclosed), False)
    cavity = around.sum(0) % 2 == 1
    inward = ((volume < 0) != cavity)[part_index]
    return np.where(inward[:, None], faces[:, ::-1], faces), inward
