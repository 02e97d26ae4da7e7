"""Optimisation strategies as data: which parameters are open in which episode."""

import difflib
import re
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

NAMES = (
    "concurrent",
    "morphology",
    "control",
    "single",
    *(f"switch-{switches}" for switches in (1, 2, 4, 8, 16, 32)),
)
"""Strategies of the paper's section VI.4; `switch-K` takes other K as well."""


def schedule(
    name: str,
    is_morphology: ArrayLike,
    episodes: int,
    first: Literal["morphology", "control"] = "morphology",
) -> np.ndarray:
    """Mask of the parameters that may move in each episode.

    The strategies of Deimel et al. (2017), section VI.4 and Fig. 7:

    * `concurrent`: every parameter in every episode (co-design).
    * `morphology`, `control`: that domain only, whatever `first` says.
    * `single`: the domain `first` only ("s.d.").
    * `switch-K`: one domain at a time, starting in `first`, with exactly K switches. The
      K + 1 blocks differ in length by at most one episode.

    Args:
      name: Strategy, see above.
      is_morphology: True for a morphology parameter, False for a control parameter, bool,
        shape (parameter,).
      episodes: Number of episodes, at least 1.
      first: Domain of the first episode for `single` and `switch-K`.

    Returns:
      True where a parameter is open, bool, shape (episode, parameter).

    Raises:
      ValueError: If an argument is invalid, K is not below `episodes`, or the strategy needs
        a domain without parameters.
    """
    domain = np.asarray(is_morphology)
    if domain.dtype != bool or domain.ndim != 1:
        raise ValueError(
            f"is_morphology must be bool, shape (parameter,): {domain.dtype} {domain.shape}"
        )
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    if first not in ("morphology", "control"):
        raise ValueError(f"first must be 'morphology' or 'control', got {first!r}")
    if name == "concurrent":
        mask = np.ones((episodes, domain.size), bool)
    else:
        mask = _morphology_open(name, episodes, first)[:, None] == domain
    if not mask.any(axis=1).all():
        raise ValueError(f"schedule {name!r} opens a domain that has no parameters")
    return mask


def _morphology_open(name: str, episodes: int, first: str) -> np.ndarray:
    """Whether morphology (else control) is open, bool, shape (episode,)."""
    switches = 0
    if name in ("morphology", "control"):
        first = name
    elif name != "single":
        switches = _switches(name)
    if switches >= episodes:
        raise ValueError(f"{name!r} needs at least {switches + 1} episodes, got {episodes}")
    block = np.arange(episodes) * (switches + 1) // episodes
    return (block % 2 == 0) == (first == "morphology")


def _switches(name: str) -> int:
    match = re.fullmatch(r"switch-([1-9][0-9]*)", name)
    if match:
        return int(match[1])
    near = difflib.get_close_matches(name, NAMES, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise ValueError(f"unknown schedule {name!r}; {hint}Valid: {', '.join(NAMES)}, any switch-K")
