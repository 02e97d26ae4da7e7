"""Engines and the settings at which they are measured."""

from typing import Any

from codesign_jax.engines import Engine, make_engine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import Scene

# "equal" solves the scene's own tolerance; "documented" is what the engine's documentation advises:
# MuJoCo's defaults for C and for Warp; for MJX as few iterations as remain stable, often one (its
# own speed test: one, with four line-search iterations).
_MUJOCO_DEFAULT = {"iterations": 100, "ls_iterations": 50, "tolerance": 1e-8}
SOLVERS: dict[str, dict[str, dict[str, Any]]] = {
    "mujoco": {"equal": {}, "documented": _MUJOCO_DEFAULT},
    "mjx": {"equal": {}, "documented": {"iterations": 1, "ls_iterations": 4}},
    "warp": {"equal": {}, "documented": _MUJOCO_DEFAULT},
}
# Arguments of the structured engine, whose tolerance is its own (a relative Newton decrement).
STRUCTURED: dict[str, dict[str, Any]] = {
    "default": {},
    "tight": {"iterations": 48, "tolerance": 1e-8},
    "loose": {"iterations": 6, "tolerance": 1e-4},
}
REFERENCE = {"iterations": 300, "ls_iterations": 100, "tolerance": 1e-15}
"""Solver values at which MuJoCo C finds the solution to rounding."""


def settings(engine: str) -> list[str]:
    """Names of an engine's settings."""
    return list(STRUCTURED if engine == "structured" else SOLVERS[engine])


def solver_values(engine: str, setting: str) -> dict[str, Any]:
    """Values of the scene's solver table for an engine at a setting."""
    if engine == "reference":
        return REFERENCE
    return {} if engine == "structured" else SOLVERS[engine][setting]


def build(engine: str, setting: str, scene: Scene) -> Engine:
    """Builds an engine behind the common interface."""
    if engine == "reference":
        return make_engine("mujoco", scene)
    if engine != "structured":
        return make_engine(engine, scene)
    return StructuredEngine(scene, **STRUCTURED[setting])


def how(engine: str, setting: str) -> str:
    """What runs, in words."""
    if engine != "structured":
        return {"mujoco": "MuJoCo C, float64, all cores", "mjx": "stock MJX (JAX)"}.get(
            engine, "MuJoCo Warp, one CUDA graph a step"
        )
    return "one kernel a rollout"
