"""Pieces of HTML of which a report is made."""

import html
import shlex
from collections.abc import Iterable, Mapping, Sequence

from codesign_jax.report import bodies


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


def folded(title: str, *parts: str) -> str:
    """A part of a page that is closed until somebody opens it."""
    return f"<details><summary>{text(title)}</summary>{''.join(parts)}</details>"


def table(
    head: Sequence[object],
    rows: Iterable[Sequence[object]],
    numbers: Sequence[int] = (),
    parts: Mapping[int, str] = {},
) -> str:
    """An HTML table; cells that are `Html` stay as they are, columns in numbers stand right.

    Args:
      parts: Names of the viewer's parts that rows are about, by row.
    """

    def cell(tag: str, k: int, value: object) -> str:
        kind = " class='number'" if k in numbers else ""
        inside = value if isinstance(value, Html) else text(value)
        return f"<{tag}{kind}>{inside}</{tag}>"

    def line(tag: str, values: Sequence[object], part: str = "") -> str:
        about = f" data-part='{text(part)}'" if part else ""
        return f"<tr{about}>" + "".join(cell(tag, k, v) for k, v in enumerate(values)) + "</tr>"

    top = line("th", head) if head else ""
    inside = top + "".join(line("td", row, parts.get(k, "")) for k, row in enumerate(rows))
    # Which scrolls on a phone, also by keys.
    return f"<div class='table'><div tabindex='0'><table>{inside}</table></div></div>"


def finger(number: int, words: object | None = None) -> Html:
    """The number of a finger, or words about it, beside its colour."""
    swatch = f"<i class='swatch' style='background:{bodies.finger_color(number)}'></i>"
    return Html(swatch + text(number if words is None else words))


def shares(counts: Mapping[str, int], total: int) -> Html:
    """A bar whose pieces are shares of a total, by the classes of style.css that colour them."""
    pieces = [
        f"<i class='{kind}' style='width:{100 * count / total:.2f}%' "
        f"title='{text(kind.replace('_', ' '))}: {count} of {total}'></i>"
        for kind, count in counts.items()
        if count
    ]
    return Html(f"<div class='shares'>{''.join(pieces)}</div>")
