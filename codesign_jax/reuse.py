"""Reuse of programs within a process, and of programs, kernels and grids of meshes on disk.

All of it is known by the code that made it, the versions of packages, and kernels by the device.

Environment variables, which the commands check before they do anything:

* CODESIGN_CACHE: `on`, the default, or `off`: then nothing is read from a cache or written to one,
  that of JAX included.
* CODESIGN_CACHE_BYTES: the most bytes on disk of JAX's programs, of kernels and of grids, each, by
  default 512 MiB; what was not used for the longest time goes first, of JAX's programs the oldest
  ones when a process begins.
* XDG_CACHE_HOME: where the folder `codesign-jax` is, by default `~/.cache`. It must be an absolute
  path; another is ignored, as its specification says.
* JAX_COMPILATION_CACHE_DIR: JAX's own variable. Programs and kernels are in that folder then, and
  nobody checks or deletes the programs.
"""

import contextlib
import functools
import gc
import hashlib
import importlib.metadata
import os
import stat
import time
import warnings
import zlib
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

from codesign_jax import files  # NumPy and JAX are imported where they are used: `--help` is quick

ROOT = Path(__file__).parent
UNRELATED = ("commands", "export", "optimize", "report", "runs", "studio")
"""Folders that no simulation depends on: they import engines, never the other way."""
# The code that runs.  An editor or `git checkout` may change files after the import, so their state
# is noted before the first module is imported.


def _state() -> dict[str, tuple[int, ...]]:
    """Each file of code, with the time of its inode's last change, which no program sets back."""
    states = {}
    folders = [""]
    with contextlib.suppress(OSError):  # a file goes away while its state is read
        while folders:
            folder = folders.pop()
            for entry in os.scandir(os.path.join(ROOT, folder)):
                name = f"{folder}{entry.name}"
                if entry.name.endswith(".py"):
                    s = entry.stat()
                    states[name] = (s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns)
                elif entry.is_dir() and name not in UNRELATED and entry.name != "__pycache__":
                    folders.append(f"{name}/")
    return states


at_import = _state()


def code_digest() -> str | None:
    """Digest of the code that this process runs; None if it is not known: nothing is reused then.

    It is not known once a file was edited after the import.
    """
    if _state() != at_import:
        return None
    current = _content_digest()
    return current if _state() == at_import else None  # edited while it was read


@functools.cache
def _content_digest() -> str:
    sha = hashlib.sha256()
    for name in sorted(at_import):
        code = (ROOT / name).read_bytes()
        sha.update(f"{name} {len(code)}\n".encode() + code)
    return sha.hexdigest()


def key(*parts: object) -> str | None:
    """Name of what this code and these versions make of the parts; None: see `code_digest`."""
    code = code_digest()
    return None if code is None else digest(code, *map(_version, _COMPILERS), *parts)


_COMPILERS = ("jax", "jaxlib", "libigl", "llvmlite", "numpy", "scipy", "trimesh")
_version = functools.cache(importlib.metadata.version)


def digest(*parts: object) -> str:
    """SHA-256 of the parts' representation."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()


MOST = str(512 * 2**20)  # bytes of each cache on disk, if the environment does not say


def folder() -> Path:
    """Folder of all caches; it may not exist yet, and begins with `~` for a user without a home."""
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG Base Directory Specification: "consider the path invalid and ignore it".
    base = chosen if os.path.isabs(chosen) else os.path.expanduser("~/.cache")
    return Path(base, "codesign-jax")


def _environment() -> tuple[str, str]:
    return os.environ.get("CODESIGN_CACHE") or "on", os.environ.get("CODESIGN_CACHE_BYTES", MOST)


def problems() -> list[str]:
    """Problems with the environment variables, in words."""
    switch, most = _environment()
    messages = [] if switch in ("on", "off") else [f"CODESIGN_CACHE = {switch!r} must be on or off"]
    place = os.environ.get("JAX_COMPILATION_CACHE_DIR", "")
    if place.startswith("~"):
        words = "begins with ~, which JAX takes for a folder's name: give the whole path"
        messages.append(f"JAX_COMPILATION_CACHE_DIR = {place[:40]!r} {words}")
    if not (most.isascii() and most.isdecimal() and len(most) <= 18):
        messages.append(f"CODESIGN_CACHE_BYTES = {most[:40]!r} must be a number of bytes")
    return messages


def limit() -> int | None:
    """The most bytes of each cache; None if caches are off or there is no folder for them."""
    if wrong := problems():
        raise ValueError("; ".join(wrong))
    switch, most = _environment()
    return int(most) if switch == "on" and folder().parts[0] != "~" else None


def kernel_file(name: str) -> Path | None:
    """File of a kernel, beside JAX's programs; None where these are not kept, or are remote."""
    import jax

    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return None if not cache or "://" in str(cache) else Path(cache) / "kernels" / f"{name}.kept"


class Kept:
    """A file of a cache; one that cannot be read or written does not matter."""

    def __init__(self, path: Path | None):
        """Takes its place, and whether caches are on; without a path nothing is kept."""
        self.most = limit()
        self.path = None if self.most is None else path

    def read(self) -> bytes | None:
        """What was written; None if there is nothing, if it is damaged or of another name."""
        if self.path is None:
            return None
        with contextlib.suppress(OSError):
            stored = self.path.read_bytes()
            if stored[:32] == self._digest(stored[32:]):
                with contextlib.suppress(OSError):  # of somebody else
                    os.utime(self.path)
                return stored[32:]
        return None

    def write(self, content: bytes) -> bytes:
        """Keeps the content, and returns it."""
        if self.path is not None and self.most is not None:
            with contextlib.suppress(OSError):
                files.make_folder_of(self.path)
                files.clear_place(self.path)
                with files.atomically(self.path) as part:
                    part.write_bytes(self._digest(content) + content)
                _evict(self.path, self.most)
        return content

    def _digest(self, content: bytes) -> bytes:
        assert self.path is not None
        return hashlib.sha256(self.path.name.encode() + content).digest()


def kept(path: Path | None, build: Callable[[], bytes], *, worth: float = 0.0) -> bytes:
    """What a file of a cache holds, or `build` returns, which is kept if it took `worth` [s]."""
    file = Kept(path)
    content = file.read()
    if content is not None:
        return content
    start = time.perf_counter()
    content = build()
    return file.write(content) if time.perf_counter() - start >= worth else content


def _evict(newest: Path, most: int) -> None:
    """Deletes a folder's files that were not used for the longest time; the newest stays."""
    entries = []
    for path in newest.parent.iterdir():
        with contextlib.suppress(OSError):  # another process deletes as well
            state = path.stat()
            if path.suffix == newest.suffix:
                entries.append((state.st_mtime_ns, state.st_size, path))
            elif path.suffix == ".tmp" and time.time() - state.st_mtime > 3600:  # abandoned
                path.unlink()
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total > most and path != newest:
            path.unlink(missing_ok=True)
            total -= size


def use_compilation_cache() -> None:
    """Keeps compiled programs between processes, in `folder`, as the commands do.

    For scripts and notebooks, before their first simulation. Programs that are not as they were
    written are deleted first. A place that was chosen already (`jax_compilation_cache_dir`) stays.
    With CODESIGN_CACHE=off JAX keeps and finds nothing.

    Raises:
      ValueError: If an environment variable has a wrong value.

    >>> import jax
    >>> from codesign_jax import use_compilation_cache
    >>> use_compilation_cache()
    >>> jax.config.jax_compilation_cache_dir is None
    False
    """
    import jax

    most = limit()
    if most is None:
        jax.config.update("jax_enable_compilation_cache", False)
    elif jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        # JAX reads no programs of its other way of compression, and writes over none.
        programs = folder() / ("jax" if _unzstd() is None else "jax-zstd")
        text = ""
        if place := _open_to_others(programs):
            text = f"{place} may be changed by others, whose programs would run here: none is used "
            text += "or kept; make it your own, without write permission for others (chmod o-w)"
        elif not check_programs(programs):
            text = f"{programs} holds damaged programs that cannot be deleted: none is used or kept"
        if text:
            warnings.warn(text, stacklevel=2)
            jax.config.update("jax_enable_compilation_cache", False)
            return
        _make_room(programs, most)
        jax.config.update("jax_compilation_cache_dir", str(programs))
        _note_from_now_on(programs)
        # Small programs too, of which a command has dozens: JAX keeps those that take a second.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def why_nothing_is_kept() -> str:
    """Why compiled programs are not kept between commands though nobody asked for that; or ""."""
    if os.environ.get("JAX_COMPILATION_CACHE_DIR") or _environment()[0] == "off":
        return ""
    place = folder()
    if place.parts[0] == "~":
        return "there is no home folder: set HOME or XDG_CACHE_HOME"
    existing = next(path for path in (place / "jax", *(place / "jax").parents) if path.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        return f"{existing} cannot be written to: XDG_CACHE_HOME names another place"
    return ""


def _open_to_others(programs: Path) -> Path | None:
    """A folder of programs or kernels that somebody besides this user and root may write to.

    A group may: that of many users has nobody else in it, and their umask lets it write.
    """
    for place in (programs.parent, programs, programs / "kernels"):
        with contextlib.suppress(OSError):  # it is not there
            state = place.stat()
            if state.st_mode & stat.S_IWOTH or state.st_uid not in (0, os.getuid()):
                return place
    return None


# JAX (`lru_cache.py`) writes no program as a whole and writes over nothing: what a full disk or a
# power cut left would stay.  It compresses them by zlib, which has a checksum, or, where it finds
# zstd, without any: a flipped bit would be run as machine code.  So each program has its digest
# beside it, which is written as soon as JAX has written the program.


def check_programs(programs: Path) -> bool:
    """Deletes the programs of a folder that are not as they were written.

    Returns:
      Whether all that are left are sound: in a folder that cannot be written to they may not be.
    """
    sound = True
    for path in sorted(programs.glob("*-cache")):
        try:
            files.clear_place(path)
            if path.exists() and not _is_sound(path):
                _digest_beside(path).unlink(missing_ok=True)
                path.unlink()
        except OSError:  # another process deletes as well, or nobody may
            sound = sound and not path.exists()
    for path in programs.glob("*-digest"):  # of programs that are gone
        with contextlib.suppress(OSError):
            if not _beside(path, "cache").exists():
                path.unlink()
    return sound


def _make_room(programs: Path, most: int) -> None:
    """Deletes the oldest programs of a folder that has more bytes.

    A limit of JAX's own costs 60 us for every program that is there whenever it writes one.
    """
    states = []
    for path in programs.glob("*-cache"):
        with contextlib.suppress(OSError):  # another process deletes as well
            state = path.stat()
            states.append((state.st_mtime_ns, state.st_size, path))
    total = sum(size for _, size, _ in states)
    for _, size, path in sorted(states):
        if total > most:
            with contextlib.suppress(OSError):
                path.unlink()
            total -= size


def _is_sound(path: Path) -> bool:
    content = path.read_bytes()
    beside = _digest_beside(path)
    if beside.exists():
        return beside.read_bytes() == _program_digest(path, content)
    if _unzstd() is None and _unpacks(content):  # by zlib, with its checksum
        with contextlib.suppress(OSError):
            beside.write_bytes(_program_digest(path, content))
        return True
    return False


def _note_programs(programs: Path, known: set[str]) -> None:
    """Writes the digests of programs that are not `known`, to which they are added."""
    with contextlib.suppress(OSError):  # another process deletes as well; a full disk
        for name in {entry.name for entry in os.scandir(programs)} - known:
            path = programs / name
            if name.endswith("-cache") and not _digest_beside(path).exists():
                content = path.read_bytes()
                if not _unpacks(content):  # another process is writing it, and will note it
                    continue
                _digest_beside(path).write_bytes(_program_digest(path, content))
            known.add(name)


@functools.cache
def _note_from_now_on(programs: Path) -> None:
    """Has `_note_programs` called whenever JAX has compiled, and written, a program."""
    import jax

    known: set[str] = set()

    def note(event: str, duration_secs: float, **more: str | int) -> None:
        if event.endswith("backend_compile_duration"):
            _note_programs(programs, known)

    jax.monitoring.register_event_duration_secs_listener(note)


def _beside(path: Path, what: str) -> Path:
    return path.with_name(f"{path.name.rpartition('-')[0]}-{what}")


def _digest_beside(path: Path) -> Path:
    return _beside(path, "digest")


def _program_digest(path: Path, content: bytes) -> bytes:
    return hashlib.sha256(path.name.encode() + content).digest()


@functools.cache
def _unzstd() -> Callable[[bytes], bytes] | None:
    """What unpacks zstd, where JAX finds it (`compilation_cache.py`); None: it takes zlib then."""
    with contextlib.suppress(ImportError):
        from compression import zstd  # type: ignore[import-not-found]  # Python 3.14

        return zstd.decompress
    with contextlib.suppress(ImportError):
        import zstandard  # type: ignore[import-not-found]

        return zstandard.ZstdDecompressor().decompress
    return None


def _unpacks(content: bytes) -> bool:
    """Whether a program is there to its end."""
    try:
        return bool((_unzstd() or zlib.decompress)(content))
    except Exception:  # each library has errors of its own, for whatever it finds
        return False


# Within a process.  On a CPU XLA gives each piece of machine code three memory maps: 600 for the
# programs that simulate a scene of one structure and 1,000 for those that optimise one, of the
# 65,530 (`vm.max_map_count`) beyond which LLVM ends the process.


def memory_maps() -> tuple[int, int]:
    """Memory maps of this process and how many it may have; 0 of 1 if the system does not tell."""
    try:
        with open("/proc/self/maps", "rb") as file:
            return sum(1 for _ in file), int(Path("/proc/sys/vm/max_map_count").read_text())
    except (OSError, ValueError):
        return 0, 1


def memory_problem() -> str | None:
    """Why nothing more should be compiled, or None."""
    now, most = memory_maps()
    if now <= 0.9 * most:
        return None
    return (
        f"this process has {now:,} of the {most:,} memory maps that Linux allows "
        "(vm.max_map_count), nearly all of compiled programs, and LLVM would end it: call "
        "jax.clear_caches(), drop compiled functions, or begin a new process"
    )


STRUCTURES = 8
"""Scenes of different structure whose programs are kept at a time: each has 45 MB [chosen]."""
forgetters: list[Callable[[], object]] = []  # drop the programs that `shared` keeps


def _relieve() -> None:
    """Drops all programs, those of JAX included, if many maps are taken; who holds one keeps it."""
    now, most = memory_maps()
    if now > 0.3 * most:
        import jax

        for forget in forgetters:
            forget()
        jax.clear_caches()
        gc.collect()


def quickly_compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit` of a program that runs few times: XLA for CPUs takes a fifth of the time.

    It then leaves the code much as it is, which costs a kernel's program a few percent when it
    runs; last bits may differ.  As part of another program the function is compiled with that.
    """
    import jax
    from jax.core import Tracer

    part = jax.jit(function, **options)
    whole = functools.cache(lambda: jax.jit(function, compiler_options=_quick(), **options))

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        traced = any(isinstance(x, Tracer) for x in jax.tree.leaves(arguments))
        return (part if traced else whole())(*arguments)

    call.lower = lambda *arguments: whole().lower(*arguments)  # type: ignore[attr-defined]
    return call


def _quick() -> dict[str, Any]:
    """Options of XLA for CPUs; the release of jaxlib that has emitters knows how to do without."""
    import jax

    if jax.default_backend() != "cpu":
        return {}
    options = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    if _version("jaxlib").startswith("0.10."):
        options |= {"xla_cpu_use_fusion_emitters": False}
    return options


def shared(build: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles the functions that build(*arguments) returns once for all that are equal.

    Engines and design spaces are equal if they have one structure. Functions that are not jitted
    are `quickly_compiled`.

    They get their scene as an argument, so that another one of the same structure compiles nothing;
    with a `cost` of the user's own, or code that is not known, nothing is shared.
    """

    def jitted(*arguments: Any) -> Any:
        import jax

        _relieve()
        return jax.tree.map(
            lambda f: f if hasattr(f, "lower") else quickly_compiled(f), build(*arguments)
        )

    cached = functools.lru_cache(maxsize=STRUCTURES)(jitted)
    forgetters.append(cached.cache_clear)

    @functools.wraps(build)
    def find(*arguments: Any) -> Any:
        if getattr(arguments[-1], "cost", None) is not None:
            return jitted(*arguments)
        structures = [getattr(a, "structure", a) for a in arguments]
        known = all(isinstance(a, Hashable) for a in structures) and code_digest() is not None
        return (cached if known else jitted)(*structures)

    return find


class SceneProgram:
    """A jitted function of two arguments that gets a scene, or another one, as its third.

    `jax.jit`, `jax.vmap` and so on work on it as on a function.
    """

    def __init__(self, scene: Any, jitted: Any, *more: Any):
        """Joins a program with its scene, and further arguments of every call."""
        self._scene = scene
        self._jitted = jitted
        self._more = more

    def __call__(self, first: Any, second: Any, scene: Any = None) -> Any:
        """Calls the program; the scene is checked and takes the place of its own."""
        scene_arrays = self._arrays(scene)
        return _run(lambda: self._jitted(first, second, scene_arrays, *self._more))

    def compile(self, first: Any, second: Any) -> Callable[..., Any]:
        """Compiles the program ahead for arguments like these; a function to call it by."""
        scene_arrays = self._arrays(None)
        compiled = _run(
            lambda: self._jitted.lower(first, second, scene_arrays, *self._more).compile()
        )
        return lambda first, second: compiled(first, second, scene_arrays, *self._more)

    def _arrays(self, scene: Any) -> Any:
        import jax
        import numpy as np

        def array(value: Any) -> Any:
            return value.astype(float) if isinstance(value, jax.Array) else np.asarray(value, float)

        # Python's floats would be traced apart from arrays.
        return jax.tree.map(array, self._scene.checked(scene).bare)


# Whether programs have run in this process, and whether it was forked from one in which they had.
process = {"begun": False, "forked": False}
os.register_at_fork(after_in_child=lambda: process.update(forked=process["begun"]))


def begin() -> None:
    """A program is about to run: an error if the process was forked from one that had run some."""
    if process["forked"]:
        raise RuntimeError(
            "this process was forked from one that had simulated, and would wait for ever for "
            "XLA's threads, which it has not: begin processes by multiprocessing's `spawn`"
        )
    process["begun"] = True


def _run(call: Callable[[], Any]) -> Any:
    """Returns call(); Ctrl-C while JAX traces may leave a mark that it takes for a recursion."""
    begin()
    try:
        return call()
    except RecursionError as error:
        if "Recursively calling" not in str(error):
            raise
        import jax

        jax.clear_caches()
        return call()
