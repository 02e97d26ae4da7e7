"""Scene files: read with hand, objects and an accuracy, and checked as a whole."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codesign_jax.scene import (
    buildable,
    draws,
    hand,
    key_frames,
    keypaths,
    library,
    mesh_margins,
    objects,
    rigid_bodies,
    schema,
    silicones,
)
from codesign_jax.scene.description import Scene, SceneFile
from codesign_jax.scene.primitives import PRIMITIVES
from codesign_jax.scene.tables import Accuracy, Fixture

OF_ACCURACY = ("discretization", "solver", "newton")
"""Tables of a scene that an accuracy replaces values of."""


def load(
    name: str | Path = "paper",
    *,
    hand_name: str | Path | None = None,
    object_set: str | Path | None = None,
    accuracy: str | Path | None = None,
    overrides: Mapping[Any, Any] | None = None,
) -> Scene:
    """Reads a scene with its hand and objects.

    Args:
      name: Name of a built-in scene, or a path ending in .toml.
      hand_name: Hand to use instead of the scene's.
      object_set: Object set to use instead of the scene's.
      accuracy: Named discretization and solver to use instead of the scene's: "fast",
        "standard", "fine", "reference", or a path ending in .toml; see `load_accuracy`.
      overrides: Values by key path that replace the files' and the accuracy's, nested or dotted,
        e.g. {"discretization": {"links": 5}, "hand.material.shear_modulus": 60e3}; see `keypaths`.
        That of "control" names another control: a built-in one, or a path ending in .toml.

    Raises:
      InputError: with every problem of the scene, the hand and the objects.
    """
    path = library.find("scenes", name)
    table = library.read(path)
    problems: list[str] = []
    changes = keypaths.flatten(_preset(accuracy, problems)) | keypaths.flatten(overrides or {})
    inside = {key: keypaths.below(changes, key) for key in ("hand", "objects", "control")}
    top_level = {p: v for p, v in changes.items() if p[0] not in inside or len(p) == 1}
    key_paths = keypaths.apply(table, top_level, path.name, problems)
    parsed = schema.parse(SceneFile, table, path.name, problems)
    if parsed is not None:
        _check(parsed, path.name, problems)
    problems = keypaths.as_given(problems, key_paths)
    chosen = {"hand": hand_name, "objects": object_set}
    parts = _hand_and_objects(path, table, chosen, inside, problems)
    if parsed is not None and "hand" in parts:
        parsed = _with_law(parsed, parts["hand"].material, path.name, problems)
        problems += _section_problems(parsed.effects, parts["hand"].section, path.name)
        problems = keypaths.as_given(problems, key_paths)
        # A path that the caller gives is not beside the scene's file.
        from_caller = ("control",) in top_level
        source = parsed.control if from_caller else _beside(path, parsed.control)
        try:
            parts["control"] = key_frames.load(source, parts["hand"], overrides=inside["control"])
        except schema.InputError as error:
            problems += error.problems
    if problems or parsed is None:
        raise schema.InputError(problems)
    return _completed(parsed, parts, path.name)


def _hand_and_objects(
    path: Path,
    table: Mapping[str, Any],
    chosen: Mapping[str, str | Path | None],
    overrides: Mapping[str, Any],
    problems: list[str],
) -> dict[str, Any]:
    """Hand and objects by the scene's keys: those chosen, or else those that its table names."""
    parts = {}
    for key, load_part in {"hand": hand.load, "objects": objects.load}.items():
        source = chosen[key]
        if source is None:
            if not isinstance(table.get(key), str):
                continue  # missing or of the wrong type: `parse` has said so
            source = _beside(path, table[key])
        try:
            parts[key] = load_part(source, overrides=overrides[key])
        except schema.InputError as error:
            problems += error.problems
    return parts


def _completed(parsed: SceneFile, parts: dict[str, Any], where: str) -> Scene:
    """The scene of a file and its parts, with what follows from them.

    Raises:
      InputError: with every problem between control, hand and constants.
    """
    parts["objects"] = mesh_margins.fit(parts["objects"], parts["hand"])
    law = bool(parsed.effects.neo_hookean)
    top = max((shape.height for shape in parts["objects"].object), default=0.0)
    built = buildable.buildable(parts["hand"], parsed.limits, parsed.arm, top, neo_hookean=law)
    parts["hand"] = dataclasses.replace(parts["hand"], buildable=built)
    parts["hand"] = key_frames.with_parameters(parts["hand"], parts["control"])
    names = [f.name for f in dataclasses.fields(SceneFile) if f.name not in parts]
    scene = Scene(**parts, **{n: getattr(parsed, n) for n in names})
    problems = key_frames.check(scene, "control") + _draw_problems(scene, where)
    if problems:
        raise schema.InputError(problems)
    return scene


def _draw_problems(scene: Scene, where: str) -> list[str]:
    """What is wrong with the constants that are drawn."""
    table = scene.drawn
    problems = draws.check(table, f"{where}.drawn") or draws.key_problems(scene, table, "constants")
    modulus = any(entry.key == "hand.material.shear_modulus" for entry in table.constant)
    law = silicones.LAWS[bool(scene.effects.neo_hookean)]
    if modulus and table.law not in (None, law):
        sentence = (
            f"{where}: the shear modulus of the constants is that of the law {table.law!r}, and "
            f"the scene has {law!r}"
        )
        problems.append(schema.Problem("conflict", sentence))
    return problems


def _with_law(scene: SceneFile, material: hand.Material, where: str, problems: list[str]) -> Any:
    """The scene with the bending law that its hand's modulus belongs to, if it says none itself."""
    law = scene.effects.neo_hookean
    if problem := silicones.law_problem(law, material, where):
        problems.append(problem)
    law = silicones.of_law(material.law) if law is None else law
    return dataclasses.replace(scene, effects=dataclasses.replace(scene.effects, neo_hookean=law))


def load_accuracy(name: str | Path) -> Accuracy:
    """Reads a preset of discretization and solver; its values are checked with the scene's.

    Args:
      name: Name of a built-in preset, or a path ending in .toml.

    Raises:
      InputError: with every problem of the file.
    """
    path = library.find("accuracy", name)
    problems: list[str] = []
    preset = schema.parse(Accuracy, library.read(path), path.name, problems)
    if problems or preset is None:
        raise schema.InputError(problems)
    return preset


def with_accuracy(scene: Scene, name: str | Path) -> Scene:
    """A scene with the values of an accuracy in place of its own.

    Args:
      scene: The scene, checked; whether its other numbers go together with these is not.
      name: As of `load_accuracy`.

    Raises:
      InputError: with every problem of the preset's file.
    """
    tables = {key: getattr(scene, key) for key in OF_ACCURACY}
    preset = load_accuracy(name)
    return dataclasses.replace(
        scene,
        **{key: dataclasses.replace(t, **getattr(preset, key)) for key, t in tables.items()},
    )


def accuracy_name(scene: Scene) -> str:
    """Name of the built-in accuracy whose values a scene has; empty if it has those of none."""
    names = library.available("accuracy")
    return next((name for name in names if with_accuracy(scene, name) == scene), "")


def _preset(name: str | Path | None, problems: list[str]) -> dict[str, dict[str, Any]]:
    """Overrides of an accuracy; none without a name or with problems."""
    if name is None:
        return {}
    try:
        preset = load_accuracy(name)
    except schema.InputError as error:
        problems += error.problems
        return {}
    return {key: getattr(preset, key) for key in OF_ACCURACY}


def _beside(path: Path, name: str) -> str | Path:
    # Relative to the scene's file, whatever the working directory holds.
    return path.parent / name if name.endswith(".toml") else name


def _check(scene: SceneFile, where: str, problems: list[str]) -> None:
    problems += check_together(scene, where)
    problems += buildable.problems(scene.limits, where)
    for fixture in scene.fixture:
        problems += _fixture_problems(fixture, f"{where}.fixture {fixture.name}")
    if scene.discretization.hull_points % 4:
        sentence = (
            f"{where}.discretization.hull_points = {scene.discretization.hull_points} "
            "must be a multiple of 4: every side of the section has as many"
        )
        problems.append(schema.Problem("size", sentence))


def _fixture_problems(fixture: Fixture, where: str) -> list[str]:
    sizes = PRIMITIVES[fixture.type].sizes if fixture.type in PRIMITIVES else ()
    problems = []
    if len(fixture.position) != 3:
        problems.append(schema.Problem("size", f"{where}: position must have three coordinates"))
    if len(fixture.size or ()) != len(sizes):
        words = f"{len(sizes)} values ({', '.join(sizes)})" if sizes else "no size"
        problems.append(
            schema.Problem(
                "size", f"{where}: a {fixture.type} has {words}, not {list(fixture.size or ())}"
            )
        )
    if fixture.orientation and (why := rigid_bodies.orientation_problem(fixture.orientation)):
        problems.append(schema.Problem("size", f"{where}: orientation {why}"))
    return problems


def check_together(scene: SceneFile, where: str) -> list[str]:
    """Returns what is wrong with numbers that are each in range, but do not go together."""
    problems = []
    p = scene.phases
    h = scene.discretization.timestep
    times = [("approach", p.approach), ("inflate", p.inflate), ("lift", p.lift)]
    times += [("disturb", p.disturb), ("ungrasp", p.ungrasp)]
    for (first, a), (second, b) in zip(times, times[1:], strict=False):
        if not a < b:
            problems.append(
                schema.Problem(
                    "order", f"{where}.phases.{second} = {b:g} s must come after {first} = {a:g} s"
                )
            )
    if p.ungrasp < p.disturb + p.deflate_time:
        sentence = (
            f"{where}.phases.deflate_time = {p.deflate_time:g} s does not fit between "
            f"disturb = {p.disturb:g} s and ungrasp = {p.ungrasp:g} s"
        )
        problems.append(schema.Problem("order", sentence))
    if scene.effects.lateral_threshold and not scene.effects.lateral_bending:
        sentence = (
            f"{where}.effects.lateral_threshold = true resists sideways bending, which "
            "effects.lateral_bending = false leaves out"
        )
        problems.append(schema.Problem("unsupported", sentence))
    if scene.effects.air_mass and scene.effects.lateral_threshold:
        sentence = (
            f"{where}.effects.air_mass = true has a volume that sideways bending does not change, "
            "which effects.lateral_threshold = true says it does"
        )
        problems.append(schema.Problem("unsupported", sentence))
    if scene.effects.air_mass and scene.effects.section_growth:
        sentence = (
            f"{where}.effects.air_mass = true has chambers that pressure does not enlarge, which "
            "effects.section_growth = true says it does"
        )
        problems.append(schema.Problem("unsupported", sentence))
    if isinstance(scene, Scene):
        problems += key_frames.check(scene, f"{where}.control")
        law = silicones.law_problem(scene.effects.neo_hookean, scene.hand.material, where)
        problems += [law] if law else []
        problems += _section_problems(scene.effects, scene.hand.section, where)
    if isinstance(scene, Scene) and round(scene.end_time / h) != scene.num_steps:
        sentence = (
            f"{where}.phases ends after {scene.end_time:g} s: the number of steps is structure, "
            f"{scene.num_steps} of {h:g} s"
        )
        problems.append(schema.Problem("unsupported", sentence))
    return problems


def _section_problems(effects: Any, section: Any, where: str) -> list[schema.Problem]:
    """Effects that the law of a hand's section has, or cannot have."""
    if section.law == "chamber":
        return []
    reasons = {
        ("neo_hookean", False): "has neo-Hookean walls, also at large strain",
        ("lateral_threshold", True): "has the taut fabric's resistance itself",
        ("air_mass", True): "has a chamber that grows with its pressure as well as with the bend",
    }
    problems = []
    for (name, value), reason in reasons.items():
        if getattr(effects, name) == value:
            sentence = (
                f"{where}.effects.{name} = {str(value).lower()} stands against hand.section.law = "
                f'"elements", which {reason}'
            )
            problems.append(schema.Problem("conflict", sentence))
    return problems
