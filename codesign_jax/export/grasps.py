"""Grasps as files: a model of each, its controls, and the player that needs MuJoCo alone."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from codesign_jax import control, model
from codesign_jax.cost import outcome
from codesign_jax.export import plain, skin
from codesign_jax.export.play import play
from codesign_jax.judge import verdict
from codesign_jax.report.replay import Camera
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Params, Trace, Trial

PLAYER = Path(__file__).with_name("play.py")


class Grasp(NamedTuple):
    """A grasp as plain MuJoCo has it."""

    xml: str | None  # the model as MJCF, or None if MJCF cannot say it
    note: str  # why not, or nothing
    binary: mujoco.MjModel  # the compiled model with the inverse weights of the engine `mujoco`
    # Time [s] and controls of each step, shape (time, 1 + nu); see `control_columns`
    controls: np.ndarray
    # Generalized positions and velocities before each step, shape (time, nq + nv)
    states: np.ndarray
    outcome: Outcome  # what became of it, by the scene's rules


def grasp(scene: Scene, params: Params, trial: Trial) -> Grasp:
    """Builds a grasp and plays it in plain MuJoCo, for its key frames and its outcome."""
    scene, trial = plain.single_object(scene, params, trial)
    wide = _wide(params), _wide(trial)
    start = _float64(_start, scene, *wide)
    controls = timed_controls(scene, params, trial)
    spec, shares = _spec(scene, *wide)
    _light(spec)
    limits = verdict.bounds(scene)
    spec.add_numeric(name="hand_centre", data=model.layout(scene).centre_weights)
    spec.add_numeric(name="lost", data=[limits.lost_distance, limits.start, limits.end])
    spec.add_key(
        name="start", time=0.0, qpos=start, qvel=np.zeros(len(start) - 1), ctrl=controls[0, 1:]
    )
    compiled = plain.engine_model(scene, spec, shares)
    _, distance, states = play(compiled, controls)
    _add_keys(scene, spec, controls, states)
    try:
        xml = plain.text(scene, spec.copy(), shares)
        note = ""
    except plain.Inexpressible as error:
        xml = None
        note = str(error)
    return Grasp(
        xml,
        note,
        plain.engine_model(scene, spec, shares),
        controls,
        states,
        _judge(scene, distance, states, compiled.nq, trial),
    )


def world(scene: Scene, params: Params, trial: Trial) -> mujoco.MjModel:
    """The model of one world as `Grasp.binary` is, without key frames; arguments as of `grasp`."""
    scene, trial = plain.single_object(scene, params, trial)
    return plain.engine_model(scene, *_spec(scene, _wide(params), _wide(trial)))


def _spec(scene: Scene, params: Params, trial: Trial) -> tuple[mujoco.MjSpec, Mapping[str, float]]:
    """Spec of a scene with one object, and the shares of its points; see `skin.add`."""
    spec = model.build_spec(scene, params, trial, visual=True)
    skinned = scene.effects.surface == "hull"
    return spec, skin.add(scene, spec, params) if skinned else plain.NONE


def _light(spec: mujoco.MjSpec) -> None:
    """Light, sky, colours and cameras: any renderer shows the hand, none of it is physics."""
    _look(spec)
    head = spec.visual.headlight
    head.ambient = [0.3] * 3
    head.diffuse = [0.5] * 3
    head.specular = [0.1] * 3
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(
        name="sun", type=sun, pos=[0, -0.9, 1.2], dir=[0, 0.6, -0.8], diffuse=[0.5] * 3
    )
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    gradient = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    spec.add_texture(
        name="sky",
        type=sky,
        builtin=gradient,
        rgb1=[0.75, 0.85, 0.95],
        rgb2=[0.95, 0.97, 1.0],
        width=64,
        height=384,
    )
    for geom in spec.worldbody.geoms:
        if geom.name == "table":
            geom.rgba = [0.8, 0.78, 0.75, 1]


def _look(spec: mujoco.MjSpec) -> None:
    """The view of `codesign render`: a camera, and where a viewer's free camera begins."""
    camera = Camera()
    azimuth, elevation = np.radians([camera.azimuth, camera.elevation])
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * flat + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
    right = np.array([flat[1], -flat[0], 0.0])
    place = np.array(camera.lookat) - camera.distance * forward
    turn = np.empty(4)
    mujoco.mju_mat2Quat(turn, np.stack([right, np.cross(right, forward), -forward], 1).ravel())
    spec.worldbody.add_camera(name="grasp", pos=place, quat=turn)
    spec.stat.center = camera.lookat
    spec.stat.extent = camera.distance / 1.5  # where MuJoCo's free camera begins
    view: Any = spec.visual.global_
    view.azimuth = camera.azimuth
    view.elevation = camera.elevation


def timed_controls(scene: Scene, params: Params, trial: Trial) -> np.ndarray:
    """Time [s] and controls of each step of a grasp in float64, shape (time, 1 + nu)."""
    ctrl = _float64(_commands, scene, _wide(params), _wide(trial))
    return np.column_stack([np.arange(len(ctrl)) * scene.discretization.timestep, ctrl])


def _wide(tree: Any) -> Any:
    arrays = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda v: v if v.dtype == np.int32 else v.astype(float), arrays)


def _float64(program: Callable, scene: Scene, params: Params, trial: Trial) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(program(_wide(scene.bare), params, trial))


@jax.jit
def _start(scene: Scene, params: Params, trial: Trial) -> jax.Array:
    return model.model_fields(scene, params, trial).start


_commands = jax.jit(control.commands)


def _add_keys(scene: Scene, spec: mujoco.MjSpec, controls: np.ndarray, states: np.ndarray) -> None:
    """Key frames at the ends of the phases, from which a viewer may go on."""
    nq = (states.shape[1] + 1) // 2
    for name, end in [*scene.phase_ends.items()][:-1]:
        k = round(end / scene.discretization.timestep)
        if not np.isfinite(states[k]).all():
            return  # a grasp that failed has no states to go on from
        spec.add_key(
            name=f"after_{name}",
            time=controls[k, 0],
            qpos=states[k, :nq],
            qvel=states[k, nq:],
            ctrl=controls[k, 1:],
        )


def _judge(
    scene: Scene, distance: np.ndarray, states: np.ndarray, nq: int, trial: Trial
) -> Outcome:
    speed = np.abs(states[:, nq:]).max(1)
    trace = Trace(distance, states[:, nq - 5], speed, states[:, :0])
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _outcome(scene.bare, trace, 0, trial))


_outcome = jax.jit(outcome)
