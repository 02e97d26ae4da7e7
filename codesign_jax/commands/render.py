"""`codesign render`."""

from typing import TYPE_CHECKING

from rich.console import Console

from codesign_jax.commands import common, grasp
from codesign_jax.runs.progress import Busy
from codesign_jax.scene import schema
from codesign_jax.scene.schema import InputError

if TYPE_CHECKING:
    from codesign_jax.cli import Render


def main(options: "Render") -> int:
    """Runs the command and returns the exit status.

    Raises:
      InputError: If something is wrong with the input.
    """
    common.use_compilation_cache()
    _check(options)
    asked = grasp.find(options)
    end = asked.case.scene.end_time
    late = [t for t in options.times if not 0 <= t <= end]
    if late:
        raise InputError([f"--times {t:g} is outside [0, {end:g}] s, a grasp" for t in late])
    draw(asked, options, Console(highlight=False, soft_wrap=True))
    return 0


def _check(options: "Render") -> None:
    problems = []
    if options.out.suffix not in (".gif", ".png"):
        problems.append(f"--out {options.out} must end in .gif or .png")
    if options.times and options.out.suffix == ".gif":
        problems.append("--times are those of a strip (.png); a .gif shows the whole grasp")
    problem = schema.range_problem("--size", options.size, "pixels", 16, 4096)
    if problems or problem:
        raise InputError([*problems, *([problem] if problem else [])])
    common.check_place("--out", options.out)


def draw(asked: grasp.Asked, options: "Render", console: Console) -> None:
    """Simulates the grasp and draws it."""
    with Busy(console, "simulating the grasp"):
        shown = grasp.simulate(asked)
    from codesign_jax.report import animation

    console.print("\n".join(grasp.description(asked, shown)), markup=False)
    scene, size = asked.case.scene, (options.size, options.size)
    with Busy(console, "drawing"):
        if options.out.suffix == ".gif":
            animation.write_gif(scene, [shown], options.out, size=size, notify=console.print)
        else:
            times = options.times or None
            animation.write_strip(
                scene, [shown], options.out, times=times, size=size, notify=console.print
            )
    console.print(f"picture: {options.out}", markup=False)
