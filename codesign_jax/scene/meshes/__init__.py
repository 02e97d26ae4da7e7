"""Watertight meshes as graspable bodies: checks, mass properties and signed distance."""

from codesign_jax.scene.meshes.grid import Grid
from codesign_jax.scene.meshes.solid import UNITS, Solid, load

__all__ = ["UNITS", "Grid", "Solid", "load"]
