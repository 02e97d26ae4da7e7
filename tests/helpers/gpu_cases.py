"""What the GPU suite simulates on both devices; run as a program it stores the CPU's results.

python -m tests.helpers.gpu_cases short/spheres RESULTS.npz
"""

import sys
from functools import partial

import jax
import numpy as np

from codesign_jax import cost, rollout
from codesign_jax import scene as scenes
from codesign_jax.engines.structured import StructuredEngine
from scripts.shared import work
from tests.helpers import compile_flags, differences, grasps

STEPS = 230
"""Steps of a short grasp: through the approach and the first touch into the inflation."""

EFFECTS = {
    "spheres": {},
    "no friction, rigid arm": {"effects__friction": "none", "effects__wrist": False},
    "neo-Hookean": {"effects__neo_hookean": True},
    "law of the section": {"section__law": "elements", "effects__neo_hookean": True},
    "bending only, no table, no gravity, air supply": {
        "effects__lateral_bending": False,
        "effects__twist": False,
        "effects__object_table": False,
        "effects__gravity": False,
        "effects__pressure_dynamics": True,
    },
    "hull": {"effects__surface": "hull"},
    "fingers": {"effects__finger_finger": True, "effects__air_mass": True},
    "hull and fingers": {
        "effects__surface": "hull",
        "effects__finger_finger": True,
        "effects__friction_memory": True,
    },
}
"""Settings of the scenes that are compared, by name."""

GRASPS = 384
WHOLE = {"spheres": {}, "hull and fingers": EFFECTS["hull and fingers"]}
"""Effects of the whole grasps whose verdicts are compared."""


def inputs(scene, count):
    """Model fields and controls of random worlds."""
    params, trials = grasps.random_worlds(scene, 3, count)
    return grasps.batch_inputs(scene, params, trials)


def short_scene(name):
    """A small scene: two fingers of two links, and a cylinder or household objects from meshes."""
    if name == "mesh":
        return grasps.pinch(links=2, objects="household")
    return grasps.pinch("cylinder", links=2, **EFFECTS[name])


def short(name):
    """Trace of a short grasp of five worlds, solved to rounding in float64."""
    with jax.enable_x64(True):
        scene = short_scene(name)
        fields, ctrl = inputs(scene, 5)
        engine = StructuredEngine(scene, iterations=60, evaluations=30, tolerance=1e-18)
        run = jax.jit(partial(engine.rollout, trajectory=True))
        trace = run(fields, ctrl[:, :STEPS])
        assert trace.qpos.dtype == np.float64
        return {k: np.asarray(getattr(trace, k)) for k in ("distance", "height", "qpos")}


def recorded(name):
    """Forces on the objects of a short grasp of five worlds, solved to rounding in float64."""
    with jax.enable_x64(True):
        scene = short_scene(name)
        fields, ctrl = inputs(scene, 5)
        engine = StructuredEngine(scene, iterations=60, evaluations=30, tolerance=1e-18)
        forces = jax.jit(engine.recording(touch=True).rollout)(fields, ctrl[:, :STEPS]).forces
        return {k: np.asarray(getattr(forces, k)) for k in ("finger", "palm", "table", "grip")}


def slopes(name):
    """Derivatives of eight steps of a curled hand by every group of numbers, in float64."""
    with jax.enable_x64(True):
        scene = short_scene(name)
        backend = jax.default_backend()
        case = differences.Case(scene, differences.curled(scene, 8), backend=backend)
        tables = case.many(1)
        bars = case.bars(tables, case.execute(tables), [differences.weights_of(case.start)])
        return {"slopes": case.along(bars)}


def paper(name):
    """The paper's scene with effects by name."""
    values = {key.split("__")[1]: value for key, value in WHOLE[name].items()}
    return scenes.load("paper_spheres", overrides={"effects": values})


def whole(name):
    """Costs of whole grasps in the paper's scene, in float32."""
    scene = paper(name)
    worlds = work.make_worlds(scene, GRASPS)
    engine = StructuredEngine(scene)
    outcome, _ = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t))(*worlds)
    return {"cost": np.asarray(outcome.cost), "failed": np.asarray(cost.failed(outcome.status))}


CASES = {"short": short, "recorded": recorded, "slopes": slopes, "whole": whole}


def main(case, path):
    """Stores what one case finds."""
    compile_flags.use(compile_flags.OPTIMIZED)  # XLA compiles the model fields only
    kind, name = case.split("/", 1)
    np.savez(path, **CASES[kind](name))


if __name__ == "__main__":
    main(*sys.argv[1:])
