"""Writes the table of margins if asked to: pytest tests/stability --stability-table DIR."""

from pathlib import Path

import pytest

ROWS = pytest.StashKey[list]()


def pytest_addoption(parser):
    parser.addoption("--stability-table", type=Path, help="docs folder that gets the margins")
    parser.addoption("--stability-commit", help="commit of the code where there is no repository")


def pytest_configure(config):
    config.stash[ROWS] = []


@pytest.fixture
def rows(request):
    """Rows that this session measured."""
    return request.config.stash[ROWS]


def pytest_sessionfinish(session):
    folder = session.config.getoption("--stability-table", default=None)
    if folder and session.config.stash[ROWS]:
        from tests.stability import table

        commit = session.config.getoption("--stability-commit")
        table.write(folder, session.config.stash[ROWS], commit)
