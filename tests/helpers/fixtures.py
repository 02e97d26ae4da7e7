"""Scenes whose objects stand among fixtures."""

from codesign_jax import scene
from codesign_jax.scene import library
from tests.helpers.grasps import DATA

WALL = """
[[fixture]]
name = "wall"
type = "box"
position = [0.06, 0.0, 0.05]
size = [0.01, 0.1, 0.05]
orientation = [0, 10, 0]
"""
POST = """
[[fixture]]
name = "post"
type = "cylinder"
position = [-0.055, 0.02, 0.04]
size = [0.015, 0.04]
friction = 0.2
"""
SLOPES = """
[[fixture]]
name = "slope"
type = "plane"
position = [0.0, 0.045, 0.0]
orientation = [70, 0, 0]
friction = 1.1

[[fixture]]
name = "other slope"
type = "plane"
position = [0.05, 0.0, 0.0]
orientation = [0, -70, 0]
"""
SHELF = """
[[fixture]]
name = "shelf"
type = "box"
position = [-0.1, 0.0, -0.02]
size = [0.11, 0.1, 0.02]
"""


def loaded(folder, fixtures, shape, **overrides):
    """The pinch on an object with fixtures, in a file of this folder."""
    text = library.available("scenes")["paper_spheres"].read_text() + fixtures
    (folder / "fixtures.toml").write_text(text)
    objects = DATA / f"{shape}.toml"
    where = {"hand_name": DATA / "pinch.toml", "object_set": objects}
    return scene.load(folder / "fixtures.toml", **where, overrides=overrides)
