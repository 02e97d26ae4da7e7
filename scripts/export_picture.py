"""Draws docs/export_parts.png: a finger of the default hand, cut open, and its moulds."""

import os
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # read when MuJoCo is imported

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from PIL import Image  # noqa: E402

from codesign_jax import scene  # noqa: E402
from codesign_jax.export import casting, meshes, process  # noqa: E402
from codesign_jax.report.renderer import render  # noqa: E402

PAGE = Path(__file__).parent.parent / "docs" / "export_parts.png"
APART = 0.048  # m
CAMERA = [0.0, 1.15 * APART, 0.0, 0.225, 68.0, -42.0]


def model(parts: casting.Parts) -> mujoco.MjModel:
    """The parts beside each other, in metres; of the finger the half that shows its chamber."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1000, 560
    spec.stat.extent = 1.0  # of what is drawn, the sky included
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1],
        rgb2=[1, 1, 1],
        width=64,
        height=64,
    )
    spec.worldbody.add_light(pos=[0.3, -0.6, 1.0], dir=[-0.3, 0.6, -1.0])
    half = parts._replace(finger=parts.finger.trim_by_plane([0, 1, 0], 0))
    for k, (name, solid) in enumerate(half._asdict().items()):
        part = meshes.mesh(solid)
        centre = part.bounds.mean(0)
        # Facets with corners of their own, not a smooth surface.
        corners = (part.vertices[part.faces.ravel()] - centre) / 1e3
        spec.add_mesh(
            name=name,
            uservert=corners.ravel(),
            userface=np.arange(len(corners)),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        color = [0.9, 0.6, 0.25, 1] if name == "finger" else [0.55, 0.65, 0.78, 1]
        kind, place = mujoco.mjtGeom.mjGEOM_MESH, [0, k * APART, 0]
        spec.worldbody.add_geom(type=kind, meshname=name, pos=place, rgba=color)
    return spec.compile()


if __name__ == "__main__":
    width = scene.load().hand.section.width
    how = process.Process()
    [size] = process.sizes([0.11], width, [0.02], [0.005], how)
    parts = meshes.standing(casting.parts(size, how))
    [frame] = render(model(parts), np.zeros((1, 0)), CAMERA, 1000, 560)
    Image.fromarray(frame).save(PAGE, optimize=True)
    print(PAGE)
