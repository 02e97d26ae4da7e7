"""Sizes that a run has where none are asked for.  The help text reads them: nothing heavy here."""

from typing import NamedTuple


class Sizes(NamedTuple):
    """Sizes of a run."""

    particles: int
    trials: int  # trials of a particle in an episode
    episodes: int
    test_trials: int  # further trials of each particle of the final test


PAPER = {"2d": Sizes(10, 6, 64, 36), "": Sizes(60, 6, 128, 72)}
"""The paper's (sections VI.2 and VI.4), by preset or for all others, which the optimisers that are
compared with the paper's share."""
SCREENED = {"2d": Sizes(12, 3, 22, 48), "": Sizes(25, 3, 30, 48)}
"""Those of the screened searches, by docs/notes/search.md; `trials` is the least, as each particle
meets every object."""


SEARCH_EPISODES = 62
"""Episodes of a screened search of many parameters at a coarser accuracy than its test: as many as
take the time of `SCREENED` at the accuracy `standard`; docs/accuracy.md has the rates."""


def text(name: str) -> str:
    """The defaults of a size, as in "12 in 2d, 25 otherwise; the paper's are 10 and 60"."""
    two, many, paper_two, paper_many = (
        getattr(sizes[preset], name) for sizes in (SCREENED, PAPER) for preset in ("2d", "")
    )
    if name == "trials":
        return f"one with each object, and at least {many}; the paper's are {paper_many}"
    if name == "episodes":
        return (
            f"{two} in 2d, {SEARCH_EPISODES} otherwise, or {many} with one accuracy for search and "
            f"test; the paper's are {paper_two} and {paper_many}"
        )
    return f"{two} in 2d, {many} otherwise; the paper's are {paper_two} and {paper_many}"
