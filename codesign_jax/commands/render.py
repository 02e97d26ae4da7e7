"""`codesign render`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from codesign_jax.commands import common, grasp
from codesign_jax.commands.flags import Render
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import design_files, schema
from codesign_jax.terminal import Console

if TYPE_CHECKING:
    from codesign_jax.report.replay import Camera


def main(options: Render) -> int:
    common.use_compilation_cache()
    _check(options)
    camera = _camera(options.camera)
    planned = grasp.find(options)
    end = planned.case.scene.end_time
    late = [t for t in options.times if not 0 <= t <= end]
    problems = [f"--times = {t:g} is outside [0, {end:g}] s, a grasp" for t in late]
    common.refuse([schema.Problem("range", problem) for problem in problems])
    draw(planned, options, camera, Console())
    return 0


def _check(options: Render) -> None:
    problems = common.picture_problems("--out", options.out)
    if options.times and options.out.suffix != ".png":
        problems.append(
            schema.Problem(
                "unsupported", "--times are those of a strip (.png); a film shows the whole grasp"
            )
        )
    common.refuse(problems + common.number_problems(("--size", options.size, 16, 4096)))


_LIMITS = {"azimuth": ("deg", 360), "elevation": ("deg", 90), "distance": ("m", 10)}
_LIMITS |= dict.fromkeys("xyz", ("m", 10))
"""Unit and largest magnitude of the camera's numbers."""


def _camera(words: Sequence[str]) -> "Camera":
    from codesign_jax.report.animation import CAMERA, VIEWS

    camera = CAMERA
    problems = []
    numbers = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals and name in VIEWS:
            camera = VIEWS[name]
            continue
        if name not in _LIMITS:
            hint = schema.nearest(name, [*VIEWS, *_LIMITS])
            problems.append(
                schema.Problem(
                    "syntax", f"--camera {name!r} is no view and no number of a camera; {hint}"
                )
            )
            continue
        unit, most = _LIMITS[name]
        value = design_files.number(text)
        least = 0.05 if name == "distance" else -most  # MuJoCo cuts what is nearer than 1 cm
        if value is None:
            problems.append(
                schema.Problem("type", f"--camera {name}={text} must be a number [{unit}]")
            )
        elif problem := schema.range_problem(f"--camera {name}", value, unit, least, most):
            problems.append(problem)
        else:
            numbers[name] = value
    common.refuse(problems)
    coordinates = zip("xyz", camera.lookat, strict=True)
    at = tuple(numbers.pop(axis, value) for axis, value in coordinates)
    return camera._replace(lookat=at, **numbers)


def draw(planned: grasp.PlannedGrasp, options: Render, camera: "Camera", console: Console) -> None:
    with Busy(console, "compiling, then simulating the grasp"):
        shown = grasp.simulate(planned)
    from codesign_jax.report import animation

    lines = "\n".join(grasp.description(planned, shown)).split("\n")
    console.print(*lines, sep="\n")
    scene = planned.case.scene
    size = (options.size, options.size)
    with Busy(console, "drawing"):
        # A place that is named is looked at; else the camera goes with hand and object.
        named = any(word.partition("=")[0] in "xyz" for word in options.camera)
        arguments: Any = {"size": size, "camera": camera, "follow": not named}
        if options.times:
            arguments["times"] = options.times
        animation.write(scene, [shown], options.out, **arguments)
    console.print(f"picture: {options.out}")
