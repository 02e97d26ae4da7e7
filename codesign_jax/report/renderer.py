"""Renders frames in a process of its own: python -m codesign_jax.report.renderer MODEL QPOS OUT ...

MuJoCo and PyOpenGL choose their way to OpenGL once a process, from the environment, when they are
imported; a missing or broken driver may end the process.  So `animation` calls this module with
MUJOCO_GL set, and tries the next way if it fails.
"""

import sys

import mujoco
import numpy as np


def render(
    model: mujoco.MjModel, qpos: np.ndarray, camera: list[float], width: int, height: int
) -> np.ndarray:
    """Renders one frame for each row of qpos.

    Args:
      model: Model to draw.
      qpos: Generalized positions, shape (frame, nq).
      camera: Point looked at [m], distance [m], azimuth and elevation [deg], six numbers.
      width: Width of a frame in pixels.
      height: Height of a frame in pixels.

    Returns:
      Frames, uint8, shape (frame, height, width, 3).
    """
    data, view = mujoco.MjData(model), mujoco.MjvCamera()
    view.lookat[:] = camera[:3]
    view.distance, view.azimuth, view.elevation = camera[3:]
    frames = np.empty((len(qpos), height, width, 3), np.uint8)
    with mujoco.Renderer(model, height, width) as renderer:
        for frame, q in zip(frames, qpos, strict=True):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, view)
            renderer.render(out=frame)
    return frames


def main(arguments: list[str]) -> None:
    """Reads model and qpos, renders, writes the frames."""
    model_path, qpos_path, out_path, width, height, *camera = arguments
    model = mujoco.MjModel.from_binary_path(model_path)
    qpos = np.load(qpos_path, allow_pickle=False)
    np.save(out_path, render(model, qpos, [float(c) for c in camera], int(width), int(height)))


if __name__ == "__main__":
    main(sys.argv[1:])
