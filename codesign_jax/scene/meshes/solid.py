"""A mesh file as a graspable body: read, checked, brought into its principal frame."""

import dataclasses
import functools
import hashlib
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from codesign_jax.scene.hand_tables import LEAST_REACH
from codesign_jax.scene.meshes import grid, mass, reading, repair, support, surface
from codesign_jax.scene.schema import InputError, Problem

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
# longest side of the bounding box [m]
SMALLEST = 0.005
LARGEST = 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class Solid:
    """A closed mesh in its own frame: origin at the centre of mass, axes principal.

    Two are equal if they come from the same bytes in the same way, wherever the file lies; the same
    holds for their representations, by which compiled kernels are kept.
    """

    path: Path = dataclasses.field(repr=False)  # the file
    content: bytes = dataclasses.field(repr=False)  # its bytes, as they were read
    digest: str  # SHA-256 of the bytes and of how they were read
    vertices: np.ndarray = dataclasses.field(repr=False)  # positions [m], shape (vertex, 3)
    faces: np.ndarray = dataclasses.field(repr=False)  # vertex indices, outwards, shape (face, 3)
    volume: float  # volume [m^3]
    inertia: tuple[float, ...]  # principal moments per mass [m^2]
    # Orientation of the body in its file's frame, unit quaternion (w, x, y, z)
    upright: tuple[float, ...]
    voxel_error: float  # bound on the error of the signed distance [m]
    repairs: tuple[str, ...]  # what a repair changed
    reach: float = LEAST_REACH  # how far beyond the surface distances are known [m]

    def reaching(self, reach: float) -> "Solid":
        """The solid with distances up to `reach` [m] from its surface; see `mesh_margins`."""
        if reach == self.reach:
            return self
        digest = hashlib.sha256(f"{self.digest} {reach!r}".encode()).hexdigest()
        return dataclasses.replace(self, reach=reach, digest=digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Solid) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @functools.cached_property
    def half_sizes(self) -> tuple[float, ...]:
        """Half sizes of the bounding box along the principal axes [m]."""
        return tuple(float(v) for v in np.ptp(self.vertices, axis=0) / 2)

    @functools.cached_property
    def radius(self) -> float:
        """Distance of the farthest vertex from the centre of mass [m]."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @functools.cached_property
    def hull(self) -> np.ndarray:
        """Vertices of the convex hull [m], shape (vertex, 3): no other point can be the lowest."""
        return self.vertices[ConvexHull(self.vertices).vertices]

    @functools.cached_property
    def support(self) -> np.ndarray:
        """Points that can touch a plane [m], shape (point, 3)."""
        return support.support_points(self.vertices)

    @functools.cached_property
    def grid(self) -> grid.Grid:
        """Signed distances; built when first asked for."""
        known = self.voxel_error, self.reach
        try:
            built = grid.cached(self.digest, self.vertices, self.faces, *known)
        except ValueError as error:
            # Of parts that overlap their walls are too close together, not the body too large.
            self._refuse_overlap()
            raise InputError.of("geometry", f"{self.path.name}: {error}") from error
        # Where parts overlap, the mesh counts a volume twice and the distance has inner walls.
        filled = np.clip(0.5 - built.values / built.cell, 0.0, 1.0).sum() * built.cell**3
        # A body that is thin for the cells fills another volume too.
        if abs(filled - self.volume) > 0.1 * self.volume:
            self._refuse_overlap()
        return built

    def _refuse_overlap(self) -> None:
        """Refuses a surface with inner walls: much of its outer side lies inside the body."""
        points = grid.near_surface(self.vertices, self.faces, 400, 1e-5 * self.radius)
        inside = float((surface.winding(self.vertices, self.faces, points) > 0.5).mean())
        if inside > 0.02:
            raise InputError.of(
                "geometry",
                f"{self.path.name}: the surface cuts through itself, as of parts that overlap: "
                f"{100 * inside:.0f} % of it lie inside the body. Unite the parts in the "
                "program that made them",
            )


def load(
    path: Path,
    *,
    unit: str,
    repaired: bool,
    voxel_error: float,
    centre: np.ndarray | None = None,
    tensor: np.ndarray | None = None,
    content: bytes | None = None,
) -> Solid:
    """Reads and checks a mesh file; `reading.FORMATS` are the formats.

    Args:
      voxel_error: Bound on the error of the signed distance [m].
      centre: Centre of mass in the file's frame [m], shape (3,); None for a homogeneous body's.
      tensor: Inertia about it per mass [m^2], in the file's axes, shape (3, 3); likewise.
    """
    mesh = reading.read(path) if content is None else reading.parsed(path, content)
    vertices, faces, content, digest = mesh
    repairs: list[str] = []
    with np.errstate(over="ignore", invalid="ignore"):
        problems = _size_problems(np.ptp(vertices, axis=0).max(), unit)
        # Of a wrong size nothing is repaired: the largest numbers have no differences.
        if repaired and not problems:
            vertices, faces, repairs = repair.repair(vertices, faces)
        problems += surface_problems(vertices, faces, repaired)
    if problems:
        raise InputError([Problem("geometry", f"{path.name}: {p}") for p in problems])
    vertices = vertices * UNITS[unit]
    if centre is not None and not _inside(vertices, centre):
        point = ", ".join(f"{1e3 * v:g}" for v in centre)
        raise InputError.of(
            "geometry", f"{path.name}: centre_of_mass at {point} mm is outside its convex hull"
        )
    body = mass.body(vertices, faces, centre, tensor)
    options = f"{unit} {repaired} {voxel_error!r}"
    if centre is not None or tensor is not None:  # others keep the grids that they have on disk
        options += f" {[v.tolist() for v in body[1:]]}"
    return Solid(
        path=path,
        content=content,
        digest=hashlib.sha256(f"{digest} {options}".encode()).hexdigest(),
        vertices=(vertices - body.centre) @ body.axes,
        faces=faces,
        volume=body.volume,
        inertia=tuple(float(v) for v in body.inertia),
        upright=tuple(float(v) for v in mass.quaternion(body.axes)),
        voxel_error=voxel_error,
        repairs=tuple(repairs),
    )


def _inside(vertices: np.ndarray, point: np.ndarray) -> bool:
    planes = ConvexHull(vertices).equations
    return bool((planes[:, :3] @ point + planes[:, 3] < 0).all())


def _size_problems(longest: float, unit: str) -> list[str]:
    if SMALLEST <= longest * UNITS[unit] <= LARGEST:
        return []
    message = (
        f"is {longest * UNITS[unit]:.3g} m long in unit = {unit!r}, outside "
        f"[{SMALLEST * 1e3:g}, {LARGEST * 1e3:g}] mm"
    )
    fitting = [
        f"unit = {other!r} ({1e3 * longest * factor:.3g} mm long)"
        for other, factor in UNITS.items()
        if SMALLEST <= longest * factor <= LARGEST
    ]
    return [f"{message}; set {' or '.join(fitting)}" if fitting else message]


def surface_problems(vertices: np.ndarray, faces: np.ndarray, repaired: bool = False) -> list[str]:
    """Returns why the faces do not bound a body, a line for each reason."""
    edges = repair.half_edges(faces)
    edge_numbers, count = np.unique(
        np.sort(edges, 1), axis=0, return_inverse=True, return_counts=True
    )[1:]
    problems = []
    if (count == 1).any():
        problems.append(
            Problem(
                "geometry", f"not watertight: {(count == 1).sum()} edges belong to one face only"
            )
        )
    if (count > 2).any():
        problems.append(
            Problem("geometry", f"{(count > 2).sum()} edges belong to more than two faces")
        )
    forward = np.bincount(
        edge_numbers.reshape(-1), weights=np.where(edges[:, 0] < edges[:, 1], 1, -1)
    )
    if clashing := int(((count == 2) & (forward != 0)).sum()):
        problems.append(Problem("geometry", f"faces point to different sides at {clashing} edges"))
    a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
    volume = np.einsum("fi,fi", a, np.cross(b, c)) / 6
    smallest = 1e-6 * np.ptp(vertices, axis=0).max() ** 3
    if not problems and volume < -smallest:
        problems.append(Problem("geometry", "inside out: its faces point inwards"))
    elif not problems and volume < smallest:
        problems.append(Problem("geometry", "encloses no volume"))
    hint = "; even after the repair" if repaired else "; repair = true tries to mend it"
    return [p + hint for p in problems]
