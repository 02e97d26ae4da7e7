"""Sketches of a grasp in matplotlib, from link and object positions alone: no OpenGL needed."""

from typing import TYPE_CHECKING

import matplotlib.backends.backend_agg
import matplotlib.figure
import mujoco
import numpy as np

from codesign_jax.model import layout
from codesign_jax.scene import Scene

if TYPE_CHECKING:
    from codesign_jax.report.animation import Camera


def draw(
    scene: Scene,
    model: mujoco.MjModel,
    qpos: np.ndarray,
    shape: int,
    size: tuple[int, int],
    camera: "Camera",
) -> np.ndarray:
    """Draws one frame for each row of qpos.

    Args:
      qpos: Generalized positions, shape (frame, nq).

    Returns:
      Frames, uint8, shape (frame, height, width, 3).
    """
    width, height = size
    figure = matplotlib.figure.Figure(figsize=(width / 100, height / 100), dpi=100)
    canvas = matplotlib.backends.backend_agg.FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1), projection="3d")
    data, outline = mujoco.MjData(model), _outline(scene, model, shape)
    pictures = []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        axes.clear()
        _frame(axes, scene, data, outline, camera)
        canvas.draw()
        pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return np.stack(pictures)


def _frame(
    axes, scene: Scene, data: mujoco.MjData, outline: list[np.ndarray], camera: "Camera"
) -> None:
    lay = layout(scene)
    reach = 0.15
    corners = reach * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    axes.plot(*corners.T, 0.0, color="0.6", lw=1)
    for stub, links in zip(lay.stubs, lay.bodies, strict=True):
        axes.plot(*data.xpos[[stub, *links]].T, color="tab:blue", lw=3)
    palm = data.xpos[1]
    for stub in lay.stubs:
        axes.plot(*np.stack([palm, data.xpos[stub]]).T, color="0.3", lw=3)
    position, rotation = data.xpos[lay.object], data.xmat[lay.object].reshape(3, 3)
    for line in outline:
        axes.plot(*(position + line @ rotation.T).T, color="tab:orange", lw=1.5)
    seen = reach / 0.62 * camera.distance
    limits = [(v - seen, v + seen) for v in camera.lookat]
    axes.set(**dict(zip(("xlim", "ylim", "zlim"), limits, strict=True)))
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(elev=-camera.elevation, azim=camera.azimuth - 180)
    axes.set_axis_off()


def _outline(scene: Scene, model: mujoco.MjModel, shape: int) -> list[np.ndarray]:
    """Lines of the object in its own frame [m], each of shape (point, 3)."""
    found = scene.objects.object[shape]
    if found.mesh:
        return [_wires(model, f"object_{shape}")]
    return found.primitive.outline(model.geom(f"object_{shape}").size)


def _wires(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Edges of a mesh geom in its body's frame as one line [m], interrupted by rows of nan."""
    geom = model.geom(name)
    mesh = model.mesh(int(geom.dataid[0]))
    vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
    faces = model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, geom.quat)  # MuJoCo turns meshes into frames of its own
    vertices = vertices @ turn.reshape(3, 3).T + geom.pos
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2), 1)
    ends = vertices[np.unique(pairs, axis=0)]
    return np.concatenate([ends, np.full_like(ends[:, :1], np.nan)], 1).reshape(-1, 3)
