"""The structured engine: MuJoCo's contact problem solved at the cost of a chain (see solver)."""

from codesign_jax.engines.structured.engine import StructuredEngine

__all__ = ["StructuredEngine"]
