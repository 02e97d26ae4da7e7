"""`codesign replay`."""

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from codesign_jax.commands import common, failure, grasp
from codesign_jax.runs.progress import Busy
from codesign_jax.scene.schema import InputError

if TYPE_CHECKING:
    from codesign_jax.cli import Replay


def main(options: "Replay") -> int:
    """Runs the command and returns the exit status."""
    common.use_compilation_cache()
    if options.path is not None:
        if options.run_folder is not None:
            raise InputError([f"{options.path} and --run {options.run_folder}: give one of them"])
        if not options.path.is_dir():
            return failure.main(options.path, options.engine)
        options.run_folder = options.path
    if options.out is not None and options.out.suffix != ".html":
        raise InputError([f"--out {options.out} must end in .html"])
    path = options.out or _default(options.run_folder)
    common.check_place("--out", path)
    asked = grasp.find(options)
    console = Console(highlight=False, soft_wrap=True)
    places = options.episode, options.particle, options.trial, options.object
    if options.run_folder is not None and places == (None,) * 4:
        failure.show_list(options.run_folder)
    write_page(asked, path, console)
    console.print(f"replay: {path} (for any browser, offline)", markup=False)
    if options.open:
        webbrowser.open(path.resolve().as_uri())
    return 0


def _default(folder: Path | None) -> Path:
    return Path("replay.html") if folder is None else folder / "replay.html"


def write_page(asked: grasp.Asked, path: Path, console: Console) -> Path:
    """Simulates the grasp and writes its page."""
    with Busy(console, "simulating the grasp"):
        shown = grasp.simulate(asked)
    from codesign_jax.report import viewer

    lines = grasp.description(asked, shown)
    console.print("\n".join(lines), markup=False)
    return viewer.write(asked.case.scene, shown, path, title="A grasp in 3D", text=lines)
