"""The programs that JAX keeps on disk, without those that are not what was written.

JAX neither writes a program as a whole nor checks what it reads, and writes over nothing: what a
full disk or a crash left stays, with a warning in each process, and a file that holds another
program is loaded in its place.  There is no public way to give JAX a store of one's own, so a list
beside its files has the checksum of each: what differs from it is deleted before JAX looks.
"""

import contextlib
import json
import zlib
from pathlib import Path

from codesign_jax import files

ENDING = "-cache"
"""How the names of JAX's files end."""
LIST = "checksums.json"
_ZSTANDARD = b"\x28\xb5\x2f\xfd"


def check(folder: Path) -> None:
    """Deletes programs that are not what was written, and lists those that were not listed.

    A file that is not listed, of a process that was killed, only has to be complete.  It takes
    some 40 ms for 300 programs.
    """
    _sweep(folder, again=True)


def note(folder: Path) -> None:
    """Lists the programs that were written since the list was made, as `check` does."""
    _sweep(folder, again=False)


def _sweep(folder: Path, *, again: bool) -> None:
    """Brings files and list together; `again`: also of files that are on it."""
    known = _listed(folder)
    found = {}
    with contextlib.suppress(OSError):  # no folder, a read-only one, or a full disk: no matter
        for path in folder.glob(f"*{ENDING}"):
            with contextlib.suppress(OSError):  # another process deletes as well
                files.clear_place(path)
                if path.name in known and not again:
                    found[path.name] = known[path.name]
                    continue
                content = path.read_bytes()
                own = [len(content), zlib.crc32(content)]
                if known[path.name] == own if path.name in known else _complete(content):
                    found[path.name] = own
                else:
                    path.unlink()
        if found != known:
            with files.atomically(folder / LIST) as part:
                part.write_text(json.dumps(found, indent=0), encoding="utf-8")


def _listed(folder: Path) -> dict:
    """Length and checksum by name; a damaged list counts as none."""
    try:
        found = json.loads((folder / LIST).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _complete(content: bytes) -> bool:
    """Whether a program can be unpacked to its end."""
    try:
        if content.startswith(_ZSTANDARD):
            return bool(_zstandard(content))
        return bool(zlib.decompress(content))
    except Exception:  # each library has errors of its own, for whatever it finds
        return False


def _zstandard(content: bytes) -> bytes:
    """What JAX packed with one of the two libraries that it looks for before zlib."""
    try:
        from compression import zstd  # type: ignore[import-not-found]  # Python 3.14
    except ImportError:
        try:
            import zstandard  # type: ignore[import-not-found]
        except ImportError:  # JAX here could not read it either
            return b""
        return zstandard.ZstdDecompressor().decompress(content)
    return zstd.decompress(content)
