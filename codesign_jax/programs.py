"""Jitted programs that every scene of one structure shares within a process.

A program takes the scene's numbers (`Scene.constants`) and the optimiser as arguments: hands,
objects and bounds of other numbers are other arguments, not other programs.  Another file of the
same structure, whose preset fixes the same values, traces and compiles nothing, and a new process
finds the program in JAX's cache on disk.
"""

import functools
import os
from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp

from codesign_jax import memory_maps, rollout, sources
from codesign_jax.engines import Engine
from codesign_jax.scene import Constants, Scene
from codesign_jax.scene.parameters import DesignSpace

_KEPT = 32
"""Programs of each kind that are kept for the next scene of their structure."""


class Program:
    """A jitted function of two arguments that gets a scene's numbers, or others, as its third.

    `jax.jit`, `jax.vmap` and so on work on it as on a function.
    """

    def __init__(self, scene: Scene, jitted: Any, *more: Any):
        """Joins a program with what a scene passes to it.

        Args:
          scene: The scene whose numbers are the default.
          jitted: Function of the two arguments, the constants and `more`.
          *more: Further arguments, the same in every call.
        """
        self._scene, self._jitted, self._more = scene, jitted, more

    def __call__(self, first: Any, second: Any, constants: Constants | None = None) -> Any:
        """Calls the program; `constants` are checked and replace the scene's.

        Raises:
          InputError: If the constants do not fit the scene, see `scene.constants.check`.
          RuntimeError: In a process that was forked from one that had simulated.
        """
        return _again_if_stuck(
            lambda: self._jitted(first, second, self._numbers(constants), *self._more)
        )

    def compile(self, first: Any, second: Any) -> Callable[..., Any]:
        """Compiles the program ahead for arguments like these; a function to call it by."""
        numbers = self._numbers(None)
        compiled = _again_if_stuck(
            lambda: self._jitted.lower(first, second, numbers, *self._more).compile()
        )
        return lambda first, second: compiled(first, second, numbers, *self._more)

    def _numbers(self, constants: Constants | None) -> Constants:
        numbers = rollout.numbers(self._scene, constants)
        # Python's floats would be traced apart from arrays.
        return jax.tree.map(lambda v: jnp.asarray(v, float), numbers)


process = {"begun": False, "forked": False}
"""Whether programs have run in this process, and whether it was forked from one in which they had.

A child of `os.fork` has none of XLA's threads, for which its programs would wait for ever.
"""


def note_fork() -> None:
    """This process is a child."""
    process["forked"] = process["begun"]


def _begin() -> None:
    """A program is about to run.

    Raises:
      RuntimeError: If the process was forked from one in which programs had run.
    """
    if process["forked"]:
        raise RuntimeError(
            "this process was forked from one that had simulated, and would wait for ever for "
            "XLA's threads, which it has not: begin processes by multiprocessing's `spawn`"
        )
    process["begun"] = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=note_fork)


def _again_if_stuck(call: Callable[[], Any]) -> Any:
    """Returns call(), if need be without what JAX had traced.

    Ctrl-C at a bad moment of tracing leaves a mark in one of JAX's caches, which takes the next
    call for a recursion.
    """
    _begin()
    try:
        return call()
    except RecursionError as error:
        if "Recursively calling" not in str(error):
            raise
        jax.clear_caches()
        return call()


def shared(build: Callable[..., Callable]) -> Callable[..., Callable]:
    """Jits what `build` returns once for each structure, engine and further argument.

    Nothing is found again once the code is not what was imported, see `sources`.

    Args:
      build: Function (scene, engine, space, *arguments) that returns a function to jit, which reads
        numbers from its constants alone; a last argument that is a `Recording` may have a cost.
    """

    def jitted(*arguments: Any) -> Callable:
        memory_maps.relieve()
        return jax.jit(build(*arguments))

    kept = functools.lru_cache(maxsize=_KEPT)(jitted)
    memory_maps.holds_programs(kept.cache_clear)

    @functools.wraps(build)
    def find(scene: Scene, engine: Engine, space: DesignSpace, *arguments: Any) -> Callable:
        if isinstance(arguments[-1], rollout.Recording) and arguments[-1].cost is not None:
            # A cost of one's own may read names and whatever else is no number of the scene.
            return jitted(scene, engine, space, *arguments)
        if not isinstance(engine, Hashable) or sources.digest() is None:
            return jitted(scene.structure, engine, space.structure, *arguments)
        return kept(scene.structure, engine, space.structure, *arguments)

    return find


sources.note()  # what programs are traced from has been imported
