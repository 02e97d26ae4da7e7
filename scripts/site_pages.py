"""What MkDocs asks for when it builds the site: pages from files outside of docs/, and fonts.

README.md becomes the front page, the other files of `PAGES` become pages, and so does each
notebook. Links between them and docs/ are those of the repository; here they are turned into those
of the site. mkdocs.yml names this file.
"""

import posixpath
import re
from pathlib import Path
from typing import Any

import fontpkg
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent

# Page of the site for each file outside of docs/; notebooks are added by their names.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "scripts/README.md": "scripts.md",
}
PAGES |= {
    f"notebooks/{path.name}": f"notebooks/{path.stem}.md"
    for path in sorted((ROOT / "notebooks").glob("*.py"))
}

# Family and style of each font that stylesheets/extra.css names.
FONTS = {
    "sans": ("IBM Plex Sans", "normal"),
    "sans-italic": ("IBM Plex Sans", "italic"),
    "mono": ("IBM Plex Mono", "normal"),
}

_LINK = re.compile(r"(\]\(|^\[[^\]]+\]: )([^)\s#]+)", re.M)
_FILE_NAME = re.compile(r"\[`?(?:docs/)?([\w-]+)(?:/README)?\.md`?\](?=[(\[])")
_CODE = re.compile(r"(^```.*?^```)", re.S | re.M)
_DIAGRAM = re.compile(r"^```mermaid\n.*?^```", re.S | re.M)


def on_files(files: Files, config: Any) -> Files:
    """Adds the fonts, the pages that are made here, and the files that pages link to."""
    for font, (family, style) in FONTS.items():
        path = str(fontpkg.path(family, style=style))
        files.append(File.generated(config, f"assets/fonts/{font}.ttf", abs_src_path=path))
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=_page(ROOT / source)))
    files.append(File.generated(config, "notebooks/index.md", content=_notebooks()))
    for source in sorted({s for p in _sources() for s in _links_out(p)}):
        kept = File.generated(config, f"repository/{source}", abs_src_path=str(ROOT / source))
        files.append(kept)
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Turns the repository's links into the site's."""
    sources = {target: source for source, target in PAGES.items()}
    source = sources.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    picture = posixpath.relpath("figures/way_of_data.svg", posixpath.dirname(page.file.src_uri))
    markdown = _DIAGRAM.sub(f"![Data flow]({picture})", markdown)
    parts = _CODE.split(markdown)
    parts[::2] = [_relinked(text, source, page.file.src_uri) for text in parts[::2]]
    return "".join(parts)


def notebook_figure(stem: str, place: int) -> Path:
    """The file of the figure that a notebook's cell shows; `scripts.run_notebooks` writes it."""
    return ROOT / "docs" / "figures" / "notebooks" / f"{stem}_{place}.webp"


def _page(path: Path) -> str:
    return _notebook(path) if path.suffix == ".py" else path.read_text(encoding="utf-8")


def _notebook(path: Path) -> str:
    """A notebook as a page, each figure below the cell that shows it."""
    import jupytext  # it takes longer to import than everything else here
    from nbformat.v4 import new_markdown_cell

    notebook = jupytext.read(path)
    cells = []
    for place, cell in enumerate(notebook.cells):
        cells.append(cell)
        figure = notebook_figure(path.stem, place)
        if figure.is_file():
            picture = f"![Figure of the cell above](../figures/notebooks/{figure.name})"
            cells.append(new_markdown_cell(picture))
    notebook.cells = cells
    return jupytext.writes(notebook, "md")


def _notebooks() -> str:
    """The page that lists the notebooks: title and first paragraph of each."""
    lines = ["# Notebooks", ""]
    for source, page in PAGES.items():
        if source.startswith("notebooks/"):
            text = (ROOT / source).read_text(encoding="utf-8")
            title, summary = _opening(text)
            lines.append(f"* [{title}]({posixpath.basename(page)}): {summary}")
    return "\n".join(lines)


def _opening(notebook: str) -> tuple[str, str]:
    """Title and first paragraph of a notebook in jupytext's percent format."""
    comment = re.compile(r"^# ?", re.M)
    first = notebook.split("# %% [markdown]\n", 1)[1].split("\n# %%", 1)[0]
    title, _, rest = comment.sub("", first).strip().partition("\n")
    return title.lstrip("# "), " ".join(rest.strip().split("\n\n")[0].split())


def _sources() -> list[Path]:
    return [*(ROOT / "docs").rglob("*.md"), *(ROOT / s for s in PAGES if s.endswith(".md"))]


def _links_out(path: Path) -> list[str]:
    """Files of the repository that a page links to and that are no pages of the site."""
    text = "".join(_CODE.split(path.read_text(encoding="utf-8"))[::2])
    folder = path.parent.relative_to(ROOT).as_posix()
    targets = (_target(folder, link) for _, link in _LINK.findall(text))
    outside = (t for t in targets if t and t not in PAGES and _shown(t) is None)
    return [t for t in outside if (ROOT / t).is_file()]


def _relinked(text: str, source: str, page: str) -> str:
    folder = posixpath.dirname(source)
    base = posixpath.dirname(page)

    def replace(match: re.Match) -> str:
        target = _target(folder, match[2])
        if target is None:
            return match[0]
        there = PAGES.get(target) or _shown(target)
        if there is None and (ROOT / target).is_file():
            there = f"repository/{target}"
        return match[0] if there is None else match[1] + posixpath.relpath(there, base or ".")

    # In the repository a link's text is the file's name, in the site it is in words.
    named = _FILE_NAME.sub(lambda m: f"[{m[1].replace('_', ' ').lower()}]", text)
    return _LINK.sub(replace, named)


def _target(folder: str, link: str) -> str | None:
    """Path in the repository that a link leads to, None if it leads elsewhere."""
    if re.match(r"[a-z]+:", link):
        return None
    return posixpath.normpath(posixpath.join(folder, link))


def _shown(target: str) -> str | None:
    """Path in the site of a file in docs/, None if it is not one that the site has."""
    if not target.startswith("docs/") or target.startswith("docs/data/"):
        return None
    return target.removeprefix("docs/")
