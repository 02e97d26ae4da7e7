"""What can be computed again, kept on disk: compiled programs, kernels, grids of meshes.

Environment variables, which the commands check before they do anything:

* CODESIGN_CACHE: `on`, the default, or `off`: then nothing is read from a cache or written to one,
  that of JAX included.
* CODESIGN_PROGRAM_CACHE_BYTES, CODESIGN_KERNEL_CACHE_BYTES, CODESIGN_MESH_CACHE_BYTES: the most
  bytes that each of them takes on disk, by default 256, 512 and 512 MiB; what was not used for the
  longest time goes first (of JAX's programs, the oldest).
* XDG_CACHE_HOME: where the folder `codesign-jax` is, by default `~/.cache`.
* JAX_COMPILATION_CACHE_DIR: JAX's own variable. Programs and kernels are in that folder then, and
  nobody checks or deletes the programs.
"""

import atexit
import contextlib
import os
import time
from pathlib import Path

SWITCH = "CODESIGN_CACHE"
PROGRAMS, KERNELS, MESHES = (
    f"CODESIGN_{kind}_CACHE_BYTES" for kind in ("PROGRAM", "KERNEL", "MESH")
)
_MOST = {PROGRAMS: 256 * 2**20, KERNELS: 512 * 2**20, MESHES: 512 * 2**20}
_DIGITS = 18  # of a limit; Python refuses to read numbers of some thousands
_ABANDONED = 3600.0  # age of a file that its writer will not finish any more [s]


def folder() -> Path:
    """Folder of all caches; it may not exist yet."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "codesign-jax"


def enabled() -> bool:
    """Whether caches are used.

    Raises:
      ValueError: If the environment says neither `on` nor `off`.
    """
    text = os.environ.get(SWITCH) or "on"
    if text not in ("on", "off"):
        raise ValueError(f"{SWITCH} = {text!r} must be on or off")
    return text == "on"


def limit(variable: str) -> int:
    """The most bytes of a cache.

    Args:
      variable: `PROGRAMS`, `KERNELS` or `MESHES`.

    Raises:
      ValueError: If the environment states one that is no number.
    """
    text = os.environ.get(variable)
    if text is None:
        return _MOST[variable]
    if not (text.isascii() and text.isdecimal() and len(text) <= _DIGITS):
        raise ValueError(f"{variable} = {text[:40]!r} must be a number of bytes")
    return int(text)


def problems() -> list[str]:
    """What is wrong with the environment variables, in words."""
    found = []
    for check in (enabled, *(lambda v=v: limit(v) for v in _MOST)):
        try:
            check()
        except ValueError as error:
            found.append(str(error))
    return found


def evict(place: Path, ending: str, most: int, newest: Path | None = None) -> None:
    """Deletes the files of a folder that were not used for the longest time, down to a limit.

    Temporary files that nobody will finish go as well.

    Args:
      place: The folder.
      ending: How the names of its files end.
      most: The limit [bytes].
      newest: A file that stays.
    """
    found = []
    with contextlib.suppress(OSError):
        for path in place.iterdir():
            with contextlib.suppress(OSError):  # another process deletes as well
                state = path.stat()
                if path.name.endswith(ending):
                    found.append((state.st_mtime_ns, state.st_size, path))
                elif path.suffix == ".tmp" and time.time() - state.st_mtime > _ABANDONED:
                    path.unlink()
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= most:
            return
        if path != newest:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
            total -= size


def used(path: Path) -> None:
    """Notes that a file is in use: it goes later than others."""
    with contextlib.suppress(OSError):
        os.utime(path)


def use_compilation_cache() -> None:
    """Keeps compiled programs between processes, in `caches.folder`, as the commands do.

    For scripts and notebooks, before their first simulation. Damaged programs are deleted first. A
    place that was chosen already (`jax_compilation_cache_dir`) stays. With CODESIGN_CACHE=off JAX
    keeps and finds nothing.

    Raises:
      ValueError: If an environment variable of `caches` has a wrong value.

    >>> import jax
    >>> from codesign_jax import use_compilation_cache
    >>> use_compilation_cache()
    >>> jax.config.jax_compilation_cache_dir is None
    False
    """
    import jax

    from codesign_jax import kept_programs

    if wrong := problems():
        raise ValueError("; ".join(wrong))
    if not enabled():
        jax.config.update("jax_enable_compilation_cache", False)
    elif jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        place = folder() / "jax"
        kept_programs.check(place)
        evict(place, kept_programs.ENDING, limit(PROGRAMS))
        atexit.register(kept_programs.note, place)
        jax.config.update("jax_compilation_cache_dir", str(place))
        # Small programs too, of which a command has dozens: JAX keeps those that take a second.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
