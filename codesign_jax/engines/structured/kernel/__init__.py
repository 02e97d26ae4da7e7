"""The structured engine's rollout as one kernel."""

from codesign_jax.engines.structured.kernel.program import TRACE, Limits, Program

__all__ = ["TRACE", "Limits", "Program"]
