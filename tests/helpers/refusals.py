"""What is refused, by kind and key: tests assert these, and no sentences (test_sentences.py)."""

import pytest

from codesign_jax import cli
from codesign_jax.commands import status
from codesign_jax.scene import InputError


def refusal(call, *arguments, **named):
    """Kind and key of each problem of the `InputError` that a call raises."""
    with pytest.raises(InputError) as caught:
        call(*arguments, **named)
    return kinds(caught.value)


def refusal_of_command(*words):
    """Kind and key of each problem for which a command ends with exit status 2."""
    problems = []

    def run():
        try:
            return cli.run([str(word) for word in words])
        except InputError as error:
            problems.extend(kinds(error))
            raise

    assert status.of(run) == 2
    return problems


def kinds(error):
    """Kind and key of each problem of an error."""
    return [(problem.code, problem.key) for problem in error.problems]
