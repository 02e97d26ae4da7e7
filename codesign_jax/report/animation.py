"""Pictures of grasps: films (.gif by Pillow, .mp4 by PyAV) and strips of MuJoCo's renderer.

Where the machine has no OpenGL, links and object are drawn with matplotlib instead, so that a
picture always exists.
"""

import functools
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from PIL import Image

from codesign_jax import files, model, rollout
from codesign_jax.engines import Engine
from codesign_jax.report import sketch
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Params, Trace, Trial

STRIP = ".png"
"""Ending of a strip of pictures; films are .gif or .mp4."""


class Camera(NamedTuple):
    """MuJoCo's free camera.

    Attributes:
      azimuth: Direction of view about the vertical, 0 along x and 90 along y [deg].
      elevation: Direction of view above the horizontal, -90 straight down [deg].
      distance: Distance from the point looked at [m].
      lookat: That point [m].
    """

    azimuth: float = 125.0
    elevation: float = -20.0
    distance: float = 0.62
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.15)


CAMERA = Camera()
VIEWS: Mapping[str, Camera] = {
    "front": Camera(azimuth=90.0, elevation=-5.0),
    "side": Camera(azimuth=180.0, elevation=-5.0),
    "top": Camera(azimuth=90.0, elevation=-89.9),
}
"""Cameras by name."""
_OBJECT_COLOR = (0.95, 0.50, 0.10)
_PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri"


class Replay(NamedTuple):
    """A grasp to be drawn.

    Attributes:
      params: Parameters of the hand, concrete arrays without leading axis.
      trial: Object and noise, likewise.
      outcome: How it ended, likewise.
      qpos: Generalized positions at every time step, shape (time, nq).
      trace: What else was recorded of it, likewise; None if that is not known.
    """

    params: Params
    trial: Trial
    outcome: Outcome
    qpos: np.ndarray
    trace: Trace | None = None


def replay(scene: Scene, engine: Engine, params: Params, trials: Trial) -> list[Replay]:
    """Simulates one hand in several trials and keeps the trajectories."""
    count = trials.yaw.shape[0]
    worlds = jax.tree.map(lambda v: jnp.broadcast_to(v, (count, *jnp.shape(v))), params)
    outcomes, trace = jax.tree.map(np.asarray, _simulate(scene, engine, worlds, trials))

    def one(tree, i: int):
        return jax.tree.map(lambda v: np.asarray(v)[i], tree)

    return [
        Replay(*(one(v, i) for v in (worlds, trials, outcomes, trace.qpos, trace)))
        for i in range(count)
    ]


@functools.partial(jax.jit, static_argnums=(0, 1))
def _simulate(scene: Scene, engine: Engine, worlds: Params, trials: Trial) -> tuple:
    return rollout.simulate(scene, engine, worlds, trials, record_qpos=True)


def frames(
    scene: Scene,
    grasp: Replay,
    times: np.ndarray,
    *,
    size: tuple[int, int] = (320, 320),
    camera: Camera = CAMERA,
) -> np.ndarray:
    """Draws a grasp at given times.

    Args:
      times: Times of the frames [s], shape (frame,).

    Returns:
      Frames, uint8, shape (frame, height, width, 3).
    """
    pictures, index = _pictures(scene, grasp, times, size, camera, opengl_backend())
    return pictures[index]


def sketches(
    scene: Scene, grasp: Replay, times: np.ndarray, *, size: tuple[int, int] = (240, 240)
) -> np.ndarray:
    """As `frames`, drawn without OpenGL: lines of fingers and object."""
    pictures, index = _pictures(scene, grasp, times, size, CAMERA, None)
    return pictures[index]


def _pictures(
    scene: Scene,
    grasp: Replay,
    times: np.ndarray,
    size: tuple[int, int],
    camera: Camera,
    way: str | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Pictures of the different states among those at some times, and which of them each time has.

    A world that was lost or failed stands still from then on: its frames are drawn once.
    """
    step = np.rint(times / scene.discretization.timestep).astype(int)
    qpos = grasp.qpos[np.clip(step, 0, len(grasp.qpos) - 1)]
    qpos, index = np.unique(qpos, axis=0, return_inverse=True)
    compiled = _visual_model(scene, grasp)
    if way is None:
        return sketch.draw(scene, compiled, qpos, int(grasp.trial.shape), size, camera), index
    return _render(compiled, qpos, size, camera, way), index


def write_film(
    scene: Scene,
    grasps: list[Replay],
    path: Path,
    *,
    frames_per_second: float | None = None,
    size: tuple[int, int] = (320, 320),
    camera: Camera = CAMERA,
    notify: Callable[[str], None] = print,
) -> Path:
    """Writes grasps side by side as a film, GIF or MP4 (H.264) by the path's ending.

    Args:
      frames_per_second: Frames of a second of simulated time, which is shown in real time; default:
        12.5 of a GIF, 25 of an MP4.
      notify: Told in one line if there is no OpenGL.

    Raises:
      ImportError: Without PyAV, which writes MP4.
    """
    _announce(notify)
    write = _write_mp4 if path.suffix == ".mp4" else _write_gif
    rate = frames_per_second or (25.0 if path.suffix == ".mp4" else 12.5)
    times, way = np.arange(0.0, scene.end_time, 1 / rate), opengl_backend()
    parts = [_pictures(scene, g, times, size, camera, way) for g in grasps]
    with files.atomically(path) as part:
        # One at a time: those of a large film together would fill the memory.
        write((np.hstack([p[i[k]] for p, i in parts]) for k in range(len(times))), part, rate)
    return path


def _write_gif(pictures: Iterator[np.ndarray], path: Path, rate: float) -> None:
    images = [Image.fromarray(picture) for picture in pictures]
    # One palette for all frames: separate ones flicker and take more space.
    palette = _common_palette(images)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # GIF counts in hundredths of a second.
    every = {"save_all": True, "append_images": indexed[1:], "loop": 0}
    indexed[0].save(path, "GIF", duration=10 * round(100 / rate), **every)


def _write_mp4(pictures: Iterator[np.ndarray], path: Path, rate: float) -> None:
    import av  # of the extra `report`

    with av.open(str(path), "w", format="mp4") as film:
        stream = film.add_stream("libx264", Fraction(rate), {"crf": "18"})
        stream.pix_fmt = "yuv420p"  # which every player has; it needs even sides
        for picture in pictures:
            odd = [(0, n % 2) for n in picture.shape[:2]]
            even = np.pad(picture, (*odd, (0, 0)), "edge")
            if not stream.codec_context.is_open:
                stream.height, stream.width = even.shape[:2]
            film.mux(stream.encode(av.VideoFrame.from_ndarray(even, "rgb24")))
        film.mux(stream.encode())


def write_strip(
    scene: Scene,
    grasps: list[Replay],
    path: Path,
    *,
    times: tuple[float, ...] | None = None,
    size: tuple[int, int] = (240, 240),
    camera: Camera = CAMERA,
    notify: Callable[[str], None] = print,
) -> Path:
    """Writes a film strip, one row a grasp, by default one frame at the end of each phase.

    Args:
      times: Times of the frames [s].
      notify: Told in one line if there is no OpenGL.
    """
    _announce(notify)
    p = scene.phases
    ends = [p.settle + t for t in (p.approach, p.inflate, p.lift, p.disturb)]
    chosen = times or (0.0, *ends, scene.end_time)
    rows = [frames(scene, g, np.array(chosen), size=size, camera=camera) for g in grasps]
    picture = np.concatenate([np.concatenate(list(row), axis=1) for row in rows])
    with files.atomically(path) as part:  # whose name does not say the kind of picture
        kind = Image.registered_extensions().get(path.suffix.lower(), "PNG")
        Image.fromarray(picture).quantize(128).save(part, kind)
    return path


def write(scene: Scene, grasps: list[Replay], path: Path, **how: Any) -> Path:
    """Writes a strip or a film, by the path's ending; see `write_strip` and `write_film`."""
    return (write_strip if path.suffix == STRIP else write_film)(scene, grasps, path, **how)


def _announce(notify: Callable[[str], None]) -> None:
    if opengl_backend() is None:
        notify(f"no OpenGL here: drawing sketches; for pictures: apt-get install {_PACKAGES}")


def _common_palette(images: list[Image.Image]) -> Image.Image:
    chosen = images[:: max(1, len(images) // 8)]
    width, height = chosen[0].size
    glued = Image.new("RGB", (width, height * len(chosen)))
    for i, image in enumerate(chosen):
        glued.paste(image, (0, i * height))
    return glued.quantize(128)


def _visual_model(scene: Scene, grasp: Replay) -> mujoco.MjModel:
    spec = model.build_spec(scene, grasp.params, grasp.trial, visual=True)
    texture, kind = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=kind.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.98],
        rgb2=[0.70, 0.77, 0.86],
        width=64,
        height=384,
    )
    spec.add_texture(
        name="board",
        type=texture.mjTEXTURE_2D,
        builtin=kind.mjBUILTIN_CHECKER,
        rgb1=[0.86, 0.84, 0.80],
        rgb2=[0.80, 0.78, 0.74],
        width=256,
        height=256,
    )
    material = spec.add_material(name="board", texrepeat=[10, 10], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "board"
    table = spec.geom("table")
    table.material, table.size = "board", [0.6, 0.6, 0.05]
    for shape in range(len(scene.objects.object)):
        rgba = spec.geom(f"object_{shape}").rgba
        spec.geom(f"object_{shape}").rgba = [*_OBJECT_COLOR, rgba[3]]
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[-0.15, 0.25, 1.0],
        castshadow=True,
        dir=[0.15, -0.25, -1.0],
        diffuse=[0.45] * 3,
        specular=[0.0] * 3,
    )
    spec.visual.headlight.ambient = [0.5] * 3
    spec.visual.headlight.diffuse = [0.25] * 3
    spec.visual.headlight.specular = [0.0] * 3
    spec.visual.quality.offsamples = 2  # a software renderer pays for every sample
    spec.stat.extent, spec.stat.center = 1.0, [0, 0, 0.15]
    spec.visual.map.znear = 0.01
    spec.visual.map.shadowclip = 1.2  # the shadow map's border leaves dots where it is in view
    return spec.compile()


@functools.cache
def opengl_backend() -> str | None:
    """The way to OpenGL that works here, tried on a small scene: EGL, OSMesa or none."""
    chosen = os.environ.get("MUJOCO_GL")
    tiny = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
    )
    for way in [chosen] if chosen else ["egl", "osmesa"]:
        try:
            _render(tiny, np.zeros((1, tiny.nq)), (16, 16), CAMERA, way)
        except subprocess.CalledProcessError:
            continue
        return way
    return None


def _render(
    compiled: mujoco.MjModel, qpos: np.ndarray, size: tuple[int, int], camera: Camera, way: str
) -> np.ndarray:
    """Renders in a child process; see `renderer`."""
    with tempfile.TemporaryDirectory() as folder:
        places = [str(Path(folder) / name) for name in ("model.mjb", "qpos.npy", "frames.npy")]
        mujoco.mj_saveModel(compiled, places[0])
        np.save(places[1], qpos)
        numbers = [str(v) for v in (*size, *camera[:3], *camera.lookat)]
        subprocess.run(
            [sys.executable, "-m", "codesign_jax.report.renderer", *places, *numbers],
            check=True,
            capture_output=True,
            env=os.environ | {"MUJOCO_GL": way, "PYOPENGL_PLATFORM": way},
        )
        return np.load(places[2], mmap_mode="r", allow_pickle=False)  # the file may be gone
