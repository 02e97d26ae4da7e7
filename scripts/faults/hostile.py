"""Hostile TOML values, texts and files: the same ones for the same generator of random numbers."""

import random
import re

NUMBERS = (
    *("0", "-1", "1", "1e308", "-1e308", "1e-320", "1e999", "inf", "-inf", "nan", "-0.0", "0x10"),
    *("9" * 400, "9" * 5000, "0x" + "f" * 5000, "1e", "1_000", "01", "true", "2147483648"),
    *("9223372036854775808", "0.1", "200", "3", "1979-05-27", "07:32:00", "1e-9", "25", "100"),
)
TEXTS = (
    *("", " ", ".", "..", "/etc/passwd", "../../x", "a/b", "nan", "-x", "~", "paper", "full", "2d"),
    *(
        "a\u2028b",
        "a\u2029b",
        "a\u0085b",
        "a\x00b",
        "a\x1b[31mb",
        "a\rb",
        "a\nb",
        "\ufeffa",
        "\u202ea",
    ),
    *("é" * 200, "x" * 5000, "<img src=x>", "a.toml", "none.toml", "%j", "$(id)", "日本", "😀"),
    *("a" * 300 + ".toml", "\\", '"', "a\\u0000b", "[0]", "\udcff", "\ud800"),
)
VALUES = (
    *("[]", "{}", "[[]]", "[{}]", "[1, 2]", "[1, 'a']", "{a = 1}", "''", "'''\na'''", "[nan]"),
    *("[15, 20, 25, 30]", "[1e308, 1, 2, 3]", "[nan, 1, 2, 3]", "[20]", "[20, 20, 20]", "[true]"),
    *("[" * 2000, "[" * 50 + "]" * 50, "{a=" * 100 + "1" + "}" * 100, "[" + "0," * 2000 + "]"),
)
NUMBER = re.compile(r"-?\d[\d_.]*(e-?\d+)?")
_STRING = re.compile(r'"[^"\n]*"')


def _toml_text(text: str) -> str:
    """A text as a TOML string, raw: what is not allowed there is part of the test."""
    return f'"{text}"'


def value(rng: random.Random) -> str:
    """A hostile TOML value."""
    kind = rng.randrange(4)
    if kind == 0:
        return rng.choice(VALUES)
    if kind == 1:
        return _toml_text(rng.choice(TEXTS))
    return rng.choice(NUMBERS)


def replace(rng: random.Random, pattern: re.Pattern, text: str, new: str) -> str:
    """The text with something else in the place of one match of a pattern."""
    found = [*pattern.finditer(text)]
    if not found:
        return text
    at = rng.choice(found)
    return text[: at.start()] + new + text[at.end() :]


def _lines(rng: random.Random, text: str) -> str:
    """Leaves out, repeats, exchanges or moves lines."""
    lines = text.split("\n")
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(4)
    if kind == 0:
        del lines[min(i, j) : min(i, j) + rng.choice((1, 1, 1, 5))]
    elif kind == 1:
        lines[i:i] = lines[j : j + rng.choice((1, 1, 3, 10))] * rng.choice((1, 1, 2, 1000))
    elif kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    else:
        lines.insert(i, _new_line(rng))
    return "\n".join(lines)


def _new_line(rng: random.Random) -> str:
    """A line of a key, a table or nothing of the kind."""
    key = rng.choice(("x", "name", "hand", "gravity", '"a b"', "a.b.c", "a." * 3000 + "b", "size"))
    kind = rng.randrange(5)
    if kind == 0:
        return f"[{key}]"
    if kind == 1:
        return f"[[{key}]]"
    if kind == 2:
        return rng.choice(TEXTS)
    return f"{key} = {value(rng)}"


def mutate_bytes(rng: random.Random, data: bytes) -> bytes:
    """Flips, inserts, cuts or repeats bytes."""
    changed = bytearray(data)
    if not changed:
        return b"x"
    at = rng.randrange(len(changed))
    kind = rng.randrange(6)
    if kind == 0:
        for _ in range(rng.choice((1, 1, 4, 32))):
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        changed[at:at] = rng.choice(
            (b"\xff", b"\x00", b"\xef\xbb\xbf", b"\r", b"\xe2\x80\xa8", b"\xed\xa0\x80")
        )
    elif kind == 2:
        del changed[at:]
    elif kind == 3:
        del changed[at : at + rng.choice((1, 4, 50))]
    elif kind == 4:
        changed[at:at] = changed[at : at + 100] * rng.choice((1, 10, 100))
    else:
        changed[at] = rng.randrange(256)
    return bytes(changed)


def mutate_toml(rng: random.Random, text: str) -> bytes:
    """A TOML file with one to three hostile changes.

    Args:
      rng: Says which.
      text: The file as it should be.
    """
    data: bytes | None = None
    for _ in range(rng.choice((1, 1, 2, 3))):
        kind = rng.randrange(10)
        if kind < 3:
            text = replace(
                rng, NUMBER, text, value(rng) if rng.random() < 0.3 else rng.choice(NUMBERS)
            )
        elif kind < 5:
            text = replace(rng, _STRING, text, _toml_text(rng.choice(TEXTS)))
        elif kind == 5:
            text = replace(rng, re.compile(r"(?<== ).*"), text, value(rng))
        elif kind == 6:
            text = replace(
                rng, re.compile(r"^[\w.]+(?= =)", re.M), text, rng.choice(("x", "a" * 5000))
            )
        elif kind == 7:
            text = _lines(rng, text)
        elif kind == 8:
            text = text + rng.choice(("\n", "x = 1\n" * 60_000, "#" * 400_000, "\n[a]\n" * 2000))
        else:
            data = mutate_bytes(rng, text.encode("utf-8", "surrogatepass"))
            text = data.decode("utf-8", "replace") if rng.random() < 0.5 else text
    if data is not None and rng.random() < 0.5:
        return data
    return text.encode("utf-8", "surrogatepass")
