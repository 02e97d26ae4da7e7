"""The `codesign` command.  Heavy modules are imported after its flags are parsed."""

import importlib.metadata
import os
import sys
import warnings

import tyro

from codesign_jax import reuse, terminal
from codesign_jax.commands import status
from codesign_jax.commands.flags import (
    Check,
    Compare,
    Evaluate,
    Export,
    Finger,
    Landscape,
    Optimize,
    Render,
    Replay,
    Report,
    Sample,
    Scenes,
    Studio,
)

COMMANDS = (
    Optimize
    | Evaluate
    | Compare
    | Check
    | Landscape
    | Sample
    | Report
    | Replay
    | Studio
    | Render
    | Export
    | Finger
    | Scenes
)
"""The commands, in the order of the help text."""


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line, runs the command and returns the exit status.

    0: done; 1: it failed on the way; 2: the input was refused and nothing was created;
    130 and 143: stopped by SIGINT or SIGTERM, everything saved.

    Args:
      arguments: Arguments without the program's name; default: those of the process.
    """
    code = status.of(lambda: run(arguments))
    if arguments is None and code in (status.INTERRUPTED, status.TERMINATED):
        status.leave(code)
    return code


def run(arguments: list[str] | None = None) -> int:
    """Runs a command and returns its exit status; unlike `main` it lets errors through.

    Args:
      arguments: As of `main`.

    Raises:
      InputError: The input is refused.
    """
    words = sys.argv[1:] if arguments is None else arguments
    terminal.tolerate(sys.stdout)  # the parser of flags prints too
    if arguments is None:
        # XLA's alarm of a compilation of two minutes reads like a crash; what fails is raised.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
        # Matplotlib refuses to be imported if it names nothing; pictures need no window.
        os.environ.pop("MPLBACKEND", None)
        warnings.showwarning = lambda text, *_: terminal.say(f"warning: {text}", error=True)
    if words == ["--version"]:
        return _version()
    bad = [a for a in words if a.encode(errors="replace").decode() != a]
    problems = [f"{a[:100]!r} is no UTF-8 text" for a in bad] + reuse.problems()
    if problems := problems + mode_problems():
        from codesign_jax.scene.schema import InputError, Problem

        raise InputError([Problem("unsupported", problem) for problem in problems])
    command = tyro.cli(
        COMMANDS,  # type: ignore[arg-type]
        args=arguments,
        prog="codesign",
        description="Co-design of hand morphology and control; --version prints the version.",
    )
    command.words = words
    if arguments is None:
        terminal.waits.append(True)
    # Before the modules that take seconds to import.
    terminal.wait(f"codesign {type(command).__name__.lower()}: loading")
    return command.run()


_ON = {"y", "yes", "t", "true", "on", "1"}
"""What JAX takes for yes."""
MODES = {
    "JAX_DISABLE_JIT": (_ON, "kernels run within compiled programs"),
    "JAX_ENABLE_X64": (_ON, "the commands simulate in float32, but for engine mujoco (float64)"),
    "JAX_NUMPY_DTYPE_PROMOTION": ({"strict"}, "types are promoted in many places"),
    "JAX_NUMPY_RANK_PROMOTION": ({"raise"}, "ranks are promoted in many places"),
    "JAX_TRANSFER_GUARD": (
        {"disallow", "disallow_explicit"},
        "numbers of a scene are given to programs in many places",
    ),
}
"""Modes of JAX, mostly for debugging, in which the commands fail: their values, and why."""


def mode_problems() -> list[str]:
    """Environment variables that ask for one of `MODES`, which somebody set for other programs."""
    return [
        f"{name} = {value} asks for a mode of JAX in which this command fails: {why}; leave it out"
        for name, (values, why) in MODES.items()
        if (value := os.environ.get(name, "").lower()) in values
    ]


def _version() -> int:
    """Prints the version of the installed package."""
    try:
        terminal.say(f"codesign-jax {importlib.metadata.version('codesign-jax')}")
    except importlib.metadata.PackageNotFoundError:
        terminal.say("codesign-jax, not installed: run from its sources")
    return 0


if __name__ == "__main__":
    sys.exit(main())
