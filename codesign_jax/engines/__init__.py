"""Engines by name; each advances batches of worlds behind the interface in `base`."""

from codesign_jax import schema
from codesign_jax.engines.base import Engine
from codesign_jax.scene import Scene

NAMES = ("structured", "mujoco", "mjx")
DEFAULT = "structured"


def make_engine(name: str, scene: Scene) -> Engine:
    """Builds an engine for a scene.

    Args:
      name: One of `NAMES`.
      scene: The scene.

    Raises:
      SceneError: if there is no such engine.
    """
    if name == "mjx":
        from codesign_jax.engines.mjx import MjxEngine

        return MjxEngine(scene)
    if name == "mujoco":
        from codesign_jax.engines.mujoco import MujocoEngine

        return MujocoEngine(scene)
    if name == "structured":
        from codesign_jax.engines.structured import StructuredEngine

        return StructuredEngine(scene)
    raise schema.SceneError([f"engine {name!r} unknown; {schema.nearest(name, NAMES)}"])


__all__ = ["DEFAULT", "NAMES", "Engine", "make_engine"]
