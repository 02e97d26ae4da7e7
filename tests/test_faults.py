"""The harness of `make faults`: its store goes on, its comparison can fail, its faults happen."""

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from scripts.faults import cases, damage, finished, page, shim
from scripts.faults.store import Part, Result, Store, gather
from tests.helpers import tiny_run

needs_compiler = pytest.mark.skipif(shim.compiler() is None, reason="no C compiler")


def part(campaign, first, stop, **counts):
    return Part(campaign, first, stop, counts, {"kills": 2}, {"maps": float(stop)}, [], 1.0)


def test_a_store_goes_on_after_a_kill_at_any_byte(tmp_path):
    """What was finished before the last write is there, and nothing is counted twice."""
    whole = Store(tmp_path / "whole")
    whole.start({"commit": "c"})
    for first in (0, 10, 20):
        whole.add(part("kills", first, first + 10, same=10))
    content = whole.path.read_bytes()
    before_last = content[:-1].rfind(b"\n") + 1
    for cut in (len(content), len(content) - 1, before_last + 1, before_last):
        path = tmp_path / "cut"
        path.write_bytes(content[:cut])
        store = Store(path)
        kept = 3 if cut == len(content) else 2
        left = [n for numbers in store.left("kills", 35, 4) for n in numbers]
        assert left == [*range(10 * kept, 35)], cut
        store.add(part("kills", 10 * kept, 35, same=1, lost=34 - 10 * kept))
        assert Store(path).summary("kills")["cases"] == 35
        assert not [*Store(path).left("kills", 35, 4)]
        assert [len(r) for r in Store(path).left("kills", 44, 4)] == [4, 4, 1]


def test_a_store_adds_up_and_forgets(tmp_path):
    store = Store(tmp_path / "store")
    results = {4: Result("same", tallies={"kills": 2}, most={"maps": 7}), 5: Result("lost", "why")}
    store.add(gather("kills", range(4, 6), results, {"same"}, 1.5))
    store.add(part("kills", 0, 4, same=4))
    found = Store(store.path).summary("kills")
    assert found["counts"] == {"lost": 1, "same": 5} and found["cases"] == 6
    assert found["tallies"] == {"kills": 4} and found["most"] == {"maps": 7}
    assert found["bad"] == [[5, "lost", "why"]]
    assert store.forget(lambda part: bool(part.bad)) == 1
    assert [*Store(store.path).left("kills", 6, 9)] == [range(4, 6)]


@pytest.mark.parametrize("way", damage.WAYS)
def test_every_damage_changes_what_is_read(way, tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"some bytes of a file")
    assert damage.apply(path, way)
    assert damage.content(path) != b"some bytes of a file"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return tiny_run.copied(tmp_path_factory.mktemp("faults") / "run")


def digit(path):
    text = path.read_text()
    place = max(i for i, c in enumerate(text) if c.isdigit())
    path.write_text(text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :])


def test_the_comparison_of_runs_can_fail(run, tmp_path):
    other = shutil.copytree(run, tmp_path / "run")
    assert finished.differences(other, run) == []
    digit(other / "trials.csv")
    digit(other / "hand.toml")
    (other / "tests.csv").unlink()
    (other / "figures" / "a.tmp").touch()
    expected = ["trials.csv", "tests.csv", "hand.toml", "left behind: a.tmp"]
    assert finished.differences(other, run) == expected
    newest = max((other / "checkpoints").glob("*.sha256"), key=lambda p: int(p.stem))
    shutil.rmtree(newest.with_suffix(""))
    newest.unlink()
    assert f"checkpoint {newest.stem}" in finished.differences(other, run)


PROGRAM = """
import os, sys
folder = sys.argv[1]
for k in range(3):
    with open(f"{folder}-other-{k}", "w") as file:
        file.write("x" * 10)
    try:
        with open(os.path.join(folder, f"file-{k}"), "wb", buffering=0) as file:
            file.write(b"0123456789")
        os.rename(os.path.join(folder, f"file-{k}"), os.path.join(folder, f"named-{k}"))
        os.unlink(os.path.join(folder, f"named-{k}"))
    except OSError as error:
        print(error.errno)
"""


@needs_compiler
@pytest.mark.parametrize(
    "mode, at, status, errors, left",
    [
        (shim.Mode.COUNT, 0, 0, [], []),
        (shim.Mode.KILL, 6, -signal.SIGKILL, [], [("file-1", b"01234")]),
        (shim.Mode.KILL, 7, -signal.SIGKILL, [], [("file-1", b"0123456789")]),
        (shim.Mode.FULL, 6, 0, [errno.ENOSPC] * 2, [("file-1", b"")]),
        (shim.Mode.BROKEN, 6, 0, [errno.EIO], [("file-1", b"")]),
        (shim.Mode.READ_ONLY, 8, 0, [errno.EROFS] * 2, [("named-1", b"0123456789")]),
    ],
)
def test_the_chosen_operation_meets_the_fault(mode, at, status, errors, left, library, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    variables = shim.environment(library, folder, at, mode)
    done = subprocess.run(
        [sys.executable, "-S", "-c", PROGRAM, folder],
        env=os.environ | variables,
        capture_output=True,
        text=True,
    )
    assert done.returncode == status, done.stderr
    assert [int(line) for line in done.stdout.split()] == errors
    assert [(p.name, p.read_bytes()) for p in sorted(folder.iterdir())] == left
    assert len(list(tmp_path.glob("folder-other-*"))) == (3 if status == 0 else 2)


@pytest.fixture(scope="module", name="library")
def built_library(tmp_path_factory):
    return shim.build(tmp_path_factory.mktemp("library"))


def test_the_page_has_a_row_for_each_campaign_and_the_committed_counts(tmp_path):
    rows = page.table({"starts": [], "campaigns": {}})[1:]
    assert len(rows) == len(cases.CAMPAIGNS) and all(row[page.SEEN] == "not run" for row in rows)
    bad = {"cases": 3, "counts": {"same": 2, "lost": 1}, "tallies": {"kills": 5}, "most": {}}
    row = page.table({"starts": [], "campaigns": {"kills": bad}})[1]
    assert row[page.TRIES] == "5" and "2 same, 1 lost (**broken**) of 3" in row[page.SEEN]
    committed = json.loads((page.PAGE.parent / "data" / "faults.json").read_text())
    text = page.PAGE.read_text()
    again = "python -m scripts.faults --page"
    assert all(" | ".join(row) in text for row in page.table(committed)), again
    other = tmp_path / "page.md"
    other.write_text(text.replace("| `kills` |", "| `killed` |"))
    with pytest.raises(ValueError, match="differ in killed, kills"):
        page.rows(other)


def test_the_quick_tests_that_the_page_names_are_there():
    text = "".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))
    named = {
        name for row in page.rows().values() for name in re.findall("`(.*?)`", row[page.TESTS])
    }
    assert len(named) > 20 and not [name for name in named if f"def {name}(" not in text]


def test_the_number_makes_the_case():
    """The same number is the same case, whatever ran before."""
    from scripts.faults.kills import _place

    bench = SimpleNamespace(folder=None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scripts.faults.kills.count_operations", lambda bench: 800)
        found = [_place(bench, n, 100) for n in range(300)]
    assert len(set(found[:100])) == 100 and set(found) <= {*range(1, 801)}
    assert len(set(found)) > 250
