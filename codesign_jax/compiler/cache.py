"""Compiled kernels on disk, beside JAX's compilation cache, under a limit of size.

Kernels are kept in the folder `kernels` of `jax_compilation_cache_dir`; where that is unset or
remote, nothing is.  `caches` has the limit and the switch.
"""

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path

import jax

from codesign_jax import caches, files

_SUFFIX = ".kernel"


def key(*parts: object) -> str:
    """Name of a kernel, made of everything that determines its code."""
    return "kernel_" + hashlib.sha256(repr(parts).encode()).hexdigest()


def kept(name: str, build: Callable[[], bytes]) -> bytes:
    """A kernel's code from the cache, or built and put there.

    A file that is damaged is built again.  A cache that cannot be read or written does not matter.
    """
    folder = _folder()
    if folder is None:
        return build()
    path = folder / (name + _SUFFIX)
    code = _read(path)
    if code is None:
        code = build()
        with contextlib.suppress(OSError):
            files.clear_place(path)
            with files.atomically(path) as part:
                part.write_bytes(_digest(path, code) + code)
            caches.evict(folder, _SUFFIX, caches.limit(caches.KERNELS), path)
    return code


def _folder() -> Path | None:
    place = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if not place or "://" in str(place) or not caches.enabled():
        return None
    return Path(place) / "kernels"


def _read(path: Path) -> bytes | None:
    """The code in a file, if it is the code that was written there."""
    try:
        found = path.read_bytes()
    except OSError:
        return None
    size = hashlib.sha256().digest_size
    digest, code = found[:size], found[size:]
    if _digest(path, code) != digest:
        return None
    caches.used(path)
    return code


def _digest(path: Path, code: bytes) -> bytes:
    """Digest of a kernel and of its name: a file that took another's place is seen."""
    return hashlib.sha256(path.name.encode() + code).digest()
