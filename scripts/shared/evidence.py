"""Which version the figures of a page were measured with, and the mark of pages with older ones.

    python -m scripts.shared.evidence     # marks every page, or removes its mark

Figures belong to a release.  A measurement names the package's version and the digest of the code
that decides what a simulation computes.  A page is marked where either is not the present one, and
always while the version is a development version (`.dev`): so a change of the simulation leaves
pages and data alone.  The measurements for a release, made with its version, remove the marks.
"""

import ast
import functools
import hashlib
import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from codesign_jax import files

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data"
FIRST_VERSION = "0.1.0"
"""The version of measurements that name none."""

EVERY = ("**/*.json",)
"""The data of pages that quote several studies, or none by a file: old while any figure is."""
PAGES: dict[str, tuple[str, ...]] = {
    "README.md": ("budget.json", "hard_designs.json", "rates_*.json", "search/*searched*.json"),
    "docs/accuracy.md": (
        "budget.json",
        "free_motion.json",
        "hard_designs.json",
        "search/*screened-es*judged*.json",
    ),
    "docs/calibration.md": ("calibration/*.json",),
    "docs/comparison.md": ("rates_*.json",),
    "docs/control.md": EVERY,
    "docs/effects.md": ("budget.json", "effects.json", "hard_designs.json"),
    "docs/export.md": EVERY,
    "docs/gallery.md": EVERY,
    "docs/gradients.md": EVERY,
    "docs/hull.md": EVERY,
    "docs/library.md": EVERY,
    "docs/limits.md": EVERY,
    "docs/measurements.md": EVERY,
    "docs/notes/calibration.md": ("calibration/*.json",),
    "docs/notes/compiler.md": EVERY,
    "docs/notes/gradients.md": EVERY,
    "docs/notes/results.md": ("experiments/**/*.json",),
    "docs/notes/search.md": ("search/*.json",),
    "docs/notes/stability.md": ("stability.json",),
    "docs/notes/structured-engine.md": EVERY,
    "docs/optimisers.md": ("search/*.json",),
    "docs/performance.md": ("rates_*.json", "gpu_suite.json"),
    "docs/physics.md": EVERY,
    "docs/quickstart.md": EVERY,
    "docs/reality.md": EVERY,
    "docs/results.md": ("experiments/**/*.json",),
    "docs/scenes.md": EVERY,
    "docs/stability.md": ("stability.json",),
    "docs/uncertainty.md": ("uncertainty.json",),
    "docs/verdict.md": EVERY,
}
"""Pages with measured figures, and the files of docs/data that these are of."""
SIMULATION = (
    "codesign_jax/compiler/**/*.py",
    "codesign_jax/engines/structured/**/*.py",
    "codesign_jax/model/**/*.py",
    "codesign_jax/control.py",
    "codesign_jax/cost.py",
    "codesign_jax/rollout.py",
    "codesign_jax/scenes/**/*.toml",
    "hands/*.toml",
    "objects/*.toml",
)
"""Files that decide what a grasp does and how fast it is computed."""
SAME = {
    # The contact list and a step's contacts as values (the same operations in the kernels), and the
    # approximate division of GPUs (4 of 5,824 verdicts of recommended hands differ on an H200)
    "db4b5492": "e3ad8e40",
}
"""Digests of code that computes the same as earlier code, each with the digest of the earlier code.

Figures of the earlier code hold for it: `scripts.same_kernels` found the same kernels, or the same
operations in another order, or a comparison of verdicts found no more than rounding changes.
"""
BLOCK = re.compile(r"<!-- version:begin -->.*?<!-- version:end -->\n\n", re.S)


def version(root: Path = ROOT) -> str:
    """The package's version; the checkout need not be installed."""
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    return settings["project"]["version"]


@functools.cache
def kernel(root: Path = ROOT) -> str:
    """Digest of the code and constants of a simulation, without comments and docstrings.

    Code that computes the same as earlier code has the digest of that code, see `SAME`.
    """
    digest = hashlib.sha256()
    for pattern in SIMULATION:
        paths = sorted(root.glob(pattern))
        if not paths:
            raise ValueError(f"no file is {pattern}: what a simulation computes has moved")
        for path in paths:
            digest.update(f"{path.relative_to(root)}\n{_content(path)}\n".encode())
    return first_of(digest.hexdigest()[:8])


def first_of(digest: str) -> str:
    """The digest of the first code that computes the same as that of a digest."""
    return SAME.get(digest, digest)


def _content(path: Path) -> str:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".toml":
        return json.dumps(tomllib.loads(text), sort_keys=True, default=str)
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [part for part in body if not _is_docstring(part)]  # type: ignore[attr-defined]
    return "".join(_syntax(tree))


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _syntax(node: Any) -> Iterator[str]:
    """A syntax tree as text that is the same in every version of Python."""
    if isinstance(node, list):
        for item in node:
            yield from _syntax(item)
            yield ","
    elif isinstance(node, ast.AST):
        yield type(node).__name__ + "("
        for name, value in ast.iter_fields(node):
            # Newer versions have fields that older ones lack, such as type parameters.
            if value is not None and value != []:
                yield name + "="
                yield from _syntax(value)
        yield ")"
    else:
        yield repr(node)


def records(content: Any) -> list[dict[str, Any]]:
    """What made a file's results: the outermost tables that name a commit, and their `parts`."""
    if isinstance(content, dict) and "commit" in content:
        return [content, *records(content.get("parts", []))]
    inner = content.values() if isinstance(content, dict) else content
    return [r for v in inner if isinstance(v, dict | list) for r in records(v)]


def measured_with(data: Path, patterns: tuple[str, ...]) -> set[tuple[str, str]]:
    """Versions and kernels of the measurements in files of a folder."""
    paths = sorted({path for pattern in patterns for path in data.glob(pattern)})
    made = [r for path in paths for r in records(json.loads(path.read_text(encoding="utf-8")))]
    return {(record.get("version", FIRST_VERSION), first_of(record["kernel"])) for record in made}


def mark(measured: set[tuple[str, str]], present: tuple[str, str]) -> str:
    """What a page says of figures that another version or kernel made; empty if none did.

    Args:
      measured: Versions and kernels of the page's data.
      present: Version and kernel of the checkout.
    """
    developed = ".dev" in present[0]
    versions = sorted({made[0] for made in measured if developed or made != present})
    if not versions:
        return ""
    *others, last = versions
    named = f"versions {', '.join(others)} and {last}" if others else f"version {last}"
    figures = "The figures" if developed or present not in measured else "Some figures"
    return f"*{figures} of this page were measured with {named}; this version differs.*"


def marked(text: str, sentence: str) -> str:
    """A page with this mark below its first heading, in place of an earlier one."""
    plain = BLOCK.sub("", text)
    if not sentence:
        return plain
    heading, rest = plain.split("\n\n", 1)
    begin, end = "<!-- version:begin -->", "<!-- version:end -->"
    return f"{heading}\n\n{begin}\n\n{sentence}\n\n{end}\n\n{rest}"


def is_marked(page: Path) -> bool:
    """Whether a page says that its figures are of another version."""
    return BLOCK.search(page.read_text(encoding="utf-8")) is not None


def current(page: str, root: Path = ROOT, pages: Mapping[str, tuple[str, ...]] = PAGES) -> str:
    """The text of a page of `pages` as it has to be, with its mark or without."""
    measured = measured_with(root / "docs" / "data", pages[page])
    sentence = mark(measured, (version(root), kernel(root)))
    return marked((root / page).read_text(encoding="utf-8"), sentence)


def write(page: Path) -> None:
    """Marks a page, if it is one with measured figures."""
    path = page.resolve()
    name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
    if name in PAGES:
        text = current(name)
        with files.atomically(path) as part:
            part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    for name in PAGES:
        write(ROOT / name)
