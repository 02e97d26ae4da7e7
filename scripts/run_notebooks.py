"""Executes every notebook in notebooks/ from a clean kernel; CODESIGN_FAST=1 shrinks them."""

import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import jupytext
import nbclient
from nbclient.exceptions import CellExecutionError

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from tests.helpers import compile_flags  # noqa: E402


def run(path: Path) -> str | None:
    """Executes a notebook and says how long that took; returns its error, None if there is none."""
    start = time.perf_counter()
    client = nbclient.NotebookClient(
        jupytext.read(path),
        timeout=600,
        kernel_name="python3",
        resources={"metadata": {"path": path.parent}},
        extra_arguments=["--log-level=ERROR"],
    )
    try:
        client.execute()
    except CellExecutionError as error:
        return f"{path.name}: {error}"
    print(f"{path.name}: {time.perf_counter() - start:.0f} s", flush=True)
    return None


def main() -> int:
    """Runs the notebooks, two at a time as they mostly compile, and returns the exit status."""
    if os.environ.get("CODESIGN_FAST"):
        compile_flags.use()
    # The last ones take longest: first, so that neither process waits for the other at the end.
    paths = sorted((ROOT / "notebooks").glob("*.py"), reverse=True)
    with ProcessPoolExecutor(2) as pool:
        errors = [error for error in pool.map(run, paths) if error]
    print(*errors, sep="\n", end="", file=sys.stderr)
    return 1 if errors else 0


if __name__ == "__main__":
    sys.exit(main())
