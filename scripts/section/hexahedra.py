"""Mesh of a whole finger: that of its section, extruded, with end walls that fill the chamber."""

import dataclasses

import numpy as np

from scripts.section.elements import Section, contours, rectangle


@dataclasses.dataclass(frozen=True)
class Hexahedra:
    """Elements with eight nodes.

    X runs along the finger from its base, Y across, Z up from the fabric.

    Attributes:
      nodes: Positions [m], shape (node, 3).
      elements: Nodes of each, four at its lower X and four at its higher one, shape (element, 8).
      surfaces: Nodes of quadrilaterals by name, counterclockwise about the normal that points out
        of the silicone, shape (quadrilateral, 4): "base", "tip", "outside", "bottom", "chamber";
        "cap" is the end walls' faces to the chamber, "thread" lies in the silicone.
      planes: Nodes of the outside at each X, from the bottom left, shape (plane, node).
    """

    nodes: np.ndarray
    elements: np.ndarray
    surfaces: dict[str, np.ndarray]
    planes: np.ndarray


def _section_mesh(section: Section) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nodes, numbers of the rings' nodes, and quadrilaterals of the walls and of the chamber."""
    across, upright = section.sides[:2]
    if section.sides[2:] != section.sides[:2]:
        raise ValueError(f"opposite sides need equal numbers of elements, not {section.sides}")
    outer, chamber = (c[::2] for c in contours(section))
    share = section.depths()[:, None, None]
    # A core of half the size, so that a round chamber is filled without flat corners.
    middle = (chamber.min(0) + chamber.max(0)) / 2
    half = (chamber.max(0) - middle) / 2
    core = rectangle(middle - half, middle + half, section.sides)[::2]
    rings = np.concatenate([(1 - share) * outer + share * chamber, core[None]])
    count, around = rings.shape[:2]
    ring = np.arange(count * around).reshape(count, around)
    # The core's grid begins with its contour, which is the last ring.
    grid = np.full((across + 1, upright + 1), -1)
    steps = [(1, 0)] * across + [(0, 1)] * upright + [(-1, 0)] * across + [(0, -1)] * upright
    for number, place in zip(ring[-1], np.cumsum([(0, 0), *steps], 0)[:-1], strict=True):
        grid[tuple(place)] = number
    inside = np.argwhere(grid < 0)
    grid[tuple(inside.T)] = ring.size + np.arange(len(inside))
    within = middle - half + 2 * half * inside / [across, upright]
    nodes = np.concatenate([rings.reshape(-1, 2), within])
    beside = np.roll(ring, -1, 1)
    walls = np.stack([ring[:-1], beside[:-1], beside[1:], ring[1:]], -1)
    filled = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], -1)
    chamber_quads = np.concatenate([walls[-1], filled.reshape(-1, 4)])
    return nodes, ring[:-1], walls[:-1].reshape(-1, 4), chamber_quads


def _extruded(flat: np.ndarray, slabs: np.ndarray, count: int) -> np.ndarray:
    """Hexahedra on quadrilaterals, or quadrilaterals (a, b, b', a') on edges (a, b).

    Args:
      flat: Nodes of the section, shape (element, 4) or (element, 2).
      slabs: Numbers of the parts along the finger.
      count: Nodes of a section.
    """
    above = flat if flat.shape[1] == 4 else flat[:, ::-1]
    start = count * slabs[:, None, None]
    return np.concatenate([flat + start, above + start + count], -1).reshape(-1, 2 * flat.shape[1])


def mesh(section: Section, length: float, end: float, along: int) -> Hexahedra:
    """A finger of this length.

    Args:
      section: Its section.
      length: With its end walls [m].
      end: Thickness of the end walls [m]; 0: the chamber is open at both ends.
      along: Elements along the chamber; an end wall has two.
    """
    flat, ring, walls, filling = _section_mesh(section)
    places = np.linspace(end, length - end, along + 1)
    if end:
        places = np.concatenate([[0.0, end / 2], places, [length - end / 2, length]])
    count = len(flat)
    every = np.arange(len(places) - 1)
    hollow = (2 if end else 0) + np.arange(along)
    solid = np.setdiff1d(every, hollow)
    across = np.tile(flat, (len(places), 1))
    nodes = np.concatenate([np.repeat(places, count)[:, None], across], 1)
    hexahedra = [_extruded(walls, every, count), _extruded(filling, solid, count)]
    edges = np.stack([ring, np.roll(ring, -1, 1)], -1)
    bottom = section.sides[0]
    depth = int(np.abs(section.depths() - section.thread_depth).argmin())
    # On the chamber's wall the thread lies in the silicone within the end walls only.
    inside = solid if depth == len(ring) - 1 else every
    whole = np.concatenate([walls, filling]) if end else walls
    caps = [filling + count * hollow[0], filling[:, ::-1] + count * (hollow[-1] + 1)]
    surfaces = {
        "base": whole[:, ::-1],
        "tip": whole + count * len(every),
        "outside": _extruded(edges[0][bottom:], every, count),
        "bottom": _extruded(edges[0][:bottom], every, count),
        "chamber": _extruded(edges[-1][:, ::-1], hollow, count),
    }
    if end:
        surfaces["cap"] = np.concatenate(caps)
    if depth and len(inside):
        surfaces["thread"] = _extruded(edges[depth], inside, count)
    planes = ring[0] + count * np.arange(len(places))[:, None]
    return _without_unused(nodes, np.concatenate(hexahedra), surfaces, planes)


def _without_unused(
    nodes: np.ndarray, elements: np.ndarray, surfaces: dict[str, np.ndarray], planes: np.ndarray
) -> Hexahedra:
    """The mesh with the nodes that elements have."""
    used, number = np.unique(elements, return_inverse=True)
    renamed = np.full(len(nodes), -1)
    renamed[used] = np.arange(len(used))
    named = {name: renamed[quads] for name, quads in surfaces.items()}
    return Hexahedra(nodes[used], number.reshape(-1, 8), named, renamed[planes])
