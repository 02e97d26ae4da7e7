"""Writes the table of margins if asked to: pytest tests/stability --stability-table DIR."""

import json
import platform
import subprocess
from pathlib import Path

import pytest

from tests.stability import table

ROWS = pytest.StashKey[list]()


def pytest_addoption(parser):
    parser.addoption("--stability-table", type=Path, help="docs folder that gets the margins")


def pytest_configure(config):
    config.stash[ROWS] = []


@pytest.fixture
def rows(request):
    """Rows that this session measured."""
    return request.config.stash[ROWS]


def pytest_terminal_summary(terminalreporter, config):
    rows = table.merge(config.stash[ROWS], [])
    if rows and config.getoption("--stability-table", default=None):
        terminalreporter.section("margins")
        terminalreporter.write(table.to_markdown(rows))


def pytest_sessionfinish(session):
    folder = session.config.getoption("--stability-table", default=None)
    new = session.config.stash[ROWS]
    if folder is None or not new:
        return
    import jax
    import mujoco

    path = folder / "data" / "stability.json"
    old = json.loads(path.read_text())["rows"] if path.exists() else []

    def known(row):
        case = table.CASES.get(row["name"])
        return case is not None and (row["step"], row["precision"]) in case.variants

    made = commit()
    for row in new:
        row["commit"] = made
    rows = table.merge(new, [r for r in old if known(r)])
    versions = {"jax": jax.__version__, "mujoco": mujoco.__version__}
    versions["python"] = platform.python_version()
    path.write_text(table.to_json({"command": "make stability", **versions, "rows": rows}))
    write_page(folder / "notes" / "stability.md", rows)


def commit():
    """The commit that is checked out, marked if the code differs from it."""
    git = ["git", "-C", str(Path(__file__).parent)]
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    if head.returncode:
        return ""
    code = [f":/{folder}" for folder in ("codesign_jax", "tests", "hands", "objects", "scripts")]
    clean = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", *code], capture_output=True)
    return head.stdout.strip() + ("" if clean.returncode == 0 else " with changes")


def write_page(page, rows):
    """Puts the table between the page's marks."""
    text = page.read_text()
    head, rest = text.split("<!-- table:begin -->")
    _, tail = rest.split("<!-- table:end -->")
    marked = f"<!-- table:begin -->\n\n{table.to_markdown(rows)}\n<!-- table:end -->"
    page.write_text(head + marked + tail)
