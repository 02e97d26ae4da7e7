"""Object sets as data: shapes, masses, friction and the noise of a trial (paper Sec. VI.2)."""

import dataclasses
from pathlib import Path

from codesign_jax import files, schema
from codesign_jax.schema import choice, quantity

SIZES = {"box": 3, "cylinder": 2, "sphere": 1}


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations of a trial's Gaussian noise: metres, degrees and two relative values.

    The upper bounds of the relative ones keep every factor 1 + sigma z positive.
    """

    position: float = quantity("m", 0, 0.1)
    orientation: float = quantity("deg", 0, 90)
    mass: float = quantity("", 0, 0.15)
    size: float = quantity("", 0, 0.15)


@dataclasses.dataclass(frozen=True)
class Table:
    """The plane z = 0 and its friction with the object."""

    friction: float = quantity("", 0, 5)


@dataclasses.dataclass(frozen=True)
class Shape:
    """A primitive: half sizes of a box; radius, half height of a cylinder; radius of a sphere."""

    name: str
    type: str = choice(*SIZES)
    size: tuple[float, ...] = quantity("m", 0.002, 0.25)
    mass: float = quantity("kg", 0.001, 10)
    friction: float = quantity("", 0, 5)


@dataclasses.dataclass(frozen=True)
class ObjectSet:
    """Shapes that the trials cycle through, in the file's order; see `load`."""

    name: str
    description: str
    noise: Noise
    table: Table
    object: tuple[Shape, ...]


def load(name: str | Path) -> ObjectSet:
    """Reads and checks an object set.

    Args:
      name: Name of a built-in set, or a path ending in .toml.

    Raises:
      SceneError: with every problem in the file.
    """
    path = files.find("objects", name)
    problems: list[str] = []
    objects = schema.parse(ObjectSet, files.read(path), path.name, problems)
    if objects is not None:
        if not objects.object:
            problems.append(f"{path.name}.object must name at least one object")
        names = [shape.name for shape in objects.object]
        for name in sorted({n for n in names if names.count(n) > 1}):
            problems.append(
                f"{path.name}.object {name}: the name is given {names.count(name)} times"
            )
        for shape in objects.object:
            if len(shape.size) != SIZES[shape.type]:
                problems.append(
                    f"{path.name}.object {shape.name}: size of a {shape.type} has "
                    f"{SIZES[shape.type]} values, not {len(shape.size)}"
                )
    if problems or objects is None:
        raise schema.SceneError(problems)
    return objects
