"""Populations that an episode's own program simulates, and searches that ask for them."""

from codesign_jax import codesign, optimize


def evaluate_by(episode, optimizer):
    """An evaluation (population, key) -> outcomes: with every parameter closed nothing moves."""

    def evaluate(population, key):
        return episode(*codesign.closed(optimizer, population, key))[1].outcomes

    return evaluate


def answered(asking, evaluate):
    """What a search that yields (population, key) returns in the end."""
    return optimize.answer(asking, lambda asked: evaluate(*asked))
