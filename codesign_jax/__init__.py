"""Batched simulation of soft hands and co-design of their morphology and control.

The names below are the package's public list; each module has its own.  They are imported when they
are first asked for, so that importing the package costs a millisecond and sets nothing.
"""

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

from codesign_jax import reuse as _reuse  # noqa: F401  # notes the state of the files first

if TYPE_CHECKING:
    from codesign_jax import (
        codesign,
        control,
        cost,
        engines,
        env,
        export,
        model,
        optimize,
        policy,
        report,
        rollout,
        runs,
        sampling,
        scene,
        types,
    )
    from codesign_jax.codesign import Task
    from codesign_jax.engines import make_engine
    from codesign_jax.reuse import use_compilation_cache
    from codesign_jax.scene import InputError, constants, hand, objects, parameters
    from codesign_jax.types import Params, Status, Trace, Trial

_HOME = {
    "constants": "codesign_jax.scene",
    "hand": "codesign_jax.scene",
    "objects": "codesign_jax.scene",
    "parameters": "codesign_jax.scene",
    "InputError": "codesign_jax.scene",
    "make_engine": "codesign_jax.engines",
    "Task": "codesign_jax.codesign",
    "Params": "codesign_jax.types",
    "Status": "codesign_jax.types",
    "Trace": "codesign_jax.types",
    "Trial": "codesign_jax.types",
    "use_compilation_cache": "codesign_jax.reuse",
}
"""Where the names are that are not modules of this folder."""

__all__ = [
    "Params",
    "InputError",
    "Status",
    "Task",
    "Trace",
    "Trial",
    "codesign",
    "constants",
    "control",
    "cost",
    "engines",
    "env",
    "export",
    "hand",
    "make_engine",
    "model",
    "objects",
    "optimize",
    "parameters",
    "policy",
    "report",
    "rollout",
    "runs",
    "sampling",
    "scene",
    "types",
    "use_compilation_cache",
]


def _import_mujoco() -> None:
    """Imports MuJoCo, without OpenGL where MUJOCO_GL names a way that is not there."""
    way = os.environ["MUJOCO_GL"]
    try:
        importlib.import_module("mujoco")
    except Exception:  # each way has errors of its own, of ctypes and PyOpenGL among them
        os.environ["MUJOCO_GL"] = "disable"
        importlib.import_module("mujoco")
        os.environ["MUJOCO_GL"] = way


if os.environ.get("MUJOCO_GL") and "mujoco" not in sys.modules:
    _import_mujoco()


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _HOME:
        home = importlib.import_module(_HOME[name])
        attribute = getattr(home, name, None)
        return importlib.import_module(f"{_HOME[name]}.{name}") if attribute is None else attribute
    return importlib.import_module(f"codesign_jax.{name}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
