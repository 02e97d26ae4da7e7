"""Scenes whose objects stand among fixtures."""

from codesign_jax import scene
from codesign_jax.scene import library
from tests.helpers.grasps import DATA

NAMES = "wall", "post", "slopes", "shelf"
WALL, POST, SLOPES, SHELF = ((DATA / "fixtures" / f"{n}.toml").read_text() for n in NAMES)


def loaded(folder, fixtures, shape, **overrides):
    """The pinch on an object with fixtures, in a file of this folder."""
    text = library.available("scenes")["paper_spheres"].read_text() + fixtures
    (folder / "fixtures.toml").write_text(text)
    objects = DATA / f"{shape}.toml"
    where = {"hand_name": DATA / "pinch.toml", "object_set": objects}
    return scene.load(folder / "fixtures.toml", **where, overrides=overrides)
