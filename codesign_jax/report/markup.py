"""Pieces of HTML of which a report is made."""

import html
import shlex
from collections.abc import Iterable, Sequence


class Html(str):
    """Text that is HTML already."""


def text(value: object) -> str:
    """A value as text that is not taken for HTML."""
    return html.escape(str(value))


def paragraph(words: str, kind: str = "", command: Sequence[str] = ()) -> str:
    """A paragraph that may end with a command of `codesign`."""
    code = f"<code>{text(shlex.join(['codesign', *command]))}</code>" if command else ""
    return f"<p class='{kind}'>{text(words)}{code}</p>" if words else ""


def section(title: str, *parts: str) -> str:
    """A heading and what follows it."""
    return f"<h2>{text(title)}</h2>\n" + "\n".join(parts)


def table(
    head: Sequence[str], rows: Iterable[Sequence[object]], numbers: Sequence[int] = ()
) -> str:
    """An HTML table; cells that are `Html` stay as they are, columns in numbers stand right."""

    def cell(tag: str, k: int, value: object) -> str:
        kind = " class='number'" if k in numbers else ""
        inside = value if isinstance(value, Html) else text(value)
        return f"<{tag}{kind}>{inside}</{tag}>"

    def line(tag: str, values: Sequence[object]) -> str:
        return "<tr>" + "".join(cell(tag, k, v) for k, v in enumerate(values)) + "</tr>"

    top = line("th", head) if head else ""
    inside = top + "".join(line("td", row) for row in rows)
    return f"<div class='table'><table>{inside}</table></div>"  # which scrolls on a phone
