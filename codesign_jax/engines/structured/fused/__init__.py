"""The structured engine's rollout as one kernel."""

from codesign_jax.engines.structured.fused.kernel import TRACE, Limits, Program

__all__ = ["TRACE", "Limits", "Program"]
