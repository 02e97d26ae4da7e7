"""Runs in one batch on several devices: each has the bits that it has alone on one."""

import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from codesign_jax import codesign, scene
from codesign_jax.batch import Batch, Request, take
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.runs.checkpoint import digest
from codesign_jax.scene import parameters
from tests.helpers.command_runs import stored
from tests.helpers.toy_engine import TINY, tiny

RUN = [
    *("optimize", "--scene", str(TINY), "--particles", "10", "--trials", "2", "--episodes", "2"),
    *("--optimizer", "particle-filter"),
    *("--test-trials", "2", "--reference-trials", "0"),
    *(
        "--set",
        *(f"effects.{pair}=false" for pair in ("finger_table", "palm_table", "palm_object")),
    ),
]

TWO_DEVICES = """
import sys
import jax
jax.config.update("jax_num_cpu_devices", 2)
from codesign_jax import batch, cli
from codesign_jax.engines.structured import StructuredEngine

seen, call, lanes = [], batch.Batch.call, StructuredEngine.block_lanes

def spy(self, blocks, common, device):
    seen.append((device.id, jax.tree.leaves(blocks)[0].shape[0]))
    return call(self, blocks, common, device)

batch.Batch.call = spy
# As on a GPU, where a smaller batch has narrower blocks.
StructuredEngine.block_lanes = lambda self, worlds: lanes(self, worlds) // (1 if worlds > 20 else 2)
run, folder = sys.argv[2:], sys.argv[1]
assert cli.main([*run, "--seeds", "0-2", "--out", folder + "/many"]) == 0
assert {device for device, _ in seen} == {0, 1}, seen
print("shares", *[count for _, count in seen[:2]], "end")
joined = sum(count for _, count in seen[:2])
seen.clear()
assert cli.main([*run, "--seed", "1", "--devices", "1", "--out", folder + "/one"]) == 0
assert {device for device, _ in seen} == {0}, seen
assert seen[0][1] > joined / 3, "its blocks are narrower, and there are more of them"
"""


def numbers(tree):
    """All arrays of a tree by their places."""
    leaves = jax.tree.leaves(tree)
    keys = (jax.dtypes.issubdtype(v.dtype, jax.dtypes.prng_key) for v in leaves)
    arrays = (jax.random.key_data(v) if k else v for v, k in zip(leaves, keys, strict=True))
    return {str(place): np.asarray(v) for place, v in enumerate(arrays)}


@pytest.mark.slow  # quick: the same with one device in the place of two, below
def test_runs_on_two_devices_are_those_of_one_run_on_one(tmp_path):
    """By the kernel, whose blocks are cut without regard to runs, and are narrower for one run."""
    command = [sys.executable, "-c", TWO_DEVICES, str(tmp_path), *RUN]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 devices" in done.stdout
    shares = [int(n) for n in done.stdout.split("shares")[1].split("end")[0].split()]
    # Of a run at least two blocks, and an odd number of all: the middle run is cut.
    assert shares[0] == shares[1] + 1 and sum(shares) % 3 == 0
    assert stored(tmp_path / "many" / "seed-1") == stored(tmp_path / "one")
    assert stored(tmp_path / "many" / "seed-2") != stored(tmp_path / "one")


def test_shares_of_joined_runs_are_those_of_one_run(monkeypatch):
    """By the kernel, on one device that stands for two: the middle run of three is cut.

    Beside them calls of one run each: the limit has room for 39 grasps, and a run has 20.
    """
    contacts = ("finger_table", "palm_table", "palm_object")
    the_scene = scene.load(TINY, overrides={f"effects.{pair}": False for pair in contacts})
    space = parameters.design_space(the_scene.hand, "2d")
    optimizer = codesign.make_filter(space)
    task = codesign.Task(the_scene, space, 2, StructuredEngine(the_scene))
    shares, call = [], Batch.call

    def spy(self, blocks, *rest):
        shares.append(jax.tree.leaves(blocks)[0].shape[0])
        return call(self, blocks, *rest)

    def episodes(batch):
        """States and reports of two episodes of three runs."""
        keys, found = map(jax.random.key, range(3)), []
        states = [optimizer.init(key, space.default(), 10) for key in keys]
        for _ in range(2):
            found.append(batch([Request(state, np.ones(2, bool)) for state in states]))
            states = [state for state, _ in found[-1]]
        return found

    monkeypatch.setattr(Batch, "call", spy)
    with monkeypatch.context() as patch:
        patch.setattr("codesign_jax.batch.take", lambda count: 2 * take(1))
        joined = episodes(Batch(task, optimizer))
    first, second = shares[:2]
    assert first == second + 1 and (first + second) % 3 == 0
    shares.clear()
    alone = episodes(Batch(task, optimizer, limit=39))
    assert {3 * share for share in shares} == {first + second}
    assert digest(numbers(joined)) == digest(numbers(alone))
    assert np.ptp([float(info.selection.mean_cost) for _, info in joined[-1]]) > 0


def test_a_test_of_few_particles_runs_beside_episodes():
    """Requests of two sizes in one call: each has the answer that it has alone, in its place."""
    the_scene, space, engine = tiny()
    optimizer = codesign.make_optimizer("screened-es", space)
    task = codesign.Task(the_scene, space, 2, engine)
    keys = jax.random.split(jax.random.key(5), 3)
    requests = [
        Request(*codesign.closed(optimizer, space.sample(key, count), key))
        for key, count in zip(keys, (3, 6, 3), strict=True)
    ]
    together = Batch(task, optimizer)
    together.compile(requests[0], 3)
    for request, (_, info) in zip(requests, together(requests), strict=True):
        [(_, alone)] = together([request])
        np.testing.assert_array_equal(info.population, request.state.particles)
        np.testing.assert_array_equal(info.outcomes.cost, alone.outcomes.cost)
