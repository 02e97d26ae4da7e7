"""Commands of small studies: each has one file of results and one table of a page."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scripts.shared import provenance, tables


def parser(description: str | None, name: str) -> argparse.ArgumentParser:
    """Options that all of these commands have; a command adds its own.

    Args:
      description: The module's docstring.
      name: Name of the study, and of the file where none is given.
    """
    made = provenance.parser(description)
    made.add_argument("--json", type=Path, default=Path(f"runs/{name}.json"))
    made.add_argument("--report", action="store_true", help="draw what the file holds and stop")
    made.add_argument("--page", type=Path, help="page whose table is filled in")
    return made


def main(
    args: argparse.Namespace,
    run: Callable[[argparse.Namespace], dict[str, Any]],
    table: Callable[[dict[str, Any]], str],
    mark: str,
) -> int:
    """Runs a study or reads its file, and shows its table; returns the exit status.

    Args:
      args: Arguments of a `parser`.
      run: Measures, writes the file and returns what it holds.
      table: Markdown of that.
      mark: Name of the table's marks on the page, see `tables.fill`.
    """
    text = table(json.loads(args.json.read_text()) if args.report else run(args))
    print(text)
    if args.page:
        tables.fill(args.page, text, mark)
    return 0
