"""What to try where a design is not good, or its trials do not decide: commands to give."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from codesign_jax.judge.sentences import Judged
from codesign_jax.judge.verdict import BATCH, MOST, OPEN
from codesign_jax.runs.settings import Settings

WIDER = {"pneuflex4": "pneuflex4_wide"}
"""Built-in hands, and the one with wider sections of the same fingers."""
AFFORDABLE = 1000
"""Most further trials at the accuracy `reference` to be suggested: minutes
on two cores [chosen]."""
FEW = "2d"
"""The preset with two free parameters."""


class Advice(NamedTuple):
    """Something to try."""

    what: str
    command: list[str]  # words behind `codesign`


def after_search(
    judged: Judged, settings: Settings, command: Sequence[str], folder: Path
) -> list[Advice]:
    """What to try after a search whose design is not good; nothing if it is.

    Args:
      judged: The trials that judge the design.
      settings: Those of the run.
      command: The command line that made it, or a later one that went on with it.
      folder: Its folder.
    """
    words = [*command[1:]]
    if words[:1] != ["optimize"]:  # a program called it
        words = ["optimize", "--hand", judged.scene.hand.name, "--preset", settings.preset]
        words += ["--seed", str(settings.seed), "--out", str(folder)]
    verdict = judged.verdict
    if verdict.word == "good":
        return []
    if verdict.word == OPEN and verdict.more <= AFFORDABLE:
        needed = max(BATCH * math.ceil((verdict.total + verdict.more) / BATCH), MOST)
        trials = {"--reference-trials": str(needed)}
        return [Advice("more fresh trials, which go on with these", changed(words, trials))]
    searches = []
    if value_of(words, "--seeds") is None:
        seed = settings.seed + 1
        searches.append(("another seed", {"--seed": str(seed)}, f"seed{seed}"))
    searches.append(
        ("more episodes of this search", {"--episodes": str(2 * settings.episodes)}, "")
    )
    if settings.preset == FEW:
        searches.append(("all parameters of the hand", {"--preset": "full"}, "full"))
    if wider := WIDER.get(judged.scene.hand.name):
        searches.append(("the hand with wider fingers", {"--hand": wider}, "wide"))
    return [Advice(what, elsewhere(words, flags, name)) for what, flags, name in searches]


def elsewhere(words: Sequence[str], flags: Mapping[str, str], name: str) -> list[str]:
    """A command with other flags, and another folder if it names one; without a name the same."""
    place = value_of(words, "--out")
    if name and place:
        flags = {**flags, "--out": f"{place.rstrip('/')}-{name}"}
    return changed(words, flags)


def value_of(words: Sequence[str], flag: str) -> str | None:
    """The value of a flag of a command line, or None."""
    for word, following in zip(words, [*words[1:], ""], strict=True):
        name, equals, value = word.partition("=")
        if name == flag:
            return value if equals else following
    return None


def changed(words: Sequence[str], flags: Mapping[str, str]) -> list[str]:
    """A command line whose flags have these values, in place of its own or behind them."""
    rest = []
    skip = False
    for word in words:
        flag, equals, _ = word.partition("=")
        if skip:
            skip = False
        elif flag in flags:
            skip = not equals
        elif flag != "--fresh":
            rest.append(word)
    return [*rest, *(word for pair in flags.items() for word in pair)]
