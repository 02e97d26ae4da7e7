"""Runs in one batch on several devices: each has the bits that it has alone on one."""

import jax
import numpy as np

from codesign_jax import codesign, scene
from codesign_jax.batch import Batch, Request, take
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.runs.checkpoint import digest
from codesign_jax.scene import parameters
from tests.helpers.toy_engine import TINY, tiny


def numbers(tree):
    """All arrays of a tree by their places."""
    leaves = jax.tree.leaves(tree)
    keys = (jax.dtypes.issubdtype(v.dtype, jax.dtypes.prng_key) for v in leaves)
    arrays = (jax.random.key_data(v) if k else v for v, k in zip(leaves, keys, strict=True))
    return {str(place): np.asarray(v) for place, v in enumerate(arrays)}


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
