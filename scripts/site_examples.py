"""An extension of the API reference's parser: examples of docstrings become code blocks.

Doctests stand between the paragraphs of a docstring, without a heading; Markdown would take their
prompts for quotations.
"""

import re
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^>>> .*?(?=^\s*$|\Z)", re.M | re.S)


def fenced(text: str) -> str:
    """A docstring's text with its examples as code blocks."""
    return _EXAMPLE.sub(lambda example: f"```pycon\n{example[0].rstrip()}\n```\n", text)


class Examples(griffe.Extension):
    """Rewrites the docstring of every object."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Takes an object once its members are known."""
        if obj.docstring is not None:
            obj.docstring.value = fenced(obj.docstring.value)
