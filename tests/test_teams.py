"""Teams of lanes, a GPU's way to share a finger's work, against a lane a finger; both on a CPU."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import scene as scenes
from codesign_jax.compiler import launch
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import Limits, Program, shared_memory
from codesign_jax.engines.structured.kernel.step import Step
from codesign_jax.engines.structured.world_model import world_constants
from scripts.shared import work
from tests.helpers import gpu_cases


def test_one_finger_is_one_team():
    """Teams depend on the scene's structure and the backend, and nothing on the batch."""
    paper, spheres = scenes.load("paper"), scenes.load("paper_spheres")
    fingers = tuple(dataclasses.replace(f, azimuth=f.azimuth + 20) for f in spheres.hand.finger)
    hand = dataclasses.replace(spheres.hand, finger=spheres.hand.finger + fingers)
    eight = dataclasses.replace(spheres, hand=hand)
    limits = Limits(8, 8, 1e-6)
    for scene, backend, want in (
        (paper, "gpu", shared_memory.TEAM),
        (paper, "cpu", 1),
        (spheres, "gpu", 1),
        (eight, "gpu", 1),
    ):
        programs = [Program(scene, limits, backend=backend, width=w) for w in (4, 8, 32)]
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
        for ref in (self.scratch, self.onchip):
            if ref is not None:
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
