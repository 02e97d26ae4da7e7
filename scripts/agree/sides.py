"""The two sides of a comparison: checkouts, and processes that simulate with their packages."""

import contextlib
import io
import json
import os
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
WORKER = Path(__file__).with_name("worker.py")


def checkout(old: str, folder: Path) -> Path:
    """The older source: a folder as it is, or a commit, which is unpacked into `folder`.

    Raises:
      ValueError: If it is neither.
    """
    if Path(old).is_dir():
        source = Path(old).resolve()
    else:
        command = ["git", "archive", "--format=tar", old]
        done = subprocess.run(command, cwd=ROOT, capture_output=True)
        if done.returncode != 0:
            raise ValueError(f"{old} is no folder, and no commit: {done.stderr.decode().strip()}")
        with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
            archive.extractall(folder, filter="data")
        source = folder
    if not (source / "codesign_jax").is_dir():
        raise ValueError(f"{source} has no package codesign_jax")
    return source


class Side:
    """A process that simulates with the package of a checkout."""

    def __init__(self, source: Path, *, double: bool = False):
        """Starts the process; double: in float64."""
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(source), *os.environ.get("PYTHONPATH", "").split()]),
            "JAX_ENABLE_X64": str(int(double)),
            # Compile times are measured, and two processes share a GPU.
            "JAX_ENABLE_COMPILATION_CACHE": "false",
            "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        }
        self._process = subprocess.Popen(
            [sys.executable, str(WORKER)],
            cwd=source,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, request: str, **arguments: Any) -> Any:
        """What the process answers.

        Raises:
          RuntimeError: If it fails; the message has its traceback.
        """
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps({"request": request, **arguments}) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        answer = json.loads(line) if line else {"error": "the process has ended"}
        if "error" in answer:
            raise RuntimeError(f"{request}: {answer['error']}")
        return answer["answer"]

    def close(self) -> None:
        """Ends the process."""
        with self._process:  # closes the pipes and waits: the worker ends with its input
            pass


@contextlib.contextmanager
def running(source: Path, *, double: bool = False) -> Iterator[Side]:
    """A side that ends with the block."""
    side = Side(source, double=double)
    try:
        yield side
    finally:
        side.close()
