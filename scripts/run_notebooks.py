"""Executes every notebook in notebooks/ from a clean kernel; CODESIGN_FAST=1 shrinks them.

python -m scripts.run_notebooks --figures   # keeps their figures for the site
"""

import argparse
import base64
import functools
import io
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import jupytext
import nbclient
from nbclient.exceptions import CellExecutionError
from PIL import Image

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from scripts.site_pages import notebook_figure  # noqa: E402
from tests.helpers import compile_flags  # noqa: E402


def run(path: Path, *, keep_figures: bool) -> str | None:
    """Executes a notebook and says how long that took; returns its error, None if there is none."""
    start = time.perf_counter()
    notebook = jupytext.read(path)
    client = nbclient.NotebookClient(
        notebook,
        timeout=600,
        kernel_name="python3",
        resources={"metadata": {"path": path.parent}},
        extra_arguments=["--log-level=ERROR"],
    )
    try:
        client.execute()
    except CellExecutionError as error:
        return f"{path.name}: {error}"
    if keep_figures:
        save_figures(notebook, path.stem)
    print(f"{path.name}: {time.perf_counter() - start:.0f} s", flush=True)
    return None


def save_figures(notebook, stem: str) -> None:
    """Writes the last picture of each cell to where the site looks for it."""
    for place, cell in enumerate(notebook.cells):
        outputs = [output.get("data", {}) for output in cell.get("outputs", ())]
        pictures = [data["image/png"] for data in outputs if "image/png" in data]
        if pictures:
            target = notebook_figure(stem, place)
            target.parent.mkdir(parents=True, exist_ok=True)
            picture = Image.open(io.BytesIO(base64.b64decode(pictures[-1])))
            picture.save(target, lossless=True)


def main() -> int:
    """Runs the notebooks, and returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figures", action="store_true", help="keep figures in docs/figures")
    parser.add_argument("--workers", type=int, default=2, help="notebooks at a time")
    arguments = parser.parse_args()
    execute = functools.partial(run, keep_figures=arguments.figures)
    if os.environ.get("CODESIGN_FAST"):
        compile_flags.use()
    # The last ones take longest: first, so that neither process waits for the other at the end.
    paths = sorted((ROOT / "notebooks").glob("*.py"), reverse=True)
    with ProcessPoolExecutor(arguments.workers) as pool:
        errors = [error for error in pool.map(execute, paths) if error]
    print(*errors, sep="\n", end="", file=sys.stderr)
    return 1 if errors else 0


if __name__ == "__main__":
    sys.exit(main())
