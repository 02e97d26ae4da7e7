"""The site of the documentation: the reference is up to date, links, search without a network."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from scripts import reference_page
from tests.helpers.browsers import chromium, chromium_launcher  # noqa: F401

ROOT = Path(__file__).parent.parent
BUILT_IN = {
    "Scene files": ROOT / "codesign_jax" / "scenes",
    "Hand files": ROOT / "hands",
    "Object files": ROOT / "objects",
    "Control files": ROOT / "codesign_jax" / "controls",
    "Presets of accuracy": ROOT / "codesign_jax" / "scenes" / "accuracy",
}


def test_the_committed_reference_is_what_the_code_says():
    again = "python -m scripts.reference_page"
    assert reference_page.PAGE.read_text(encoding="utf-8") == reference_page.page(), again


FREE = "fixed", "group", "pressure"  # tables whose keys are names


def documented(page):
    """Keys of each kind of file on the page: (heading, table, key), with "" for the top level."""
    found, heading, table = set(), "", ""
    for line in page.splitlines():
        if line.startswith("## "):
            heading, table = line[3:], ""
        elif name := re.match(r"### `\[+([a-z_.]+)\]+`", line):
            table = name[1]
        elif key := re.match(r"\| `([a-z_]+)` \|", line):
            found.add((heading, table, key[1]))
    return found


def used(heading, table, values):
    """Keys of a TOML file as `documented` has them, without those of tables of free keys."""
    for key, value in values.items():
        rows = value if isinstance(value, list) else [value]
        if not isinstance(rows[0], dict) or key in FREE or heading.startswith("Presets"):
            yield heading, table, key
            continue
        for row in rows:
            yield from used(heading, f"{table}.{key}".lstrip("."), row)


@pytest.mark.parametrize("heading", BUILT_IN)
def test_every_key_of_the_built_in_files_is_in_the_reference(heading):
    on_page = documented(reference_page.PAGE.read_text(encoding="utf-8"))
    files = sorted(BUILT_IN[heading].glob("*.toml"))
    keys = {key for f in files for key in used(heading, "", tomllib.loads(f.read_text("utf-8")))}
    assert files and keys and not keys - on_page


def build(root, place):
    """Runs the recipe of `make docs` on a checkout."""
    flags = re.search(r"\$\(BIN\)/mkdocs (.*)", (ROOT / "Makefile").read_text())[1].split()
    command = [sys.executable, "-m", "mkdocs", *flags, "--site-dir", place]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    place = tmp_path_factory.mktemp("site")
    done = build(ROOT, place)
    assert not done.returncode, done.stderr
    return place


@pytest.mark.browser
def test_the_site_is_read_and_searched_without_a_network(site, browser):
    page, complaints = browser.new_page(viewport={"width": 1300, "height": 900}), []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda r: None if r.url.startswith("file:") else complaints.append(r.url))
    page.goto((site / "index.html").as_uri())
    shown = "e => e.complete && e.naturalWidth > 0"
    assert all(picture.evaluate(shown) for picture in page.locator("article img").all())
    assert page.locator("article img").count() >= 1
    # Key by key: the search listens to keys. What is filled in once its index is there goes unseen.
    page.locator("input.md-search__input").press_sequentially("shear modulus")
    page.wait_for_selector(".md-search-result__item a[href*='reference.html']", timeout=20_000)
    page.close()
    assert not complaints
