"""The preloaded library that counts file operations and lets one fail: shim.c, compiled by `cc`."""

import ctypes
import enum
import hashlib
import os
import shutil
import subprocess
from pathlib import Path

SOURCE = Path(__file__).with_name("shim.c")


class Mode(enum.IntEnum):
    """What happens at the chosen operation."""

    COUNT = 0
    """Nothing; operations are counted."""
    KILL = 1
    """A write does half of its bytes, then the process is killed."""
    FULL = 2
    """This operation and all later ones that need room: ENOSPC."""
    BROKEN = 3
    """This one operation: EIO."""
    READ_ONLY = 4
    """This operation and all later ones: EROFS."""


def compiler() -> str | None:
    """The C compiler: $CC or cc; None if there is none."""
    return shutil.which(os.environ.get("CC", "cc"))


def build(folder: Path) -> Path:
    """Compiles the library, once for each state of its source; returns its file.

    Raises:
      RuntimeError: If there is no C compiler.
    """
    digest = hashlib.sha256(SOURCE.read_bytes()).hexdigest()[:16]
    library = folder.absolute() / f"faults-{digest}.so"
    if not library.exists():
        program = compiler()
        if program is None:
            raise RuntimeError("no C compiler: install one as `cc`, or name it in CC")
        folder.mkdir(parents=True, exist_ok=True)
        part = library.with_suffix(f".{os.getpid()}")
        flags = ["-O1", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror"]
        subprocess.run([program, *flags, "-o", part, SOURCE, "-ldl", "-lpthread"], check=True)
        os.replace(part, library)
    return library


def environment(library: Path, folder: Path | None = None, at: int = 0, mode: Mode = Mode.COUNT):
    """Variables for a new process: the library is loaded, and armed if a folder is given."""
    found = {"LD_PRELOAD": str(library)}
    if folder is not None:
        found |= {"FAULTS_FOLDER": str(folder.absolute()), "FAULTS_AT": str(at)}
        found["FAULTS_MODE"] = str(int(mode))
    return found


class Shim:
    """The library in a process that was started with it."""

    def __init__(self, library: Path):
        """Finds the library that is loaded already."""
        self._library = ctypes.CDLL(str(library))
        arguments = [ctypes.c_char_p, ctypes.c_long, ctypes.c_int]
        self._library.shim_arm.argtypes, self._library.shim_arm.restype = arguments, None
        self._library.shim_count.restype = ctypes.c_long

    def arm(self, folder: Path, at: int = 0, mode: Mode = Mode.COUNT) -> None:
        """Counts operations below a folder from now on; the `at`-th, from 1, meets the fault."""
        self._library.shim_arm(os.fsencode(folder.absolute()), at, int(mode))

    def disarm(self) -> int:
        """Lets everything happen again; returns the operations that were counted."""
        count = self._library.shim_count()
        self._library.shim_arm(b"", 0, 0)
        return count
