"""Renders frames in a process of its own: python -m codesign_jax.report.renderer MODEL QPOS OUT ...

MuJoCo and PyOpenGL choose their way to OpenGL once a process, from the environment, when they are
imported; a missing or broken driver may end the process.  So `animation` calls this module with
MUJOCO_GL set, and tries the next way if it fails.
"""

import sys

import mujoco
import numpy as np


def render(
    model: mujoco.MjModel, qpos: np.ndarray, camera: list[float], frames: np.ndarray
) -> None:
    """Renders one frame for each row of qpos.

    Args:
      qpos: Generalized positions, shape (frame, nq).
      camera: Azimuth and elevation [deg], distance [m] and point looked at [m], six numbers.
      frames: What becomes the frames, uint8, shape (frame, height, width, 3).
    """
    data, view = mujoco.MjData(model), mujoco.MjvCamera()
    view.azimuth, view.elevation, view.distance, *view.lookat[:] = camera
    height, width = frames.shape[1:3]
    model.vis.global_.offheight, model.vis.global_.offwidth = height, width
    # A texel of shadow larger than a few pixels leaves teeth on the fingers; 8192 take 0.5 s.
    model.vis.quality.shadowsize = min(max(2048, 4 * max(height, width)), 8192)
    with mujoco.Renderer(model, height, width) as renderer:
        for frame, q in zip(frames, qpos, strict=True):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, view)
            renderer.render(out=frame)


def main(arguments: list[str]) -> None:
    """Reads model and qpos, renders, writes the frames."""
    model_path, qpos_path, out_path, width, height, *camera = arguments
    model = mujoco.MjModel.from_binary_path(model_path)
    qpos = np.load(qpos_path, allow_pickle=False)
    shape = len(qpos), int(height), int(width), 3
    frames = np.lib.format.open_memmap(out_path, "w+", np.uint8, shape)
    render(model, qpos, [float(c) for c in camera], frames)


if __name__ == "__main__":
    main(sys.argv[1:])
