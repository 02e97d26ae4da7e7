"""Which font draws a text, and what of it no font of the system can."""

from typing import NamedTuple

import matplotlib.font_manager as manager

DEFAULT = "DejaVu Sans"
"""The font that comes with matplotlib."""


class Drawable(NamedTuple):
    """A text that fonts of this system can draw."""

    text: str  # the text in a line, with ? for what cannot be drawn
    family: list[str]  # fonts, the first of which that has a letter draws it
    lacking: list[str]  # letters that no font has, each once


def of_text(text: str) -> Drawable:
    """Chooses fonts for a text, the default one first."""
    text = " ".join(text.split())
    family = [DEFAULT]
    missing = _lacking(DEFAULT, dict.fromkeys(text))
    if missing:
        for font in sorted({entry.name for entry in manager.fontManager.ttflist}):
            if not missing:
                break
            rest = _lacking(font, missing)
            if len(rest) < len(missing):
                family.append(font)
                missing = rest
    for letter in missing:
        text = text.replace(letter, "?")
    return Drawable(text, family, [*missing])


def _lacking(font: str, letters: dict[str, None]) -> dict[str, None]:
    """Letters that a font has not; all of them if it cannot be read."""
    try:
        path = manager.findfont(manager.FontProperties(family=font))
        known = manager.get_font(path).get_charmap()
    except (OSError, RuntimeError, ValueError):
        return letters
    return {letter: None for letter in letters if ord(letter) not in known}
