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
    words = sys.argv[1:] if arguments is None else arguments

    def run() -> int:
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
        if problems := [f"{a[:100]!r} is no UTF-8 text" for a in bad] + reuse.problems():
            from codesign_jax.scene.schema import InputError

            raise InputError(problems)
        command = tyro.cli(
            COMMANDS,  # type: ignore[arg-type]
            args=arguments,
            prog="codesign",
            description="Co-design of hand morphology and control; --version prints the version.",
        )
        if arguments is None:
            terminal.waits.append(True)
        # Before the modules that take seconds to import.
        terminal.wait(f"codesign {type(command).__name__.lower()}: loading")
        return command.run()

    code = status.of(run)
    if arguments is None and code in (status.INTERRUPTED, status.TERMINATED):
        status.leave(code)
    return code


def _version() -> int:
    """Prints the version of the installed package."""
    try:
        terminal.say(f"codesign-jax {importlib.metadata.version('codesign-jax')}")
    except importlib.metadata.PackageNotFoundError:
        terminal.say("codesign-jax, not installed: run from its sources")
    return 0


if __name__ == "__main__":
    sys.exit(main())
