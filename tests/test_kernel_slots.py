"""How a kernel counts its slots, and where it keeps what belongs to a slot."""

import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import scene
from codesign_jax.engines.structured.kernel.counts import Counts
from codesign_jax.engines.structured.kernel.memory import MemoryLayout
from codesign_jax.engines.structured.kernel.tables import Tables


@pytest.mark.parametrize(("rows", "most"), [(11, 16), (3, 88), (41, 64), (1, 2**30), (2, 1)])
def test_counts_are_those_that_were_packed(rows, most):
    """In one integer and in many, up to the largest number, of all lanes and of some."""
    rng = np.random.default_rng(rows)
    counts = rng.integers(0, most + 1, (rows, 32)).astype(np.int32)
    counts[:, 0], counts[:, 1] = most, 0
    busy = rng.random(32) < 0.5
    packed = Counts.of_rows([jnp.asarray(c) for c in counts], most)
    for row, expected in enumerate(counts):
        np.testing.assert_array_equal(packed.of(row), expected)
        np.testing.assert_array_equal(packed.masked(busy).of(jnp.int32(row)), expected * busy)


def test_a_table_by_item_has_a_place_for_everything():
    """No two numbers share a row, no row is left over, and an item's numbers are neighbours."""
    groups = {"a": (3, (2,)), "set.b": (3, (1,)), "c": (2, ()), "d": (3, ()), "set.e": (3, (2, 2))}
    table, rows = MemoryLayout.by_item(True, **groups), {}
    for name, (count, shape) in groups.items():
        for item in range(count):
            first = table.offset[name] + item * table.stride[name]
            rows[name, item] = list(range(first, first + int(np.prod(shape))))
    assert sorted(sum(rows.values(), [])) == list(range(table.rows))
    for item in range(3):
        for names in (("a", "d"), ("set.b", "set.e")):
            own = sorted(sum((rows[name, item] for name in names), []))
            assert own == list(range(own[0], own[0] + len(own)))


def test_only_gpus_have_an_item_for_lanes_without_a_contact():
    """Lanes of a CPU's vector read a slot's item together, whether they have filled it or not."""
    here = {
        name: {s.name: s for s in Tables(scene.load("paper"), backend=name, width=32).sets}
        for name in ("cpu", "gpu")
    }
    cpu, gpu = (here[backend]["finger_finger"] for backend in ("cpu", "gpu"))
    assert not cpu.gathers
    assert gpu.gathers
    assert gpu.count == cpu.count + 1 == cpu.rows * (cpu.slots + 1) + 1
