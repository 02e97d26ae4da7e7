"""Evaluation of array functions component by component, and which of its programs are shared."""

import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured import lanewise
from codesign_jax.engines.structured.lanewise import Lanes, lanes

FINGERS, WORLDS = 4, 8


def both(rng, shape, wide=True):
    """The same numbers as an array and as lanes."""
    array = rng.standard_normal((*shape, FINGERS if wide else 1, WORLDS)).astype(np.float32)
    full = np.broadcast_to(array, (*shape, FINGERS, WORLDS))
    parts = [jnp.asarray(p.ravel()) for p in full.reshape(-1, FINGERS, WORLDS)]
    return jnp.asarray(array), lanes(parts, shape, wide=wide)


def as_array(value):
    """Lanes back as an array (..., finger, world)."""
    shape = value.parts.shape[:-2]
    parts = [np.broadcast_to(p, (FINGERS * WORLDS,)) for p in value.parts.ravel()]
    return np.stack(parts).reshape(*shape, FINGERS, WORLDS)


def scaled(factor, out=None):
    """A closure, anew at each call, of which every trace is counted."""

    def multiply(x, y):
        counted.append(factor)
        return {"product": factor * x * y, "first": x[:1], "one": jnp.ones_like(x[0])}

    return multiply


counted = []


def test_one_program_for_closures_of_one_code_over_equal_data():
    """Other data, numbers in place of lanes, and lanes that come twice are other programs."""
    counted.clear()
    rng = np.random.default_rng(0)
    (a, x), (b, y) = both(rng, (2,)), both(rng, (2,), wide=False)

    def check(factor, left, right, arrays, traces):
        found = lanewise.lanewise(scaled(factor), left, right)
        np.testing.assert_allclose(
            as_array(found["product"]), np.broadcast_to(factor * arrays[0] * arrays[1], a.shape)
        )
        np.testing.assert_array_equal(as_array(found["first"]), arrays[0][:1] + 0 * a[:1])
        assert found["one"].lane == 1.0 and len(counted) == traces

    check(2.0, x, y, (a, b), 1)
    check(2.0, x, y, (a, b), 1)
    check(2.0, *[Lanes(v.parts[::-1], v.shape, v.dtype) for v in (x, y)], (a[::-1], b[::-1]), 1)
    check(3.0, x, y, (a, b), 2)
    check(2.0, x, x, (a, a), 3)
    half = Lanes(np.array([0.5, 0.25]).reshape(2, 1, 1), x.shape, x.dtype)
    check(2.0, x, half, (a, half.parts), 4)
    assert lanewise.lanewise(jnp.multiply, half, half).parts.ravel().tolist() == [0.25, 0.0625]


def test_a_closure_over_an_array_is_traced_each_time():
    """Nobody knows what an array of JAX, or an object, will hold at the next call."""
    counted.clear()
    _, x = both(np.random.default_rng(0), (2,))
    for k in range(2):
        factor = jnp.full((2, 1, 1), 1.0 + k)
        found = lanewise.lanewise(scaled(factor), x, x)
        np.testing.assert_allclose(as_array(found["product"]), (1.0 + k) * as_array(x) ** 2)
    assert len(counted) == 2
