"""Object sets as data: shapes, masses, friction and the noise of a trial (paper Sec. VI.2).

>>> from codesign_jax import objects
>>> [(shape.name, shape.mass) for shape in objects.load("paper").object]  # kg
[('cuboid', 0.05), ('cylinder', 0.05), ('sphere', 0.05)]
"""

import contextlib
import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from codesign_jax.scene import keypaths, rigid_bodies, schema
from codesign_jax.scene.primitives import PRIMITIVES, Primitive
from codesign_jax.scene.schema import choice, quantity, table

if TYPE_CHECKING:  # trimesh and SciPy take a while to import; sets of primitives need neither
    from codesign_jax.scene.meshes import Solid

MOST_BYTES = 1 << 25
"""Largest size of a set's mesh files together; those of the set household have 0.4 MB."""
_MESH_KEYS = ("file", "unit", "repair", "voxel_error")
_MASS = ("kg", 0.001, 10.0)
_SIZE = ("m", 0.002, 0.25)


@table
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
      tilt: Of the object's rotation about x and about y.
      mass: Of the object's mass, relative.
      size: Of the object's size, relative.
      friction: Of the friction of all contacts, relative.
      stiffness: Of the fingers' shear modulus, relative.
      hand_mass: Of the masses of fingers and palm, relative.
      mass_range: Not a standard deviation: an additional factor on the mass is drawn log-uniformly
        between 1 and this value; 1 switches it off.
    """

    position: float = quantity("m", 0, 0.1)
    orientation: float = quantity("deg", 0, 90)
    mass: float = quantity("", 0, 0.15)
    size: float = quantity("", 0, 0.15)
    tilt: float = quantity("deg", 0, 180, default=0.0)
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


@table
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
      orientation: How it is put on the table, before the trial's noise: roll, pitch and yaw, which
        turn about x, y and z in this order, or a unit quaternion w, x, y, z. Not given: as in its
        file; a capsule lies.
      pose: Instead of `orientation`: `"stable"` for the pose in which it comes to rest most often,
        `"stable:2"` for the second of them.
      mass: Mass; or give `density` instead.
      density: Density.
      inertia: Inertia about the centre of mass in the axes of its file: xx, yy and zz. For a mesh,
        or if `centre_of_mass` is given, xy, xz and yz may follow. It needs `mass`. Not given: that
        of a homogeneous body about its centre.
      centre_of_mass: Centre of mass in the frame of its file; for a primitive, from its centre, and
        the primitive is then simulated as a mesh. Not given: that of a homogeneous body.
      file: Mesh file, beside the object file if the path is relative.
      unit: Unit of the mesh file's numbers, metres if not given.
      repair: Whether to repair a mesh.
      voxel_error: Bound on the error of a mesh's signed distance, 0.5 mm if not given.
    """

    name: str
    type: str = choice(*PRIMITIVES, "mesh")
    friction: float = quantity("", 0, 5)
    size: tuple[float, ...] | None = quantity(*_SIZE, default=None)
    orientation: tuple[float, ...] | None = quantity(
        "deg or quaternion", -360, 360, structure=True, default=None
    )
    pose: str | None = None
    mass: float | None = quantity(*_MASS, default=None)
    density: float | None = quantity("kg/m^3", 10, 25000, structure=True, default=None)
    inertia: tuple[float, ...] | None = quantity("kg m^2", -1, 1, structure=True, default=None)
    centre_of_mass: tuple[float, ...] | None = quantity(
        "m", -0.5, 0.5, structure=True, default=None
    )
    # Two objects are equal if their meshes are, wherever the files lie.
    file: str | None = dataclasses.field(default=None, compare=False)
    unit: str | None = choice("m", "cm", "mm", "in", default=None)
    repair: bool | None = None
    voxel_error: float | None = quantity("m", 5e-5, 5e-3, structure=True, default=None)


@table
@dataclasses.dataclass(frozen=True)
class Shape(_ShapeFile):
    """An object with its mass and, if it is a mesh, the mesh; see `load`."""

    mass: float = quantity(*_MASS, default=0.0)
    own_inertia: tuple[float, ...] | None = dataclasses.field(
        default=None, metadata={"in_file": False}
    )
    """Principal inertia per mass [m^2] of a primitive whose file gives one."""
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
        """Record of the object's primitive; for a mesh, of its bounding box."""
        return PRIMITIVES["box" if self.mesh else self.type]

    @property
    def upright(self) -> tuple[float, ...]:
        """Orientation on the table before the trial's noise, a unit quaternion (w, x, y, z)."""
        if self.orientation is not None:
            return rigid_bodies.turned(self.orientation, self._base)
        return self._base if self.mesh else self.primitive.upright

    @property
    def _base(self) -> tuple[float, ...]:
        return self.mesh.upright if self.mesh else (1.0, 0.0, 0.0, 0.0)

    @property
    def unit_inertia(self) -> tuple[float, ...]:
        """Principal inertia per mass [m^2]."""
        if self.mesh:
            return self.mesh.inertia
        return self.own_inertia or self.primitive.inertia(self.half_sizes)

    def rest_height(self, up: Any) -> Any:
        """Height of its centre on a table whose normal in its frame is `up` [m].

        Args:
          up: Three numbers, or arrays of one shape, which the result has.
        """
        if not self.mesh:
            return self.primitive.reach(self.half_sizes, up)
        points = self.mesh.hull.T.reshape(3, -1, *[1] * np.ndim(up[0]))
        return -(points[0] * up[0] + points[1] * up[1] + points[2] * up[2]).min(0)

    @property
    def height(self) -> float:
        """Height of its highest point on the table [m]."""
        up = np.array(rigid_bodies.up(self.upright))
        return float(self.rest_height(up) + self.rest_height(-up))

    @functools.cached_property
    def fall(self) -> tuple[int, float]:
        """By how much it turns on the table [deg] and sinks [m] before it rests, without noise."""
        return rigid_bodies.fall(self.rest_height, rigid_bodies.up(self.upright))

    def resting(self) -> list[rigid_bodies.Resting]:
        """The poses in which it rests, the most probable first."""
        from codesign_jax.scene.meshes import support

        if self.mesh:
            points = self.mesh.support  # on which it stands
        else:
            points = support.support_points(self.primitive.triangles(self.half_sizes).vertices)
        return rigid_bodies.stable(points, self.unit_inertia, self._base)


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


@table
@dataclasses.dataclass(frozen=True)
class ObjectSet(_ObjectSetFile):
    """Shapes that the trials cycle through, in the file's order; see `load`."""

    object: tuple[Shape, ...]


def structure(objects: ObjectSet) -> ObjectSet:
    """The set without what no program depends on.  Meshes stay, and the names of refused ones."""
    unused = dict.fromkeys(("file", "unit", "repair", "voxel_error", "inertia", "centre_of_mass"))
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
    problems: list[str] = []
    table, path, key_paths = keypaths.read("objects", name, overrides, problems)
    parsed = schema.parse(_ObjectSetFile, table, path.name, problems)
    problems = keypaths.as_given(problems, key_paths)
    if parsed is None:
        raise schema.InputError(problems)
    if not parsed.object:
        problems.append(
            schema.Problem("missing", f"{path.name}.object must name at least one object")
        )
    names = [shape.name for shape in parsed.object]
    for name in sorted({n for n in names if names.count(n) > 1}):
        problems.append(
            schema.Problem(
                "conflict",
                f"{path.name}.object {name}: the name is given {names.count(name)} times",
            )
        )
    if too_large := _size_problems(parsed, path):
        raise schema.InputError(problems + too_large)
    shapes = [_shape(shape, path, problems) for shape in parsed.object]
    if problems:
        raise schema.InputError(problems)
    shapes_read = tuple(s for s in shapes if s is not None)
    return ObjectSet(parsed.name, parsed.description, parsed.noise, parsed.table, shapes_read)


def _size_problems(object_set: _ObjectSetFile, path: Path) -> list[str]:
    total = 0
    for file in [path.parent / shape.file for shape in object_set.object if shape.file is not None]:
        with contextlib.suppress(OSError, ValueError):  # said where it is read
            total += file.stat().st_size
    if total <= MOST_BYTES:
        return []
    return [f"{path.name}: the meshes have {total >> 20} MiB, more than {MOST_BYTES >> 20} MiB"]


def _key_problems(entry: _ShapeFile, where: str) -> list[str]:
    """Problems with keys that do not go together."""
    problems = []
    kind = entry.type
    if (entry.mass is None) == (entry.density is None):
        problems.append(
            schema.Problem("conflict", f"{where}: a {kind} has either a mass or a density")
        )
    if entry.inertia is not None and entry.mass is None:
        problems.append(
            schema.Problem("conflict", f"{where}: inertia goes with a mass, not with a density")
        )
    if entry.pose is not None and entry.orientation is not None:
        problems.append(schema.Problem("conflict", f"{where}: give either orientation or pose"))
    if entry.orientation is not None and (
        why := rigid_bodies.orientation_problem(entry.orientation)
    ):
        problems.append(schema.Problem("size", f"{where}: orientation {why}"))
    if entry.centre_of_mass is not None and len(entry.centre_of_mass) != 3:
        problems.append(
            schema.Problem("size", f"{where}: centre_of_mass must have three coordinates")
        )
    if kind == "mesh":
        missing = ["file"] if entry.file is None else []
        foreign = ["size"] if entry.size is not None else []
    else:
        missing = ["size"] if entry.size is None else []
        foreign = [k for k in _MESH_KEYS if getattr(entry, k) is not None]
        sizes = PRIMITIVES[kind].sizes
        if entry.size is not None and len(entry.size) != len(sizes):
            sentence = (
                f"{where}: size of a {kind} has {len(sizes)} values, not {len(entry.size)}"
                f" ({', '.join(sizes)})"
            )
            problems.append(schema.Problem("size", sentence))
        shifted = entry.centre_of_mass is not None
        if entry.inertia is not None and any(entry.inertia[3:]) and not shifted:
            problems.append(
                schema.Problem(
                    "size", f"{where}: inertia of a {kind} is xx, yy and zz in its own axes"
                )
            )
    problems += [
        schema.Problem("missing", f"{where}: {key} of a {kind} is missing") for key in missing
    ]
    problems += [schema.Problem("unknown", f"{where}: a {kind} has no {key}") for key in foreign]
    return problems


def _shape(entry: _ShapeFile, path: Path, problems: list[str]) -> Shape | None:
    """The object of a table; None with problems, which are added to the others."""
    where = f"{path.name}.object {entry.name}"
    kind = entry.type
    if key_problems := _key_problems(entry, where):
        problems += key_problems
        return None
    values = {f.name: getattr(entry, f.name) for f in dataclasses.fields(entry)}
    try:
        if kind == "mesh":
            shape = _mesh_shape(values, path, where, problems)
        elif entry.centre_of_mass is not None:
            shape = _off_centre(values, path, where, problems)
        else:
            shape = _primitive(values)
    except schema.InputError as error:  # a density that makes no mass within its range
        problems += [p.told(f"{where}: {p.removeprefix('shape.')}") for p in error.problems]
        return None
    if shape is None:
        return None
    if entry.inertia is not None:
        why = rigid_bodies.inertia_problem(entry.inertia, shape.mass, shape.radius)
        problems += [f"{where}: inertia {why}"] if why else []
    if entry.pose is not None:
        resting = rigid_bodies.chosen(entry.pose, shape.resting)
        if isinstance(resting, str):
            problems.append(
                schema.Problem("range", f"{where}: pose = {schema.shown(entry.pose)} {resting}")
            )
            return None
        # Written back as an orientation, so that another trimesh reads the same object.
        shape = dataclasses.replace(shape, pose=None, orientation=resting.orientation)
    return shape


def _off_centre(
    values: dict[str, Any], path: Path, where: str, problems: list[str]
) -> Shape | None:
    """A primitive as the mesh of its surface, which may have its centre of mass anywhere."""
    primitive = PRIMITIVES[values["type"]]
    size = (*values["size"], 0.0, 0.0)[:3]
    content = primitive.triangles(size).export(file_type="stl")
    if values["orientation"] is None and values["pose"] is None:
        values = values | {"orientation": primitive.upright}
    mesh = {"type": "mesh", "file": f"{values['type']}.stl", "unit": "m", "size": None}
    return _mesh_shape(values | mesh, path, where, problems, content)


def _primitive(values: dict[str, Any]) -> Shape:
    primitive = PRIMITIVES[values["type"]]
    size = (*values["size"], 0.0, 0.0)[:3]
    mass = values["mass"]
    inertia = values["inertia"]
    if mass is None:
        mass = values["density"] * primitive.volume(size)
    own_inertia = inertia and tuple(v / mass for v in inertia[:3])
    changed: dict[str, Any] = {"mass": mass, "density": None, "own_inertia": own_inertia}
    return Shape(**values | changed)


def _mesh_shape(
    values: dict[str, Any],
    path: Path,
    where: str,
    problems: list[str],
    content: bytes | None = None,
) -> Shape | None:
    from codesign_jax.scene import meshes

    mass, inertia, centre = (values[key] for key in ("mass", "inertia", "centre_of_mass"))
    given_inertia = inertia if inertia is not None and len(inertia) in (3, 6) else None
    try:
        mesh = meshes.load(
            path.parent / values["file"],
            unit=values["unit"] or "m",
            repaired=bool(values["repair"]),
            voxel_error=values["voxel_error"] or 5e-4,
            centre=None if centre is None else np.array(centre),
            tensor=None if given_inertia is None else rigid_bodies.tensor(given_inertia) / mass,
            content=content,
        )
    except schema.InputError as error:
        problems += [p.told(f"{where}: {p}") for p in error.problems]
        return None
    # Written back as a mass, so that the same file read again gives the same object.
    mass = values["density"] * mesh.volume if mass is None else mass
    changed: dict[str, Any] = {"mass": mass, "density": None, "mesh": mesh}
    return Shape(**values | changed)
