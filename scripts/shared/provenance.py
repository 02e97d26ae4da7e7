"""What made a result: command, commit, versions and machine; the files of every study say it."""

import argparse
import datetime
import hashlib
import os
import platform
import shlex
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import jax
import mujoco
import numpy as np

from codesign_jax.provenance import environment, git_state
from codesign_jax.scene import Scene
from codesign_jax.scene.scene_files import scene_texts
from scripts.shared import evidence


def command() -> str:
    """This process's command line, as it can be entered in the checkout's folder.

    An absolute path is cut to its last part, because its folders exist on one machine only.
    """
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    if spec is not None:
        program = ["-m", spec.name.removesuffix(".__main__")]
    else:
        path = Path(sys.argv[0])
        program = [str(path) if not path.is_absolute() else f"scripts/{path.name}"]
    return shlex.join(["python", *program, *(portable(word) for word in sys.argv[1:])])


def portable(word: str) -> str:
    """A word of a command line, its absolute path cut to the last part: /a/b, or --out=/a/b."""
    option, equals, value = word.partition("=")
    if option.startswith("/"):
        return Path(word).name
    if value.startswith("/"):
        return option + equals + Path(value).name
    return word


def parser(description: str | None) -> argparse.ArgumentParser:
    """A command line with the module's docstring and the option --commit."""
    raw = argparse.RawDescriptionHelpFormatter
    command_line = argparse.ArgumentParser(description=description, formatter_class=raw)
    command_line.add_argument(
        "--commit", help="commit of the code where there is no repository to ask"
    )
    return command_line


def code(commit: str | None = None) -> dict[str, object]:
    """The code that made a result: commit, the package's version, and kernel (`evidence`)."""
    return {**git_state(commit), "version": evidence.version(), "kernel": evidence.kernel()}


def results(commit: str | None = None) -> dict[str, object]:
    """What results depend on: command, code, versions, platform and device."""
    return {"command": command(), **code(commit), **environment()}


def scene_hash(scene: Scene) -> str:
    """SHA-256 of the resolved scene with hand and objects."""
    texts = scene_texts(scene)
    return hashlib.sha256("\n".join(texts[n] for n in sorted(texts)).encode()).hexdigest()


def measurement(commit: str | None = None) -> dict:
    """What times depend on: command, code, versions, device, processor and its load."""
    device = jax.devices()[0]
    return {
        "command": command(),
        **code(commit),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "warp": metadata.version("warp-lang") if find_spec("warp") else None,
        "platform": device.platform,
        "device": device.device_kind,
        "cpu": _cpu_name(),
        "cpus": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
    }


def _cpu_name() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            names = [line.split(":", 1)[1].strip() for line in file if "model name" in line]
    except OSError:
        names = []
    return names[0] if names else platform.processor()
