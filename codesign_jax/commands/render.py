"""`codesign render`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console

from codesign_jax.commands import common, grasp
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import schema

if TYPE_CHECKING:
    from codesign_jax.cli import Render
    from codesign_jax.report.animation import Camera


def main(options: "Render") -> int:
    """Runs the command and returns the exit status."""
    common.use_compilation_cache()
    _check(options)
    camera = _camera(options.camera)
    asked = grasp.find(options)
    end = asked.case.scene.end_time
    late = [t for t in options.times if not 0 <= t <= end]
    common.refuse([f"--times {t:g} is outside [0, {end:g}] s, a grasp" for t in late])
    draw(asked, options, camera, common.console())
    return 0


def _check(options: "Render") -> None:
    problems = common.picture_problems("--out", options.out)
    if options.times and options.out.suffix != ".png":
        problems.append("--times are those of a strip (.png); a film shows the whole grasp")
    common.refuse(problems + common.number_problems(("--size", options.size, 16, 4096)))


_LIMITS = {"azimuth": ("deg", 360), "elevation": ("deg", 90), "distance": ("m", 10)}
_LIMITS |= dict.fromkeys("xyz", ("m", 10))
"""Unit and largest magnitude of the camera's numbers."""


def _camera(words: Sequence[str]) -> "Camera":
    """The camera that --camera names: a view, and numbers that replace its own."""
    from codesign_jax.report.animation import CAMERA, VIEWS

    camera, problems = CAMERA, []
    for word in sorted(words, key=lambda word: "=" in word):  # numbers replace those of the view
        name, given, text = word.partition("=")
        if not given and name in VIEWS:
            camera = VIEWS[name]
        elif name not in _LIMITS:
            hint = schema.nearest(name, [*VIEWS, *_LIMITS])
            problems.append(f"--camera {name!r} is no view and no number of a camera; {hint}")
        elif not given:
            problems.append(f"--camera {name} must say {name}=NUMBER")
        else:
            problem, value = _number(name, text)
            if problem:
                problems.append(problem)
            elif name in "xyz":
                at = list(camera.lookat)
                at["xyz".index(name)] = value
                camera = camera._replace(lookat=tuple(at))
            else:
                camera = camera._replace(**{name: value})
    common.refuse(problems)
    return camera


def _number(name: str, text: str) -> tuple[str | None, float]:
    unit, most = _LIMITS[name]
    try:
        value = float(text)
    except ValueError:
        return f"--camera {name}={text} must be a number [{unit}]", 0.0
    least = 0.05 if name == "distance" else -most  # MuJoCo cuts what is nearer than 1 cm
    return schema.range_problem(f"--camera {name}", value, unit, least, most), value


def draw(asked: grasp.Asked, options: "Render", camera: "Camera", console: Console) -> None:
    """Simulates the grasp and draws it."""
    with Busy(console, "simulating the grasp"):
        shown = grasp.simulate(asked)
    from codesign_jax.report import animation

    console.print("\n".join(grasp.description(asked, shown)))
    scene, size = asked.case.scene, (options.size, options.size)
    with Busy(console, "drawing"):
        how: Any = {"size": size, "camera": camera, "notify": console.print}
        if options.out.suffix == animation.STRIP:
            animation.write_strip(scene, [shown], options.out, times=options.times or None, **how)
        else:
            animation.write_film(scene, [shown], options.out, **how)
    console.print(f"picture: {options.out}")
