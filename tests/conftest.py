"""What all processes of a test session share: how programs compile, and a folder of them."""

import gc
import os
import shutil
import tempfile

import pytest

from tests.helpers import compile_flags

# Selections that compile as for users: margins go into the documentation, rates are measured, and
# slow tests run longer than they compile; some hard cases hold by what optimised code rounds.
AS_FOR_USERS = ("stability", "gpu", "slow")


def pytest_configure(config):
    """Sets the environment before JAX is imported; xdist's workers and subprocesses inherit it.

    A folder that the environment already names is used: its programs are found again.
    """
    # Of the millions of objects that tracing makes few are garbage: with Python's own thresholds
    # the search for it takes 4 to 7 % of the tests' time.
    gc.set_threshold(50_000, 20, 20)
    if hasattr(config, "workerinput"):
        return
    # The first word decides: "slow and not gpu" selects slow tests.
    if config.option.markexpr.partition(" ")[0] not in AS_FOR_USERS:
        compile_flags.use()
    folder = tempfile.mkdtemp(prefix="codesign-tests-")
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    os.environ["CODESIGN_TESTS_FOLDER"] = folder  # see command_runs.py
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", folder)
    # Grids of meshes and rates of runs: shared as well, and never those of the user.
    os.environ["XDG_CACHE_HOME"] = os.path.join(folder, "xdg")
    # Small programs too: JAX keeps those that take a second.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


# Files of more than five seconds, the longest first: what is left for the end is short, so that no
# worker waits for the other. Before them a file with planted faults, which forgets what was traced.
LONG = """
test_planted_contacts test_resume test_policy test_export test_docs test_finger test_buildable
test_containment test_engines test_rollout test_constants test_worth test_studies test_library
test_codesign test_section_joints test_optimizers test_compare test_showing test_rings test_steps
test_energy test_particle_filter test_kernel test_parameters test_meshes test_contact test_attacks
test_run_reading test_hard_cases test_rigid_bodies test_forces test_sample test_runs test_reverse
test_user_code test_cost test_scene test_air test_key_frames test_section test_report test_model
test_planted_faults test_checkpoint test_cli test_studio test_compiler test_reuse
""".split()


def pytest_collection_modifyitems(items):
    """Begins with the longest files; xdist keeps this order with --no-loadscope-reorder."""
    place = {name: number for number, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONG)))


def pytest_collection_finish():
    """What was imported stays: no search for garbage looks at it again."""
    gc.freeze()


def pytest_sessionfinish():
    """One search for garbage at the end, whose errors pytest tells of.

    pytest and JAX would search the millions of objects of a whole session nine times more.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module")
def optimized_kernels():
    """Kernels as LLVM makes them for users, in modules that prove the compiler itself."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CODESIGN_KERNEL_OPTIMIZATION", "2")
        yield
