"""Object sets as data: shapes, masses, friction and the noise of a trial (paper Sec. VI.2).

>>> from codesign_jax import objects
>>> [(shape.name, shape.mass) for shape in objects.load("paper").object]  # kg
[('cuboid', 0.05), ('cylinder', 0.05), ('sphere', 0.05)]
"""

import contextlib
import dataclasses
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codesign_jax.scene import keypaths, library, schema
from codesign_jax.scene.primitives import PRIMITIVES, Primitive
from codesign_jax.scene.schema import choice, quantity

if TYPE_CHECKING:  # trimesh and SciPy take a while to import; sets of primitives need neither
    from codesign_jax.scene.meshes import Solid

MOST_BYTES = 1 << 25
"""Largest size of a set's mesh files together; those of the set household have 0.4 MB."""
_MESH_KEYS = ("file", "unit", "density", "repair", "voxel_error")
_MASS, _SIZE = ("kg", 0.001, 10.0), ("m", 0.002, 0.25)


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations of a trial's Gaussian noise; z is a draw of the standard normal.

    Mass and size of the object have factors 1 + sigma z, which the upper bounds keep positive.  The
    friction of all contacts, the shear modulus of the fingers and the masses of fingers and palm
    have factors exp(sigma z) [ours].

    Attributes:
      position: Of the object's position on the table, in x and y.
      orientation: Of the object's rotation about the vertical, and of the arm frame's about roll
        and pitch.
      mass: Of the object's mass, relative.
      size: Of the object's size, relative.
      friction: Of the friction of all contacts, relative.
      stiffness: Of the fingers' shear modulus, relative.
      hand_mass: Of the masses of fingers and palm, relative.
      mass_range: Largest factor by which an object is heavier besides, drawn log-uniformly from 1;
        1 for none. No standard deviation.
    """

    position: float = quantity("m", 0, 0.1)
    orientation: float = quantity("deg", 0, 90)
    mass: float = quantity("", 0, 0.15)
    size: float = quantity("", 0, 0.15)
    friction: float = quantity("", 0, 1, default=0.0)
    stiffness: float = quantity("", 0, 1, default=0.0)
    hand_mass: float = quantity("", 0, 1, default=0.0)
    mass_range: float = quantity("", 1, 100, default=1.0)


ROBUST = Noise(
    position=0.01,
    orientation=10.0,
    mass=0.15,
    size=0.1,
    friction=0.2,
    stiffness=0.15,
    hand_mass=0.1,
    mass_range=10.0,
)
"""Noise of `--robust` [ours]: placement and size twice the paper's, mass three times and up to ten
times the object's, 50 to 500 g for the paper's, and what the paper keeps: friction, of which two
materials differ by more, stiffness as between two castings of one silicone, and the masses of
fingers and palm."""


@dataclasses.dataclass(frozen=True)
class Table:
    """The plane z = 0 and its friction with the object.

    Attributes:
      friction: Coulomb coefficient of the object on the table.
    """

    friction: float = quantity("", 0, 5)


@dataclasses.dataclass(frozen=True)
class _ShapeFile:
    """An object of the set: a primitive or a mesh.

    Attributes:
      name: Name, unique in the set.
      type: A primitive or "mesh".
      friction: Coulomb coefficient of the hand on it.
      size: Radii and half lengths of a primitive, in the order of the table "Sizes of primitives".
      mass: Mass; a mesh may give `density` instead.
      density: Density of a mesh.
      file: Mesh file, beside the object file if the path is relative.
      unit: Unit of the mesh file's numbers, metres if not given.
      repair: Whether to repair a mesh.
      voxel_error: Bound on the error of a mesh's signed distance, 0.5 mm if not given.
    """

    name: str
    type: str = choice(*PRIMITIVES, "mesh")
    friction: float = quantity("", 0, 5)
    size: tuple[float, ...] | None = quantity(*_SIZE, default=None)
    mass: float | None = quantity(*_MASS, default=None)
    density: float | None = quantity("kg/m^3", 10, 25000, structure=True, default=None)
    # Two objects are equal if their meshes are, wherever the files lie.
    file: str | None = dataclasses.field(default=None, compare=False)
    unit: str | None = choice("m", "cm", "mm", "in", default=None)
    repair: bool | None = None
    voxel_error: float | None = quantity("m", 5e-5, 5e-3, structure=True, default=None)


@dataclasses.dataclass(frozen=True)
class Shape(_ShapeFile):
    """An object with its mass and, if it is a mesh, the mesh; see `load`."""

    mass: float = quantity(*_MASS, default=0.0)
    mesh: "Solid | None" = dataclasses.field(default=None, metadata={"in_file": False})

    @property
    def half_sizes(self) -> tuple[float, ...]:
        """Three numbers that scale with the object [m]: `size`, or a mesh's half bounding box."""
        return self.mesh.half_sizes if self.mesh else (*(self.size or ()), 0.0, 0.0)[:3]

    @property
    def radius(self) -> float:
        """Distance of the farthest point from the centre [m]."""
        return self.mesh.radius if self.mesh else self.primitive.radius(self.half_sizes)

    @property
    def primitive(self) -> Primitive:
        """What is known of its kind; a mesh's is that of its bounding box."""
        return PRIMITIVES["box" if self.mesh else self.type]

    @property
    def upright(self) -> tuple[float, ...]:
        """Orientation on the table before the trial's yaw, a unit quaternion (w, x, y, z)."""
        return self.mesh.upright if self.mesh else self.primitive.upright

    @property
    def rest_height(self) -> float:
        """Height of its centre on the table [m]."""
        return self.mesh.rest_height if self.mesh else self.primitive.rest_height(self.half_sizes)

    @property
    def height(self) -> float:
        """Height of its highest point on the table [m]."""
        if not self.mesh:
            return 2 * self.rest_height  # half a turn about x changes no primitive
        w, x, y, z = self.upright
        up = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)]
        return self.rest_height + float((self.mesh.vertices @ up).max())


@dataclasses.dataclass(frozen=True)
class _ObjectSetFile:
    """An object file: the objects that trials take turns with, and the noise of a trial.

    Attributes:
      name: Name of the set, as in results.
      description: What the set is, in a line.
    """

    name: str
    description: str
    noise: Noise
    table: Table
    object: tuple[_ShapeFile, ...]


@dataclasses.dataclass(frozen=True)
class ObjectSet(_ObjectSetFile):
    """Shapes that the trials cycle through, in the file's order; see `load`."""

    object: tuple[Shape, ...]


def structure(objects: ObjectSet) -> ObjectSet:
    """The set without what no program depends on; its numbers are left to `schema.typical`.

    Meshes stay, and their names, by which they are refused.
    """
    unused = {"file": None, "unit": None, "repair": None, "voxel_error": None}
    shapes = tuple(
        dataclasses.replace(shape, **unused, **({} if shape.mesh else {"name": ""}))
        for shape in objects.object
    )
    return dataclasses.replace(objects, name="", description="", object=shapes)


def load(name: str | Path, *, overrides: Mapping[Any, Any] | None = None) -> ObjectSet:
    """Reads and checks an object set and its meshes.

    Args:
      name: Name of a built-in set, or a path ending in .toml.
      overrides: Values by key path that replace the file's; see `keypaths`.

    Raises:
      InputError: with every problem in the file and in its meshes.
    """
    path = library.find("objects", name)
    problems: list[str] = []
    table = library.read(path)
    changes = keypaths.flatten(overrides or {})
    places = keypaths.apply(table, changes, path.name, problems, root="objects")
    parsed = schema.parse(_ObjectSetFile, table, path.name, problems)
    problems = keypaths.as_given(problems, places)
    if parsed is None:
        raise schema.InputError(problems)
    if not parsed.object:
        problems.append(f"{path.name}.object must name at least one object")
    names = [shape.name for shape in parsed.object]
    for name in sorted({n for n in names if names.count(n) > 1}):
        problems.append(f"{path.name}.object {name}: the name is given {names.count(name)} times")
    if too_large := _size_problems(parsed, path):
        raise schema.InputError(problems + too_large)
    shapes = [_shape(shape, path, problems) for shape in parsed.object]
    if problems:
        raise schema.InputError(problems)
    found = tuple(s for s in shapes if s is not None)
    return ObjectSet(parsed.name, parsed.description, parsed.noise, parsed.table, found)


def _size_problems(given: _ObjectSetFile, path: Path) -> list[str]:
    """Why the mesh files of a set are too large to be read, if they are."""
    total = 0
    for file in [path.parent / shape.file for shape in given.object if shape.file is not None]:
        with contextlib.suppress(OSError, ValueError):  # said where it is read
            total += file.stat().st_size
    if total <= MOST_BYTES:
        return []
    return [f"{path.name}: the meshes have {total >> 20} MiB, more than {MOST_BYTES >> 20} MiB"]


def _shape(given: _ShapeFile, path: Path, problems: list[str]) -> Shape | None:
    """Checks which keys go together, and reads the mesh."""
    before, where = len(problems), f"{path.name}.object {given.name}"
    kind = given.type
    if kind == "mesh":
        missing = [k for k in ("file",) if getattr(given, k) is None]
        foreign = ["size"] if given.size is not None else []
        if (given.mass is None) == (given.density is None):
            problems.append(f"{where}: a mesh has either a mass or a density")
    else:
        missing = [k for k in ("size", "mass") if getattr(given, k) is None]
        foreign = [k for k in _MESH_KEYS if getattr(given, k) is not None]
        sizes = PRIMITIVES[kind].sizes
        if given.size is not None and len(given.size) != len(sizes):
            problems.append(
                f"{where}: size of a {kind} has {len(sizes)} values, not {len(given.size)}"
                f" ({', '.join(sizes)})"
            )
    problems += [f"{where}: {key} of a {kind} is missing" for key in missing]
    problems += [f"{where}: a {kind} has no {key}" for key in foreign]
    values = {f.name: getattr(given, f.name) for f in dataclasses.fields(given)}
    if len(problems) > before:
        return None
    return Shape(**values) if kind != "mesh" else _mesh_shape(values, path, where, problems)


def _mesh_shape(values: dict, path: Path, where: str, problems: list[str]) -> Shape | None:
    from codesign_jax.scene import meshes

    try:
        mesh = meshes.load(
            path.parent / values["file"],
            unit=values["unit"] or "m",
            repaired=bool(values["repair"]),
            voxel_error=values["voxel_error"] or 5e-4,
        )
    except schema.InputError as error:
        problems += [f"{where}: {p}" for p in error.problems]
        return None
    # Written back as a mass, so that the same file read again gives the same object.
    mass = values["density"] * mesh.volume if values["mass"] is None else values["mass"]
    if problem := schema.range_problem(f"{where}: mass", mass, *_MASS):
        problems.append(problem)
        return None
    if mesh.overhang > 0.002:
        warnings.warn(
            f"object {values['name']!r} does not stand as in its file and topples before the hand "
            f"comes: its centre of mass is {1e3 * mesh.overhang:.0f} mm beside its support; turn "
            "the mesh so that it rests on a side (z is up)",
            stacklevel=2,
        )
    return Shape(**values | {"mass": mass, "density": None, "mesh": mesh})
