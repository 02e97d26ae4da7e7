"""Axes of what is simulated: arrays without them are refused in words, also while JAX traces."""

import dataclasses
from typing import Any

import jax
import numpy as np

from codesign_jax.scene import Scene
from codesign_jax.scene.schema import InputError, Problem
from codesign_jax.types import Params, Tip, Trial, random_key_problem

_TRIAL = Trial._make([(), (2,), (), (2,), (), (), (), (), (), (2,), None])
"""Shapes of one trial, without constants of its own."""


def refuse(scene: Scene, params: Params, trials: Trial, axes: tuple[str, str]) -> None:
    """Refuses what are no hands and trials, and those without their leading axes."""
    kinds = [
        ("params", params, Params, "space.params(design) makes those of a design"),
        ("trials", trials, Trial, "rollout.sample_trials(scene, key, count) draws some"),
    ]
    problems = [
        Problem("type", f"{name} are a {type(value).__name__}, not {kind.__name__}; {hint}")
        for name, value, kind, hint in kinds
        if not isinstance(value, kind)
    ]
    if problems:
        raise InputError(problems)
    fingers = (scene.num_fingers,)
    shapes = Params(*[fingers, fingers, fingers, (), (6,), fingers])  # type: ignore[list-item]
    problems = _problems("params", params._replace(control=None, tip=None), shapes, axes[0])
    problems += _control_problems(scene, params)
    if scene.hand.section.tapered != (params.tip is not None):
        problems.append(
            Problem("unsupported", "params.tip is for hands with section.tapered, which need it")
        )
    elif params.tip is not None:
        problems += _problems("params.tip", params.tip, Tip(fingers, fingers, fingers), axes[0])
    one_trial = _TRIAL._replace(constants=(len(scene.drawn.constant),))
    problems += _problems("trials", trials, one_trial, axes[1])
    if not problems and axes[0] == axes[1]:
        counts = len(params.length), len(trials.yaw)
        if counts[0] != counts[1]:
            words = f"params have {counts[0]} {axes[0]}s and trials {counts[1]}"
            problems = [Problem("size", words)]
    if problems:
        raise InputError(problems)


def _control_problems(scene: Scene, params: Params) -> list[str]:
    expected = {p.name: (scene.num_fingers,) * (p.per == "finger") for p in scene.control.parameter}
    shapes = {k: np.shape(v) for k, v in (params.control or {}).items()}
    if shapes.keys() != expected.keys():
        names = [", ".join(v) or "none" for v in (shapes, expected)]
        words = f"the scene's control {scene.control.name!r} needs {names[1]}"
        return [Problem("unknown", f"params.control has {names[0]}; {words}")]
    leading = np.shape(params.length)[:-1]
    return [
        Problem("size", f"params.control.{k} has shape {shapes[k]}, not {(*leading, *shape)}")
        for k, shape in expected.items()
        if shapes[k] != (*leading, *shape)
    ]


def refuse_other(scene: Any, engine: Any) -> None:
    """Refuses a scene that is not one that the engine was made for."""
    if not isinstance(scene, Scene):
        raise InputError.of(
            "type", f"scene is a {type(scene).__name__}, not a Scene; scene.load reads one"
        )
    if not hasattr(engine, "rollout"):
        hint = "make_engine('structured', scene) makes one"
        raise InputError.of("type", f"engine is a {type(engine).__name__}, not an engine; {hint}")
    engine_scene = getattr(engine, "scene", None)
    if engine_scene is None or engine_scene.structure == scene.structure:
        return
    keys = _differences(
        dataclasses.asdict(engine_scene.structure), dataclasses.asdict(scene.structure), ""
    )
    some = ", ".join(keys[:3]) + (", ..." if len(keys) > 3 else "")
    raise InputError.of(
        "unsupported",
        f"engine {engine.name} was made for a scene of another structure (other: {some}); "
        f"make_engine({engine.name!r}, scene) makes one for this scene",
    )


def _differences(first: Any, other: Any, path: str) -> list[str]:
    """Key paths in which two scenes as nested dictionaries differ."""
    if isinstance(first, dict) and isinstance(other, dict) and first.keys() == other.keys():
        below = (_differences(first[k], other[k], f"{path}.{k}" if path else k) for k in first)
        return [key for keys in below for key in keys]
    return [] if repr(first) == repr(other) else [path]


def refuse_numbers(scene: Scene, count: int, axis: str) -> None:
    """Refuses a scene's numbers that are not one or as many as there are worlds or trials."""
    for path, value in jax.tree_util.tree_leaves_with_path(scene):
        if np.ndim(value) == 1 and np.shape(value)[0] != count:
            key = jax.tree_util.keystr(path)
            raise InputError.of(
                "size",
                f"scene{key} has {np.shape(value)[0]} values, one a {axis}: there are {count}",
            )


def refuse_draws(key: Any, count: int) -> None:
    """Refuses arguments of `rollout.sample_trials` from which no trials can be drawn."""
    if not isinstance(count, int | np.integer) or count < 1:
        raise InputError.of("range", f"num_trials = {count} must be a whole number, at least 1")
    if problem := random_key_problem(key):
        raise InputError.of("type", problem)


def _problems(name: str, batch: Any, shapes: Any, axis: str) -> list[Problem]:
    array_shapes = {k: np.shape(v) for k, v in batch._asdict().items() if v is not None}
    if all(shape == getattr(shapes, k) for k, shape in array_shapes.items()):
        hint = f"jax.tree.map(lambda v: v[None], {name}) makes a batch"
        return [Problem("size", f"{name} have no axis ({axis},); of one, {hint}")]
    counts = {shape[0] for shape in array_shapes.values() if shape}
    problems = [
        Problem(
            "size",
            f"{name}.{k} has shape {shape}, not "
            f"({', '.join(map(str, (axis, *getattr(shapes, k))))})",
        )
        for k, shape in array_shapes.items()
        if not shape or shape[1:] != getattr(shapes, k)
    ]
    if not problems and len(counts) > 1:
        lengths = ", ".join(f"{k} {shape[0]}" for k, shape in array_shapes.items())
        problems = [Problem("size", f"the arrays of {name} have different lengths: {lengths}")]
    return problems
