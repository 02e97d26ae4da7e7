"""Markdown tables, and their places in pages."""

from pathlib import Path

from codesign_jax import files


def markdown(rows: list[list[str]]) -> str:
    """A Markdown table; the first row is its head."""
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def fill(page: Path, text: str, mark: str) -> None:
    """Replaces what stands between the marks of a page, NAME:begin and NAME:end in comments."""
    begin, end = f"<!-- {mark}:begin -->", f"<!-- {mark}:end -->"
    old = page.read_text(encoding="utf-8")
    if begin not in old or end not in old:
        raise ValueError(f"{page} holds no {begin} and {end}")
    head, tail = old.split(begin)[0], old.split(end)[1]
    with files.atomically(page) as part:
        part.write_text(f"{head}{begin}\n\n{text}\n\n{end}{tail}", encoding="utf-8")
