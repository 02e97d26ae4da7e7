"""Every public name has an example in its docstring, and the examples are right."""

import doctest

import pytest

import codesign_jax

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS


def examples(name):
    """Tests of a public name: its own docstring and, of a module, those of what it defines."""
    found = doctest.DocTestFinder(exclude_empty=True).find(getattr(codesign_jax, name), name)
    return [test for test in found if test.examples]


@pytest.mark.parametrize("name", codesign_jax.__all__)
def test_examples_are_right(name, capsys):
    tests = examples(name)
    assert tests, f"codesign_jax.{name} has no example"
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    for test in tests:
        test.globs = {}  # an example imports what it takes
        runner.run(test)
    assert not runner.failures, capsys.readouterr().out


def test_a_wrong_example_is_found():
    test = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, 0)
    assert doctest.DocTestRunner().run(test, out=lambda _: None).failed == 1
