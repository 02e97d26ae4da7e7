"""What is kept belongs to the code that this process imported, whatever the disk says now."""

import os
import subprocess
import sys
import types
from functools import partial

import jax
import numpy as np
import pytest

from codesign_jax import programs, sources
from codesign_jax.engines.structured import lanewise
from tests.helpers import kernels


@pytest.fixture
def code(tmp_path, monkeypatch):
    """A package of two files that was just imported, in the place of this one."""
    root = tmp_path / "code"
    for name in ("a.py", "deep/b.py", "report/c.py"):
        (root / name).parent.mkdir(exist_ok=True, parents=True)
        (root / name).write_text(name)
    monkeypatch.setattr(sources, "ROOT", root)
    imported(monkeypatch)
    yield root
    sources._read.cache_clear()


def imported(monkeypatch):
    """A process begins."""
    monkeypatch.setattr(sources, "at_import", sources._state())
    sources._read.cache_clear()


@pytest.fixture
def folder(tmp_path):
    """A folder where kernels are kept."""
    previous = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "jax"))
    yield tmp_path / "jax"
    jax.config.update("jax_compilation_cache_dir", previous)


def test_every_file_but_those_left_out_is_part_of_the_digest(code, monkeypatch):
    first = sources.digest()
    assert first
    (code / "report" / "c.py").write_text("other")
    assert sources.digest() == first
    for name, text in (("deep/b.py", "other"), ("new.py", ""), ("a.py", "more")):
        (code / name).write_text(text)
        imported(monkeypatch)
        assert sources.digest() not in (None, first)
    (code / "new.py").unlink()
    (code / "deep/b.py").write_text("deep/b.py")
    (code / "a.py").write_text("a.py")
    imported(monkeypatch)
    assert sources.digest() == first


def set_back(path):
    """Another text of the same length, with the time of the old one, as rsync and tar leave it."""
    old = path.stat()
    path.write_text(path.read_text().swapcase())
    os.utime(path, ns=(old.st_atime_ns, old.st_mtime_ns))


@pytest.mark.parametrize(
    "edit",
    [
        lambda root: (root / "a.py").write_text("edited"),
        lambda root: set_back(root / "deep" / "b.py"),
        lambda root: (root / "a.py").unlink(),
        lambda root: (root / "deep" / "new.py").write_text(""),
    ],
    ids=["edited", "same size and time", "deleted", "added"],
)
def test_code_that_changed_after_the_import_has_no_digest(code, edit):
    """Before the first kernel, and between two."""
    edit(code)
    assert sources.digest() is None


def test_a_kernel_of_code_that_changed_is_neither_kept_nor_found(code, folder, monkeypatch):
    """The next process, which imports what the disk says, must not run this one's kernel."""
    run = partial(kernels.run, rounds=7)
    x, table = kernels.numbers(2)
    jax.jit(run)(x, table)
    [first] = folder.rglob("*.kernel")
    text = (code / "a.py").read_text()
    (code / "a.py").write_text("edited")
    got = jax.jit(lambda *v: run(*v))(x, table)
    assert list(folder.rglob("*.kernel")) == [first]
    np.testing.assert_array_equal(got, jax.jit(run)(x, table))
    imported(monkeypatch)  # the next process builds a kernel of its own
    jax.jit(lambda *v: run(*v))(x, table)
    assert len(list(folder.rglob("*.kernel"))) == 2
    (code / "a.py").write_text(text)
    imported(monkeypatch)
    jax.jit(lambda *v: run(*v))(x, table)
    assert len(list(folder.rglob("*.kernel"))) == 2


def test_a_replaced_name_is_seen_until_it_is_put_back(monkeypatch):
    from codesign_jax.engines.structured.kernel import step
    from codesign_jax.engines.structured.laws import contact

    first = sources.digest()
    assert first and sources.replaced() == []
    function = next(
        v
        for v in vars(contact).values()
        if isinstance(v, types.FunctionType) and v.__module__ == contact.__name__
    )
    with monkeypatch.context() as patch:
        patch.setattr(step.Step, "advance", lambda *_: None)
        assert sources.digest() is None and len(sources.replaced()) == 1
    with monkeypatch.context() as patch:  # as IPython's autoreload does
        patch.setattr(function, "__code__", (lambda: None).__code__)
        assert sources.digest() is None and len(sources.replaced()) == 1
    assert sources.digest() == first


def test_nothing_traced_is_found_once_the_code_is_not_known(monkeypatch):
    """A function's key does not have the functions that it calls."""
    scene, built = types.SimpleNamespace(structure="s"), []
    find = programs.shared(lambda *how: built.append(how) or (lambda v: v))
    first = find(scene, "engine", scene, None)
    assert find(scene, "engine", scene, None) is first
    lanewise.of_code("a")
    lanewise._program.cache_clear()
    keep = lanewise._program.cache_info
    monkeypatch.setattr(sources, "digest", lambda: None)
    assert find(scene, "engine", scene, None) is not first and len(built) == 2

    half = lanewise.lanes([np.float32(3)], (), wide=False)
    jax.make_jaxpr(lambda: lanewise.lanewise(lambda v: v * 2, half).lane)()
    assert keep().currsize == 1
    lanewise.of_code("a")
    assert keep().currsize == 1
    for other in ("b", None, None):
        jax.make_jaxpr(lambda: lanewise.lanewise(lambda v: v * 2, half).lane)()
        lanewise.of_code(other)
        assert keep().currsize == 0


def test_another_process_has_the_same_digest():
    program = "from codesign_jax import sources; print(sources.digest())"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=sources.ROOT.parent, capture_output=True, text=True
    )
    assert done.stdout.split() == [sources.digest()], done.stderr
