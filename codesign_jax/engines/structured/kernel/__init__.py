"""The structured engine's rollout as one kernel."""

from codesign_jax.engines.structured.kernel.newton import Limits
from codesign_jax.engines.structured.kernel.program import Program

__all__ = ["Limits", "Program"]
