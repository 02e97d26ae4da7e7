"""Evaluation of array functions component by component, and which of its programs are shared."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import reuse
from codesign_jax import scene as scenes
from codesign_jax.compiler import launch
from codesign_jax.engines.structured import StructuredEngine, lanewise
from codesign_jax.engines.structured.kernel import Limits, Program, shared_memory
from codesign_jax.engines.structured.kernel.memory import MemoryLayout
from codesign_jax.engines.structured.kernel.step import Step
from codesign_jax.engines.structured.lanewise import Lanes, lanes
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import held
from scripts.shared import work
from tests.helpers import gpu_cases

counted = []


def scaled(factor):
    """A closure, anew at each call, of which every trace is counted."""

    def multiply(x, y):
        counted.append(factor)
        return {"product": factor * x * y, "first": x[:1], "one": jnp.ones_like(x[0])}

    return multiply


def test_one_program_for_closures_of_one_code_over_equal_numbers():
    """Another number, lanes that come twice, and numbers in place of lanes are other programs.

    Nobody knows what an array of JAX will hold at the next call: it is traced each time.
    """
    counted.clear()
    x, y = np.random.default_rng(0).standard_normal((2, 2, 32)).astype(np.float32)
    wide, other = (lanes([*map(jnp.asarray, v)], (2,), wide=True) for v in (x, y))
    half = Lanes(np.array([0.5, 0.25]).reshape(2, 1, 1), wide.shape, wide.dtype)
    array = jnp.full((2, 1, 1), 7.0)
    for traces, factor, left, right, expected in (
        (1, 2.0, wide, other, 2 * x * y),
        (1, 2.0, other, wide, 2 * x * y),
        (2, 3.0, wide, other, 3 * x * y),
        (3, 2.0, wide, wide, 2 * x * x),
        (4, 2.0, wide, half, 2 * x * half.parts[:, 0]),
        (5, array, wide, other, 7 * x * y),
        (6, array, wide, other, 7 * x * y),
    ):
        results = lanewise.lanewise(scaled(factor), left, right)
        product = np.stack([np.asarray(part) for part in results["product"].parts.ravel()])
        np.testing.assert_allclose(product, expected, rtol=1e-6)
        np.testing.assert_array_equal(results["first"].parts.ravel()[0], left.parts.ravel()[0])
        assert results["one"].lane == 1.0 and len(counted) == traces
    assert lanewise.lanewise(jnp.multiply, half, half).parts.ravel().tolist() == [0.25, 0.0625]


def test_rows_with_their_axes_in_another_order_are_not_packed():
    """By sizes alone centres (3, link) would pass for (link, 3)."""
    layout = MemoryLayout(True, centre=(2, (3,)))
    array = jnp.asarray(np.arange(120.0).reshape(2, 3, 4, 5))
    packed = layout.pack(4, 5, centre=array)
    np.testing.assert_array_equal(layout.unpack(packed, 4, 4, 5)["centre"], array)
    with pytest.raises(AssertionError, match="centre"):
        layout.pack(4, 5, centre=jnp.swapaxes(array, 0, 1))


# --- teams of lanes, a GPU's way to share a finger's work, against a lane a finger; both on a CPU--


def test_one_finger_is_one_team():
    """Teams depend on the scene's structure and the backend, and nothing on the batch."""
    paper = scenes.load("paper")
    spheres = scenes.load("paper_spheres")
    fingers = tuple(dataclasses.replace(f, azimuth=f.azimuth + 20) for f in spheres.hand.finger)
    hand = dataclasses.replace(spheres.hand, finger=spheres.hand.finger + fingers)
    eight = dataclasses.replace(spheres, hand=hand)
    limits = Limits(8, 8, 1e-6)
    for the_scene, backend, want in (
        (paper, "gpu", shared_memory.TEAM),
        (paper, "cpu", 1),
        (scenes.load("paper", overrides={"effects": {"surface": "spheres"}}), "gpu", 8),
        (spheres, "gpu", 1),  # its fingers do not touch one another
        (eight, "gpu", 1),
    ):
        programs = [Program(the_scene, limits, backend=backend, width=w) for w in (4, 8, 32)]
        assert {p.team for p in programs} == {want}
    program = Program(paper, limits)
    assert (program.block, program.size) == (1, 32)
    assert 4 * program.onchip.rows * program.columns <= launch.SHARED_BYTES
    pinch = Program(gpu_cases.short_scene("hull and fingers"), limits)
    assert (pinch.fingers, pinch.block, pinch.columns, pinch.size) == (2, 1, 2, 16)


@pytest.mark.slow  # 19 s
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

    def spoiled(self, *args, **kwargs):
        for table in (self.scratch, self.onchip):
            if table is not None:
                ref = table.ref
                none = jnp.full(ref.shape[-1:], np.nan, ref.dtype)

                def spoil(row, x, ref=ref, none=none):
                    ref[row] = none
                    return x

                jax.lax.fori_loop(0, ref.shape[-2], spoil, jnp.int32(0))
        return advance(self, *args, **kwargs)

    monkeypatch.setattr(Step, "advance", spoiled)
    monkeypatch.setattr(reuse, "code_digest", lambda: None)  # no kernel of the whole step is found
    # Programs are kept by their scene and limits: nobody else has this tolerance.
    options = {"backend": "cpu", "width": 4 * shared_memory.TEAM, "team": shared_memory.TEAM}
    program = Program(scene, Limits(8, 8, 1.02e-6), **options)
    start = StructuredEngine(scene).reset(fields)
    run = jax.jit(lambda f, c: program.simulate(world_constants(scene, f), start, c))
    outputs, last = run(fields, ctrl[:, :5])
    distance = np.asarray(outputs["distance"])
    assert np.isfinite(distance).all() and (np.diff(distance, axis=1) != 0).all()
    assert np.isfinite(outputs["decrement"]).all() and np.isfinite(last.finger).all()
    rows = held.rows(scene)["finger_finger"]
    assert np.abs(np.asarray(last.held[rows])).max() > 0  # some start with fingers in one another
