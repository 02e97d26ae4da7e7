"""What all processes of a test session share: how programs compile, and a folder of them."""

import gc
import os
import shutil
import tempfile

import pytest

from tests import quick_compile

# Selections that compile as for users: margins go into the documentation, rates are measured.
AS_FOR_USERS = ("stability", "gpu")


def pytest_configure(config):
    """Sets the environment before JAX is imported; xdist's workers and subprocesses inherit it.

    A folder that the environment already names is used: its programs are found again.
    """
    # Of the millions of objects that tracing makes few are garbage: with Python's own thresholds
    # the search for it takes 4 to 7 % of the tests' time.
    gc.set_threshold(50_000, 20, 20)
    if hasattr(config, "workerinput"):
        return
    if config.option.markexpr not in AS_FOR_USERS:
        quick_compile.use()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.mkdtemp(prefix="codesign-tests-")
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    # Small programs too: JAX keeps those that take a second.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def pytest_collection_finish():
    """What was imported stays: no search for garbage looks at it again."""
    gc.freeze()


@pytest.fixture(scope="module")
def optimized_kernels():
    """Kernels as LLVM makes them for users, in modules that prove the compiler itself."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CODESIGN_KERNEL_OPTIMIZATION", "2")
        yield
