"""Compiled kernels on disk, beside JAX's compilation cache, under a limit of size.

Kernels are kept in the folder `kernels` of `jax_compilation_cache_dir`; where that is unset or
remote, nothing is.  The environment variable CODESIGN_KERNEL_CACHE_BYTES sets the limit (default
512 MiB, about a thousand kernels); what was not used for the longest time goes first.
"""

import contextlib
import hashlib
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax

LIMIT = "CODESIGN_KERNEL_CACHE_BYTES"
_DEFAULT_LIMIT = 512 * 2**20
_DIGEST = hashlib.sha256().digest_size
_SUFFIX, _PART = ".kernel", ".part"
_ABANDONED = 3600.0  # age of a file that its writer will not finish any more [s]


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
            _write(path, code)
            _evict(path)
    return code


def _folder() -> Path | None:
    place = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    if not place or "://" in str(place):
        return None
    return Path(place) / "kernels"


def _limit() -> int:
    """The limit [bytes].

    Raises:
      ValueError: If the environment states one that is no number.
    """
    text = os.environ.get(LIMIT, str(_DEFAULT_LIMIT))
    if not text.isdecimal():
        raise ValueError(f"{LIMIT} = {text!r} must be a number of bytes")
    return int(text)


def _read(path: Path) -> bytes | None:
    """The code in a file, if it is the code that was written there."""
    try:
        found = path.read_bytes()
    except OSError:
        return None
    digest, code = found[:_DIGEST], found[_DIGEST:]
    if hashlib.sha256(code).digest() != digest:
        return None
    with contextlib.suppress(OSError):  # it is in use: it goes later than others
        os.utime(path)
    return code


def _write(path: Path, code: bytes) -> None:
    """Writes a file that other processes see whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, part = tempfile.mkstemp(dir=path.parent, suffix=_PART)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(code).digest() + code)
        os.replace(part, path)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(part)
        raise


def _evict(newest: Path) -> None:
    """Deletes what was not used for the longest time until the limit is met."""
    found = []
    for path in newest.parent.iterdir():
        with contextlib.suppress(OSError):  # another process deletes as well
            state = path.stat()
            if path.suffix == _SUFFIX:
                found.append((state.st_mtime_ns, state.st_size, path))
            elif path.suffix == _PART and time.time() - state.st_mtime > _ABANDONED:
                path.unlink()
    total, limit = sum(size for _, size, _ in found), _limit()
    for _, size, path in sorted(found):
        if total <= limit:
            return
        if path != newest:
            path.unlink(missing_ok=True)
            total -= size
