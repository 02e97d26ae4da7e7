"""Code, versions and machine that a result depends on besides its inputs."""

import importlib.metadata
import platform
import subprocess
from pathlib import Path

import jax

_PACKAGES = (
    "codesign-jax",
    "evosax",
    "jax",
    "jaxlib",
    "llvmlite",
    "mujoco",
    "mujoco-mjx",
    "numpy",
    "orbax-checkpoint",
)


def environment() -> dict[str, object]:
    """Returns what a bitwise equal repetition needs: versions, platform, device and float type."""
    device = jax.devices()[0]
    return {
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in _PACKAGES},
        "platform": platform.platform(),
        "machine": platform.machine(),
        "device": f"{device.platform}: {device.device_kind}",
        "num_devices": jax.device_count(),
        "x64": bool(jax.config.jax_enable_x64),  # type: ignore[attr-defined]
    }


def git_state(known: str | None = None) -> dict[str, object]:
    """Returns commit and cleanliness of the checkout that the package runs from, if it is one."""
    if known:
        return {"commit": known}
    folder = Path(__file__).parent
    commit = _git(folder, "rev-parse", "HEAD")
    # An installed package may lie in a folder that belongs to somebody else's repository.
    if commit is None or _git(folder, "ls-files", "--error-unmatch", __file__) is None:
        return {"commit": None}
    return {"commit": commit, "modified": bool(_git(folder, "status", "--porcelain", "-uno"))}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
