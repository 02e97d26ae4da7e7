"""Pictures of grasps: films (.gif by Pillow, .mp4 by PyAV) and strips of pictures."""

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from codesign_jax import files
from codesign_jax.report import painter
from codesign_jax.report.replay import Camera, Replay
from codesign_jax.report.replay import replay as replay
from codesign_jax.scene import Scene

STRIP = ".png"
"""Ending of a strip of pictures; films are .gif or .mp4."""


CAMERA = Camera()
VIEWS: Mapping[str, Camera] = {
    "front": Camera(azimuth=90.0, elevation=-5.0),
    "side": Camera(azimuth=180.0, elevation=-5.0),
    "top": Camera(azimuth=90.0, elevation=-89.9),
}
"""Cameras by name."""


def frames(
    scene: Scene,
    grasp: Replay,
    times: np.ndarray,
    *,
    size: tuple[int, int] = (320, 320),
    camera: Camera | Sequence[Camera] = CAMERA,
) -> np.ndarray:
    """Draws a grasp at given times.

    Args:
      times: Times of the frames [s], shape (frame,).
      camera: One that stays, or one for each frame, as of `following`.

    Returns:
      Frames, uint8, shape (frame, height, width, 3).
    """
    return np.stack([*_pictures(scene, grasp, times, size, camera)])


def _pictures(
    scene: Scene,
    grasp: Replay,
    times: np.ndarray,
    size: tuple[int, int],
    camera: Camera | Sequence[Camera],
) -> Iterator[np.ndarray]:
    return painter.paint(scene, grasp, _steps(scene, grasp, times), size, camera)


def _steps(scene: Scene, grasp: Replay, times: np.ndarray) -> np.ndarray:
    step = np.rint(times / scene.discretization.timestep).astype(int)
    return np.clip(step, 0, len(grasp.qpos) - 1)


def following(
    scene: Scene, grasp: Replay, times: np.ndarray, camera: Camera, *, lag: float = 0.8
) -> list[Camera]:
    """Cameras that look at the middle between palm and object, at given times.

    Args:
      times: Times of the frames [s], shape (frame,).
      camera: Directions and distance of all of them.
      lag: Time around each frame over which the place looked at is a mean [s].
    """
    middle = (grasp.qpos[:, :3] + grasp.qpos[:, -7:-4]) / 2
    half = round(lag / scene.discretization.timestep / 2)
    wide = np.pad(middle, ((half, half), (0, 0)), "edge")
    window = np.ones(2 * half + 1) / (2 * half + 1)
    smooth = np.stack([np.convolve(column, window, "valid") for column in wide.T], 1)
    places = smooth[_steps(scene, grasp, times)]
    return [camera._replace(lookat=tuple(map(float, place))) for place in places]


def write_film(
    scene: Scene,
    grasps: list[Replay],
    path: Path,
    *,
    frames_per_second: float | None = None,
    size: tuple[int, int] = (320, 320),
    camera: Camera = CAMERA,
    follow: bool = False,
) -> Path:
    """Writes grasps side by side as a film, GIF or MP4 (H.264) by the path's ending.

    Args:
      frames_per_second: Frames of a second of simulated time, which is shown in real time; default:
        12.5 of a GIF, 25 of an MP4.
      follow: Whether the camera follows hand and object, as of `following`, instead of looking at
        its place.

    Raises:
      ImportError: Without PyAV, which writes MP4.
    """
    write = _write_mp4 if path.suffix == ".mp4" else _write_gif
    rate = frames_per_second or (25.0 if path.suffix == ".mp4" else 12.5)
    times = np.arange(0.0, scene.end_time, 1 / rate)
    # One at a time: those of a large film together would fill the memory.
    films = [
        _pictures(scene, grasp, times, size, _cameras(scene, grasp, times, camera, follow=follow))
        for grasp in grasps
    ]
    files.make_folder_of(path)
    with files.atomically(path) as part:
        write(map(np.hstack, zip(*films, strict=True)), part, rate)
    return path


def _cameras(
    scene: Scene, grasp: Replay, times: np.ndarray, camera: Camera, *, follow: bool
) -> Camera | list[Camera]:
    return following(scene, grasp, times, camera) if follow else camera


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
    follow: bool = False,
) -> Path:
    """Writes a film strip, one row a grasp, by default one frame at the end of each phase.

    Args:
      times: Times of the frames [s].
      follow: As of `write_film`.
    """
    p = scene.phases
    ends = [p.settle + t for t in (p.approach, p.inflate, p.lift, p.disturb)]
    chosen = np.array(times or (0.0, *ends, scene.end_time))
    rows = [
        frames(
            scene, g, chosen, size=size, camera=_cameras(scene, g, chosen, camera, follow=follow)
        )
        for g in grasps
    ]
    picture = np.concatenate([np.concatenate(list(row), axis=1) for row in rows])
    files.make_folder_of(path)
    with files.atomically(path) as part:  # whose name does not say the kind of picture
        kind = Image.registered_extensions().get(path.suffix.lower(), "PNG")
        Image.fromarray(picture).quantize(256).save(part, kind)
    return path


def write(scene: Scene, grasps: list[Replay], path: Path, **options: Any) -> Path:
    """Writes a strip or a film, by the path's ending; see `write_strip` and `write_film`."""
    return (write_strip if path.suffix == STRIP else write_film)(scene, grasps, path, **options)


def _common_palette(images: list[Image.Image]) -> Image.Image:
    chosen = images[:: max(1, len(images) // 8)]
    width, height = chosen[0].size
    glued = Image.new("RGB", (width, height * len(chosen)))
    for i, image in enumerate(chosen):
        glued.paste(image, (0, i * height))
    return glued.quantize(256)
