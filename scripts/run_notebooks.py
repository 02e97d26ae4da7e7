"""Executes every notebook in notebooks/ from a clean kernel; CODESIGN_FAST=1 shrinks them."""

import sys
import time
from pathlib import Path

import jupytext
import nbclient


def main() -> int:
    """Runs the notebooks and returns the exit status."""
    folder = Path(__file__).parent.parent / "notebooks"
    for path in sorted(folder.glob("*.py")):
        start = time.perf_counter()
        notebook = jupytext.read(path)
        client = nbclient.NotebookClient(
            notebook,
            timeout=600,
            kernel_name="python3",
            resources={"metadata": {"path": folder}},
            extra_arguments=["--log-level=ERROR"],
        )
        try:
            client.execute()
        except nbclient.exceptions.CellExecutionError as error:
            print(f"{path.name}: {error}", file=sys.stderr)
            return 1
        print(f"{path.name}: {time.perf_counter() - start:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
