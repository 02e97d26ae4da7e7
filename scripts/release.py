"""Builds a release and checks everything that can be checked before its upload: `make release`.

Version, changelog and citation must agree.  The wheel is built from the source distribution and
installed, with its dependencies, into an empty environment, in which the command runs.  Wheel,
source distribution and the first notebook then lie in dist/.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
from pathlib import Path

import jupytext

from scripts.shared import evidence

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
NOTEBOOK = ROOT / "notebooks" / "01_start.py"
IN_SDIST = (
    "CHANGELOG.md",
    "CITATION.cff",
    "LICENSE",
    "Makefile",
    "README.md",
    "docs/quickstart.md",
    "hands/pneuflex4.toml",
    "objects/paper.toml",
    "tests/test_release.py",
)
"""Files whose absence from a source distribution would go unseen in the wheel."""
COMMANDS = (
    ["--version"],
    ["optimize", "--scene", "build", "--preset", "23d", "--dry-run"],
    ["evaluate", "--design", "length=110", "arm_z=20", "--trials", "1"],
)
"""Calls of `codesign` in the empty environment; the last one compiles and simulates a grasp."""


class ReleaseError(Exception):
    """What must be mended before a release."""


def versions(root: Path = ROOT) -> dict[str, str]:
    """The version that each file names, by file; a missing one is empty."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    patterns = {
        "CHANGELOG.md": r"^## (\d+\.\d+\.\d+\S*)",
        "CITATION.cff": r"^version: (\S+)",
    }
    named = {"pyproject.toml": project["version"]}
    for name, pattern in patterns.items():
        match = re.search(pattern, (root / name).read_text(encoding="utf-8"), re.M)
        named[name] = match[1] if match else ""
    return named


def check_versions(root: Path = ROOT) -> str:
    """The version, if all files name the same one.

    Raises:
      ReleaseError: If they differ.
    """
    named = versions(root)
    if len(set(named.values())) != 1:
        rows = ", ".join(f"{name}: {version or 'none'}" for name, version in named.items())
        raise ReleaseError(f"the versions differ: {rows}")
    return named["pyproject.toml"]


def build(folder: Path, root: Path = ROOT) -> tuple[Path, Path]:
    """Builds the source distribution, and the wheel from it.

    Args:
      folder: Where both are written.
      root: The checkout.

    Returns:
      The paths of source distribution and wheel.

    Raises:
      ReleaseError: If the source distribution lacks a file of `IN_SDIST`.
    """
    _hatch("sdist", folder, root)
    [sdist] = folder.glob("*.tar.gz")
    with tempfile.TemporaryDirectory() as unpacked:
        with tarfile.open(sdist) as archive:
            archive.extractall(unpacked, filter="data")
        [source] = Path(unpacked).iterdir()
        missing = [name for name in IN_SDIST if not (source / name).is_file()]
        if missing:
            raise ReleaseError(f"{sdist.name} lacks {', '.join(missing)}")
        _hatch("wheel", folder, source)
    [wheel] = folder.glob("*.whl")
    return sdist, wheel


def _hatch(target: str, folder: Path, root: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "--target", target]
    subprocess.run([*command, "--directory", str(folder)], cwd=root, check=True)


def check_installation(wheel: Path, version: str) -> None:
    """Installs the wheel into an empty environment and runs `COMMANDS` there.

    Raises:
      ReleaseError: If a command fails or names another version.
    """
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        programs = Path(folder) / "bin"
        pip = [str(programs / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "install", "--no-compile", str(wheel)], check=True)
        subprocess.run([*pip, "check"], check=True)
        for arguments in COMMANDS:
            command = [str(programs / "codesign"), *arguments]
            # In an empty folder: nothing of the checkout is found by accident.
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
            if done.returncode != 0:
                raise ReleaseError(f"codesign {' '.join(arguments)} failed:\n{done.stderr}")
            if arguments == ["--version"] and version not in done.stdout:
                raise ReleaseError(f"codesign --version says {done.stdout.strip()}, not {version}")


def notebook(folder: Path) -> Path:
    """Writes the first notebook as .ipynb; its first cell installs the wheel beside it."""
    path = folder / f"{NOTEBOOK.stem}.ipynb"
    jupytext.write(jupytext.read(NOTEBOOK), path)
    return path


def remaining(root: Path = ROOT) -> list[str]:
    """Steps that only the maintainers can take."""
    version = versions(root)["pyproject.toml"]
    changelog = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    steps = []
    if re.search(rf"^## {re.escape(version)}.*unreleased", changelog, re.M):
        steps.append(f"write the date of {version} into CHANGELOG.md")
    if ".dev" in version:
        steps.append("give the version its final name, and measure again what pages show")
    elif marked := [page for page in evidence.PAGES if evidence.is_marked(root / page)]:
        steps.append(f"measure the figures of {', '.join(marked)} again, or say why not")
    if "urls" not in project:
        steps.append("add the repository's address to pyproject.toml (project.urls)")
    return [*steps, f"git tag v{version}", "twine upload dist/*.whl dist/*.tar.gz"]


def main(arguments: list[str] | None = None) -> int:
    """Builds and checks a release; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=DIST, help="folder of the files; is emptied")
    folder = parser.parse_args(arguments).out.resolve()
    try:
        version = check_versions()
        shutil.rmtree(folder, ignore_errors=True)
        sdist, wheel = build(folder)
        check_installation(wheel, version)
    except ReleaseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for path in (sdist, wheel, notebook(folder)):
        print(f"{path.relative_to(folder.parent)}: {path.stat().st_size / 1e6:.1f} MB")
    print("before the upload:", *remaining(), sep="\n  ")
    return 0


if __name__ == "__main__":
    sys.exit(main())
