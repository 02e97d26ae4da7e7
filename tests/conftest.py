"""What all processes of a test session share: how XLA compiles, and a folder of its programs."""

import os
import shutil
import tempfile

from tests import quick_compile

# Selections that compile as for users: margins go into the documentation, rates are measured.
AS_FOR_USERS = ("stability", "gpu")


def pytest_configure(config):
    """Sets the environment before JAX is imported; xdist's workers and subprocesses inherit it.

    A folder that the environment already names is used: its programs are found again.
    """
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
