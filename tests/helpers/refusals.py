"""What is refused, by kind and key: tests assert these, and no sentences (test_sentences.py)."""

import pytest

from codesign_jax.scene import InputError


def refusal(call, *arguments, **named):
    """Kind and key of each problem of the `InputError` that a call raises."""
    with pytest.raises(InputError) as caught:
        call(*arguments, **named)
    return [(problem.code, problem.key) for problem in caught.value.problems]
