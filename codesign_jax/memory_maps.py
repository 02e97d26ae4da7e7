"""Memory maps of this process: compiled programs take them, and Linux allows only so many.

On a CPU XLA gives each piece of machine code three maps, 600 for the programs that simulate a scene
of one structure and 1,000 for those that optimise one.  `vm.max_map_count` is 65,530 by default;
beyond it LLVM ends the process.
"""

import gc
from collections.abc import Callable
from pathlib import Path

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_FULL, _TOO_FULL = 0.3, 0.9  # shares of what is allowed: from here programs go; nothing is compiled

forgetters: list[Callable[[], object]] = []


def count() -> int:
    """Maps of this process; 0 where the system does not tell."""
    try:
        with _MAPS.open("rb") as file:
            return sum(1 for _ in file)
    except OSError:
        return 0


def most() -> int:
    """Maps that a process may have."""
    try:
        return int(_MOST.read_text())
    except (OSError, ValueError):
        return 65_530


def holds_programs(forget: Callable[[], object]) -> None:
    """Notes a function that drops programs which could be compiled again."""
    forgetters.append(forget)


def relieve() -> None:
    """Drops all programs that nobody uses now, those of JAX included, if many maps are taken.

    Whoever still holds a jitted function can call it: it is traced again and found on disk.
    """
    if count() <= _FULL * most():
        return
    import jax

    for forget in forgetters:
        forget()
    jax.clear_caches()
    gc.collect()


def problem() -> str | None:
    """Why nothing more should be compiled, or None."""
    now, allowed = count(), most()
    if now <= _TOO_FULL * allowed:
        return None
    return (
        f"this process has {now:,} of the {allowed:,} memory maps that Linux allows "
        "(vm.max_map_count), nearly all of compiled programs, and LLVM would end it: call "
        "jax.clear_caches(), drop compiled functions, or begin a new process"
    )
