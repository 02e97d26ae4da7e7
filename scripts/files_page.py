"""Writes docs/files.md, the reference of a run folder's files and columns."""

from pathlib import Path

from codesign_jax.runs import columns

if __name__ == "__main__":
    page = Path(__file__).parent.parent / "docs" / "files.md"
    page.write_text(columns.page(), encoding="utf-8")
    print(page)
