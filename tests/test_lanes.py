"""Evaluation of array functions component by component, and which of its programs are shared."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import scene as scenes
from codesign_jax.compiler import launch
from codesign_jax.engines.structured import StructuredEngine, lanewise
from codesign_jax.engines.structured.kernel import Limits, Program, shared_memory
from codesign_jax.engines.structured.kernel.step import Step
from codesign_jax.engines.structured.lanewise import Lanes, lanes
from codesign_jax.engines.structured.world_model import world_constants
from scripts.shared import work
from tests.helpers import gpu_cases

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


# --- teams of lanes, a GPU's way to share a finger's work, against a lane a finger; both on a CPU--


def test_one_finger_is_one_team():
    """Teams depend on the scene's structure and the backend, and nothing on the batch."""
    paper, spheres = scenes.load("paper"), scenes.load("paper_spheres")
    fingers = tuple(dataclasses.replace(f, azimuth=f.azimuth + 20) for f in spheres.hand.finger)
    hand = dataclasses.replace(spheres.hand, finger=spheres.hand.finger + fingers)
    eight = dataclasses.replace(spheres, hand=hand)
    limits = Limits(8, 8, 1e-6)
    for the_scene, backend, want in (
        (paper, "gpu", shared_memory.TEAM),
        (paper, "cpu", 1),
        (spheres, "gpu", 1),
        (eight, "gpu", 1),
    ):
        programs = [Program(the_scene, limits, backend=backend, width=w) for w in (4, 8, 32)]
        assert {p.team for p in programs} == {want}
    program = Program(paper, limits)
    assert (program.block, program.size) == (1, 32)
    assert 4 * program.onchip.rows * program.columns <= launch.SHARED_BYTES
    pinch = Program(gpu_cases.short_scene("hull and fingers"), limits)
    assert (pinch.fingers, pinch.block, pinch.columns, pinch.size) == (2, 1, 2, 16)


def test_a_step_reads_nothing_that_it_has_not_written(monkeypatch):
    """Scratch memory that is no number when a step begins makes no number of it.

    A GPU's memory holds whatever was there before, so that a fault of this kind comes and goes.
    """
    effects = gpu_cases.EFFECTS["hull and fingers"]
    effects = {name.removeprefix("effects__"): value for name, value in effects.items()}
    small = {"effects": effects, "discretization": {"links": 3}}
    scene = scenes.load("paper_spheres", overrides=small)
    fields, ctrl = work.inputs(scene, work.make_worlds(scene, 64))
    advance = Step.advance

    def spoiled(self, *args, **how):
        for table in (self.scratch, self.onchip):
            if table is not None:
                ref = table.ref
                none = jnp.full(ref.shape[-1:], np.nan, ref.dtype)

                def spoil(row, x, ref=ref, none=none):
                    ref[row] = none
                    return x

                jax.lax.fori_loop(0, ref.shape[-2], spoil, jnp.int32(0))
        return advance(self, *args, **how)

    monkeypatch.setattr(Step, "advance", spoiled)
    # Kernels are kept by their scene and limits: nobody else has this tolerance.
    how = {"backend": "cpu", "width": 4 * shared_memory.TEAM, "team": shared_memory.TEAM}
    program = Program(scene, Limits(8, 8, 1.02e-6), **how)
    start = StructuredEngine(scene).reset(fields)
    run = jax.jit(lambda f, c: program.simulate(world_constants(scene, f), start, c))
    found, last = run(fields, ctrl[:, :5])
    moved = np.asarray(found["distance"])
    assert np.isfinite(moved).all() and (np.diff(moved, axis=1) != 0).all()
    assert np.isfinite(found["residual"]).all() and np.isfinite(last.finger).all()
    assert np.abs(np.asarray(last.grip)).max() > 0  # some start with their fingers in one another
