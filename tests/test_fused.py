"""The rollout kernel: component-wise evaluation, assembly, and equality with the batch engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import control, model
from codesign_jax.engines.structured import StructuredEngine, elimination
from codesign_jax.engines.structured.fused import Limits, Program, ptx
from codesign_jax.engines.structured.hand import hand_lanes
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from tests import small

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


def test_components_equal_arrays():
    """Eliminating a joint gives the same bits either way."""
    rng = np.random.default_rng(0)
    node = [both(rng, s) for s in ((6, 6), (6, 6), (6, 6), (6,), (6,))]
    axes, arm, tau = both(rng, (3, 6)), both(rng, (3,)), both(rng, (3,), wide=False)

    def step(node, axes, arm, tau):
        # A positive definite matrix, so that the joint's is invertible.
        eye = 6.0 * jnp.eye(6)[:, :, None, None]
        p = eye + 0.1 * (node[0] + jnp.swapaxes(node[0], 0, 1))
        quadratic = elimination.Quadratic(p, *node[1:])
        return elimination.eliminate(lambda f, *a: f(*a), quadratic, axes, arm**2 + 1.0, tau)

    want = step([n[0] for n in node], axes[0], arm[0], tau[0])
    got = lanewise(step, [n[1] for n in node], axes[1], arm[1], tau[1])
    got = jax.tree.leaves(got, is_leaf=lambda x: isinstance(x, Lanes))
    for a, b in zip(jax.tree.leaves(want), got, strict=True):
        # XLA may fuse a multiplication with an addition: a few units in the last place.
        np.testing.assert_allclose(as_array(b), a, rtol=2e-5, atol=2e-5)


def test_sums_over_lanes_are_refused():
    """Lanes do not see each other."""
    _, x = both(np.random.default_rng(0), (3,))
    with pytest.raises(NotImplementedError, match="over the lanes"):
        lanewise(lambda v: v.sum(1), x)


@pytest.fixture(scope="module")
def grasp():
    """A pinch scene, three random worlds of it and 230 steps of their controls."""
    scene = small.pinch("cylinder", links=2)
    params, trials = small.random_worlds(scene, 3, 3)
    fields = jax.vmap(lambda p, t: model.model_fields(scene, p, t))(params, trials)
    ctrl = jax.vmap(lambda p, t: control.commands(scene, p, t))(params, trials)
    return scene, fields, ctrl[:, :230]


def test_kernel_equals_the_engine(grasp):
    """The kernel, interpreted, and the batch engine on the way to the object and in contact."""
    scene, fields, ctrl = grasp
    engine = StructuredEngine(scene, iterations=16, evaluations=10, tolerance=1e-7)
    program = Program(scene, Limits(16, 10, 1e-7), block=4)
    run = jax.jit(
        lambda f, c: program.run(hand_lanes(scene, f), engine.reset(f), c, interpret=True)
    )
    got = run(fields, ctrl)
    with jax.default_matmul_precision("highest"):
        want = jax.jit(lambda f, c: engine._rollout(f, c, False))(fields, ctrl)
    # Both stop at a decrement of 1e-7; what is left grows over 230 steps in float32.
    np.testing.assert_allclose(got["distance"], want.distance, atol=1e-4)
    np.testing.assert_allclose(got["height"], want.height, atol=1e-4)
    assert float(got["iterations"].max()) > 1.5  # something touched
    assert float(got["residual"].max()) < 1e-6


def test_kernel_becomes_ptx(grasp):
    """Every operation of the kernel has its instruction; what has none is named."""
    scene, fields, ctrl = grasp
    program = Program(scene, Limits(8, 8, 1e-6))
    engine = StructuredEngine(scene)
    lowered = (
        jax.jit(lambda f, c: program.run(hand_lanes(scene, f), engine.reset(f), c))
        .trace(fields, ctrl)
        .lower(lowering_platforms=("cuda",))
        .as_text()
    )
    assert "__gpu$xla.gpu.ptx" in lowered and "fma.rn.f32" in lowered
    jaxpr = jax.make_jaxpr(jnp.tanh)(1.0)
    with pytest.raises(NotImplementedError, match="tanh"):
        ptx.Assembler().run(jaxpr.jaxpr, [], [ptx.Value("f32", "%f0")])


def test_state_tables_give_the_states_back(grasp):
    """Packed and unpacked, three worlds in blocks of four and two fingers: the same numbers."""
    scene, fields, _ = grasp
    engine, program = StructuredEngine(scene), Program(scene, Limits(8, 8, 1e-6), block=4)
    state = engine.reset(fields)
    rng = np.random.default_rng(0)
    state = jax.tree.map(lambda v: jnp.asarray(rng.standard_normal(v.shape), v.dtype), state)
    again = program.unpack_state(*program.pack_state(state), fields.start.shape[0])
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
