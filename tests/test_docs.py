"""Pages are right: commands run, figures are those of the data, keys are complete, links lead."""

import ast
import importlib
import json
import re
import shlex
import shutil
import textwrap
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import codesign_jax
from codesign_jax import cli, preflight
from codesign_jax.commands import (
    check,
    common,
    compare,
    evaluate,
    export,
    finger,
    landscape,
    render,
    replay,
    report,
)
from codesign_jax.scene import library
from codesign_jax.studio import studio
from scripts import reference_page
from scripts.shared import evidence, provenance
from tests.helpers import command_runs
from tests.helpers.browsers import chromium, chromium_launcher  # noqa: F401
from tests.helpers.toy_engine import TINY

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / n for n in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "scripts/README.md")]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
CONTROL = ROOT / "docs" / "control.md"
SMALL = ["--particles", "3", "--trials", "3", "--episodes", "1", "--test-trials", "0"]


def examples(program):
    """Arguments of every call of a program in the pages' code blocks, without comments."""
    calls = []
    for page in PAGES:
        fenced = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), re.S | re.M)
        blocks = [text for language, text in fenced if language in ("", "bash", "sh")]
        for line in "".join(blocks).replace("\\\n", " ").splitlines():
            if not re.match(rf"([A-Z_]+=\S*\s+)*{program}\b", line):
                continue  # a tree of folders, for example
            words = shlex.split(line, comments=True)
            while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
                words = words[1:]  # variables of the environment
            if words[:1] == [program]:
                calls.append(words[1:])
    return calls


CODESIGN = list(dict.fromkeys(shlex.join(words) for words in examples("codesign")))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A working directory with the files that the examples name."""
    place = tmp_path_factory.mktemp("examples")
    shutil.copy(TINY.parent / "box.toml", place / "my_objects.toml")
    (place / "measured.csv").write_text("pressure_kPa,angle_deg\n20,18.9\n40,37.2\n")
    shutil.copy(ROOT / "codesign_jax" / "constants" / "unmeasured.toml", place / "posterior.toml")
    policy = re.search(r"^```python\n(.*?)^```", CONTROL.read_text(), re.S | re.M)
    (place / "mine.py").write_text(policy[1])
    shutil.copytree(ROOT / "docs" / "gallery", place / "docs" / "gallery")
    for name in ("demo", "ten"):
        command_runs.copied(place / "runs" / name)
    return place


@pytest.fixture
def workdir(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def here_alone(example):
    """An example's arguments, with a folder that machines share as one of the present folder.

    The run that the front page begins is read as if it had ended as the demo's.
    """
    words = [word.replace("/shared/", "shared/") for word in shlex.split(example)]
    if words[0] == "optimize":
        return words
    return [word.replace("runs/hand", "runs/demo") for word in words]


# Where a command simulates, or writes what it has simulated: owners and names.
SIMULATES = {
    "check": [(check, "tell")],
    "compare": [(compare, "compare_pair")],
    "evaluate": [
        (evaluate, name) for name in ("simulate", "other_conditions", "tell_verdict", "of_objects")
    ]
    + [(common, "cast_hands")],
    "export": [(export, "write_files")],
    "finger": [(finger, "compare")],
    "landscape": [
        (landscape, name)
        for name in ("search", "simulate_points", "summarize", "print_summary", "write_files")
    ],
    "render": [(render, "draw")],
    "replay": [(replay, "explain"), (replay, "write_page")],
    "report": [(report, "best_grasp")],
    "studio": [(studio, "serve")],
}


def question(example):
    """Command and flags of an example, without their values."""
    name, *words = shlex.split(example) or [""]
    return name, *sorted(word for word in words if word.startswith("--"))


def one_of_each(calls):
    """Examples; of those that ask the same with other values, all but the first are slow."""
    first = {question(example): example for example in reversed(calls)}.values()
    return [pytest.param(e, marks=[pytest.mark.slow] * (e not in first)) for e in calls]


@pytest.mark.parametrize("example", one_of_each(CODESIGN))
def test_every_command_goes_as_far_as_its_simulation(example, workdir, monkeypatch):
    """Scene, design and files are the example's own; nothing is compiled that places or steps."""
    arguments = here_alone(example)
    reached = []
    monkeypatch.setattr(preflight, "refusals", lambda *rest: [])  # the slow test below has it
    monkeypatch.setattr(check, "simulate", lambda *rest: ("", []))
    # The exit code is what is handed on, or made of a status.
    kept = SimpleNamespace(status=np.zeros(1, int))
    code = {"check": 0, "replay": 0, "evaluate": kept}.get(arguments[0])
    for owner, name in SIMULATES.get(arguments[0], ()):
        monkeypatch.setattr(owner, name, lambda *rest, **more: reached.append(rest) or code)
    if arguments[0] in ("optimize", "sample"):
        arguments.append("--dry-run")
    if arguments[0] == "landscape" and "--points" not in arguments:
        arguments += ["--points", "2"]  # each loads a scene
    assert cli.main(arguments) == 0
    simulates = arguments[0] != "scenes" and "--dry-run" not in arguments
    if arguments[0] == "compare":
        simulates = "--trials" in arguments
    assert bool(reached) == simulates


@pytest.mark.slow
@pytest.mark.parametrize("example", [e for e in CODESIGN if not re.search("failures|studio", e)])
def test_every_command_runs_at_a_small_size(example, workdir, monkeypatch):
    size = {"optimize": [*SMALL, "--fresh"], "evaluate": ["--trials", "3"]}
    size["export"] = ["--overwrite", "--trials", "0", "--hands", "8"]
    size["landscape"] = ["--points", "2", "--trials", "1"]
    size["sample"] = ["--designs", "2", "--trials", "1"]
    arguments = here_alone(example)
    if arguments[0] == "optimize" and "switch" in example:
        size["optimize"] = [*SMALL, "--fresh", "--episodes", "9"]
    # Two examples write this data set, and the command replaces none.
    Path("grasps.parquet").unlink(missing_ok=True)
    assert cli.main([*arguments, *size.get(arguments[0], [])]) == 0


USERS = [p for p in sorted((ROOT / "docs").glob("*.md")) if p.name != "reference.md"]
STUDIES = ("calibration", "results", "stability")


def test_the_user_s_pages_are_a_manual():
    """What was tried, and by which commit, is in docs/notes and docs/data."""
    for name in STUDIES:
        assert (ROOT / "docs" / "notes" / f"{name}.md").is_file()
    for page in (ROOT / "README.md", *USERS):
        assert not commits(page.read_text(encoding="utf-8")), page.name


def commits(text):
    """Hashes of commits: seven to forty hexadecimal digits, letters and figures among them."""
    return re.findall(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*[0-9])[0-9a-f]{7,40}\b", text)


def test_data_say_what_made_them_and_their_commands_name_no_absolute_path():
    for path in evidence.DATA.rglob("*.json"):
        made = evidence.records(json.loads(path.read_text()))
        assert made, f"{path} does not say what made it"
        for record in made:
            assert record["kernel"] and record.get("version", evidence.FIRST_VERSION), path
            words = shlex.split(record.get("command", ""))
            assert words == [provenance.portable(word) for word in words], path


# Percentages of a setting, files of data that are named without a figure, and finite elements, on
# which no simulation has a say.
UNMEASURED = (
    *("docs/meshes.md", "docs/notes/effects.md", "docs/notes/extending.md"),
    "docs/notes/section.md",
)


def has_figures(text):
    """Whether a page has a table that a study writes, names data, or states a share or a rate."""
    return re.search(r":begin -->|docs/data/\w|\d %|grasps/s|grasps a second", text) is not None


def test_every_page_with_figures_names_its_data():
    guides = ("CONTRIBUTING.md", "SECURITY.md", "scripts/README.md", *UNMEASURED)
    texts = {p.relative_to(ROOT).as_posix(): p.read_text(encoding="utf-8") for p in PAGES}
    assert {n for n, text in texts.items() if has_figures(text)} - {*guides} <= {*evidence.PAGES}
    patterns = {pattern for patterns in evidence.PAGES.values() for pattern in patterns}
    assert all(list(evidence.DATA.glob(pattern)) for pattern in patterns)


@pytest.mark.parametrize("page", evidence.PAGES)
def test_figures_of_another_version_are_marked(page):
    again = "python -m scripts.shared.evidence"
    assert (ROOT / page).read_text(encoding="utf-8") == evidence.current(page), again


MADE = {
    "the present one": ("0.2.0", {("0.2.0", "k")}, "", ""),
    "an older version": ("0.2.0", {("0.1.0", "k"), ("0.2.0", "k")}, "Some", "version 0.1.0"),
    "another kernel": ("0.2.0", {("0.2.0", "old"), ("0.2.0", "k")}, "Some", "version 0.2.0"),
    "a development version": ("0.3.0.dev0", {("0.3.0.dev0", "k")}, "The", "version 0.3.0.dev0"),
    "two versions": ("0.3.0", {("0.1.0", "a"), ("0.2.0", "b")}, "The", "versions 0.1.0 and 0.2.0"),
}


@pytest.mark.parametrize("case", MADE)
def test_a_mark_names_the_versions_of_older_figures(case):
    version, measured, share, named = MADE[case]
    page = "# Title\n\nText.\n"
    text = evidence.marked(page, evidence.mark(measured, (version, "k")))
    if named:
        assert f"*{share} figures of this page were measured with {named}; this" in text
    else:
        assert text == page
    assert evidence.marked(text, evidence.mark(measured, (version, "k"))) == text
    assert evidence.marked(text, "") == page


def test_the_kernel_is_what_computes_without_its_words(tmp_path):
    law = "codesign_jax/engines/structured/laws/contact.py"
    for source in (source for pattern in evidence.SIMULATION for source in ROOT.glob(pattern)):
        copy = tmp_path / source.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, copy)

    def changed(addition):
        text = (ROOT / law).read_text(encoding="utf-8")
        (tmp_path / law).write_text(text + addition, encoding="utf-8")
        evidence.kernel.cache_clear()
        return evidence.kernel(tmp_path)

    assert changed('\n\n# A comment.\n"A docstring."\n') == evidence.kernel()
    assert changed("\nSTIFFER = 2.0\n") != evidence.kernel()


PORTABLE = {
    "/a/b.json": "b.json",
    "--out=/a/b.json": "--out=b.json",
    "key=/a/b": "key=b",
    "/a/c=d": "c=d",
    "docs/data": "docs/data",
    "a=1": "a=1",
}


@pytest.mark.parametrize("word", PORTABLE)
def test_a_recorded_command_names_no_folder_of_a_machine(word):
    assert provenance.portable(word) == PORTABLE[word]


def links(text):
    """Files that a page links to or shows, without what lies on other hosts and in the page."""
    targets = re.findall(r"\]\(([^)\s]+)\)|^\[[^\]]+\]: (\S+)", text, re.M)
    return [a or b for a, b in targets if not re.match(r"https?:|#", a or b)]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_what_a_page_links_to_is_there(page):
    missing = [x for x in links(page.read_text()) if not (page.parent / x.split("#")[0]).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_what_an_example_imports_is_there(page):
    """Also of examples that are too slow to run."""
    fenced = re.findall(r"^( *)```python\n(.*?)^ *```", page.read_text(), re.S | re.M)
    for _, example in fenced:
        for node in ast.walk(ast.parse(textwrap.dedent(example))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("codesign_jax"):
                module = importlib.import_module(node.module)
                for name in (alias.name for alias in node.names):
                    if not hasattr(module, name):
                        importlib.import_module(f"{node.module}.{name}")


# --- the site of the documentation: the reference is up to date, links, search without a network --


BUILT_IN = {
    "Scene files": ROOT / "codesign_jax" / "scenes",
    "Hand files": ROOT / "hands",
    "Object files": ROOT / "objects",
    "Control files": ROOT / "codesign_jax" / "controls",
    "Accuracies": ROOT / "codesign_jax" / "scenes" / "accuracy",
}


def test_the_committed_reference_is_what_the_code_says():
    again = "python -m scripts.reference_page"
    assert reference_page.PAGE.read_text(encoding="utf-8") == reference_page.page(), again


def test_the_api_pages_document_the_public_names():
    """Modules by their names, what they define on the page of the module."""
    pages = sorted((ROOT / "docs" / "api").glob("*.md"))
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    on_pages = re.findall(r"^::: codesign_jax\.(\w+)", text, re.M)
    assert len(on_pages) == len(set(on_pages)) and set(on_pages) <= set(codesign_jax.__all__)
    for name in set(codesign_jax.__all__) - set(on_pages):
        module = getattr(codesign_jax, name).__module__
        assert module.split(".")[1] in on_pages, name


def make_targets(text):
    """Targets of the calls of make in a text."""
    calls = re.findall(r"\bmake ((?:[a-z][a-z-]*[ `]*)+)", text)
    return {target for call in calls for target in call.split("`")[0].split()}


def test_the_workflow_calls_targets_of_the_makefile():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    defined = set(re.search(r"^\.PHONY: (.*)", makefile, re.M)[1].split())
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    called = {t for line in re.findall(r"- run: (make .*)", workflow) for t in make_targets(line)}
    assert called == {"docs", "lint", "release", "test", "types"}
    assert called <= defined


FREE = "fixed", "group", "pressure"  # tables whose keys are names


def documented(page):
    """Keys of each kind of file on the page: (heading, table, key), with "" for the top level."""
    keys = set()
    heading = ""
    table = ""
    for line in page.splitlines():
        if line.startswith("## "):
            heading = line[3:]
            table = ""
        elif name := re.match(r"### `\[+([a-z_.]+)\]+`", line):
            table = name[1]
        elif key := re.match(r"\| `([a-z_]+)` \|", line):
            keys.add((heading, table, key[1]))
    return keys


def used(heading, table, values):
    """Keys of a TOML file as `documented` has them, without those of tables of free keys."""
    for key, value in values.items():
        rows = value if isinstance(value, list) else [value]
        if not isinstance(rows[0], dict) or key in FREE or heading == "Accuracies":
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


LISTED = {"hands": "meshes", "objects": "meshes", "controls": "control", "accuracy": "accuracy"}
"""Kinds of built-in files, and the page of docs that lists them."""


@pytest.mark.parametrize("kind", LISTED)
def test_every_built_in_file_is_named_on_its_page(kind):
    page = (ROOT / "docs" / f"{LISTED[kind]}.md").read_text(encoding="utf-8")
    names = library.available(kind)
    assert names and not [name for name in names if f"`{name}`" not in page]


@pytest.mark.browser
def test_the_site_is_read_and_searched_without_a_network(browser):
    """The one of `make docs`, which `make test-browser` makes first."""
    page = browser.new_page(viewport={"width": 1300, "height": 900})
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda r: None if r.url.startswith("file:") else complaints.append(r.url))
    page.goto((ROOT / "site" / "index.html").as_uri())
    shown = "e => e.complete && e.naturalWidth > 0"
    assert all(picture.evaluate(shown) for picture in page.locator("article img").all())
    assert page.locator("article img").count() >= 1
    # Key by key: the search listens to keys. What is filled in once its index is there goes unseen.
    page.locator("input.md-search__input").press_sequentially("shear modulus")
    page.wait_for_selector(".md-search-result__item a[href*='reference.html']", timeout=20_000)
    page.close()
    assert not complaints


@pytest.mark.browser
def test_the_gallery_s_table_sorts_by_the_column_that_is_clicked(browser):
    page = browser.new_page(viewport={"width": 1300, "height": 900})
    page.goto((ROOT / "site" / "gallery.html").as_uri())
    head = page.locator("article table thead th", has_text="kept at 100 g")
    rows = page.locator("article table tbody tr")

    def shown():
        column = head.evaluate("head => head.cellIndex")
        cells = [row.locator("td").all_inner_texts() for row in rows.all()]
        numbers = [float(row[column].rstrip(" %")) for row in cells if row[column] != "–"]
        return cells, numbers

    before, _ = shown()
    for way, falls in (("descending", True), ("ascending", False)):
        head.click()
        cells, numbers = shown()
        assert len(numbers) > 5 and numbers == sorted(numbers, reverse=falls)
        assert sorted(cells) == sorted(before) and cells != before, "rows move as a whole"
        assert head.get_attribute("aria-sort") == way
    page.close()


# --- constants by evidence ------------------------------------------------------------------------

KINDS = "measured", "chosen", "fitted"
CONSTANT = "section", "material", "palm", "wrist", "contact", "arm"
"""Tables of hand and scene files whose numbers name their kind."""


def kinds(path):
    """Kind by key of a file's constants: that of the comment in its line, or of its table."""
    kinds_by_key = {}
    table = ""
    of_table = ""
    for line in path.read_text(encoding="utf-8").splitlines():
        code, _, comment = line.partition("#")
        named = [k for k in KINDS if f"[{k}]" in comment]
        assert len(named) < 2 or not code, line
        if header := re.match(r"\[+([a-z_.]+)\]+", code):
            table = header[1]
            of_table = "".join(named)
        elif (key := re.match(r"([a-z_]+) = (?!true|false)", code)) and table in CONSTANT:
            kinds_by_key[f"{table}.{key[1]}"] = "".join(named) or of_table
    return kinds_by_key


def test_every_constant_is_measured_chosen_or_fitted():
    paths = [*(ROOT / "hands").glob("*.toml"), BUILT_IN["Scene files"] / "paper.toml"]
    of_files = {path.stem: kinds(path) for path in paths}
    assert all(of_files.values())
    assert not {(n, k) for n, keys in of_files.items() for k, v in keys.items() if v not in KINDS}
    page = (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z_.]+)` \| [^|]+ \| ([a-z]+) \|", page, re.M)
    assert dict(rows) == of_files["pneuflex4"] | of_files["paper"] and len(rows) == len(dict(rows))
