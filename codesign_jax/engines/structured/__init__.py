"""The structured engine: MuJoCo's contact problem solved at the cost of a chain (see `newton`)."""

from codesign_jax.engines.structured.engine import StructuredEngine

__all__ = ["StructuredEngine"]
