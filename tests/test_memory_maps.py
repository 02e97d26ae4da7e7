"""A process that meets many structures drops programs before Linux ends it."""

import types

import jax
import numpy as np
import pytest

from codesign_jax import codesign, memory_maps, programs
from codesign_jax.compiler.ffi import KernelUnavailable
from codesign_jax.scene import parameters
from tests.helpers import grasps, kernels


def full(monkeypatch, share):
    """The process has this share of the maps that it may have."""
    monkeypatch.setattr(memory_maps, "count", lambda: int(share * memory_maps.most()))


def test_the_system_tells_how_many_maps_there_are():
    assert 100 < memory_maps.count() < memory_maps.most()


def test_programs_go_when_many_maps_are_taken(monkeypatch):
    """All that nobody holds; a program that is held works on."""
    cleared, built, scene = [], [], types.SimpleNamespace(structure="s")
    monkeypatch.setattr(memory_maps, "forgetters", [])
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(1))
    find = programs.shared(lambda *how: built.append(how) or (lambda v: v + 1))

    def get(number):
        return find(scene, "engine", types.SimpleNamespace(structure=number), None)

    full(monkeypatch, 0.29)
    first = get(0)
    assert get(0) is first and get(1) is not first and not cleared
    full(monkeypatch, 0.31)
    assert get(0) is first and not cleared  # nothing new is made
    get(2)
    assert cleared == [1]
    full(monkeypatch, 0.1)
    assert get(0) is not first and get(2) is get(2) and cleared == [1]
    assert first(1) == 2


def test_a_kernel_is_refused_before_the_limit(monkeypatch):
    full(monkeypatch, 0.91)
    with pytest.raises(KernelUnavailable, match=r"memory maps that Linux allows.*clear_caches"):
        jax.jit(lambda *v: kernels.run(*v, rounds=3))(*kernels.numbers(2))
    full(monkeypatch, 0.89)
    jax.jit(lambda *v: kernels.run(*v, rounds=3))(*kernels.numbers(2))


def test_what_ctrl_c_left_in_jax_is_forgotten(monkeypatch):
    """The next call works; another recursion is an error as ever."""
    cleared, scene = [], grasps.pinch("sphere", 2)
    words = ["Recursively calling <weakref> multiply"]

    def stuck(*_):
        if words and not cleared:
            raise RecursionError(words[0])
        return 3

    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(1))
    program = programs.Program(scene, stuck)
    assert program(0, 0) == 3 and cleared == [1]
    cleared.clear()
    words[0] = "maximum recursion depth exceeded"
    with pytest.raises(RecursionError, match="maximum"):
        program(0, 0)
    assert not cleared


def test_a_forked_process_says_that_it_would_wait_for_ever(monkeypatch):
    """Only of a process that had simulated; its own first call is then an error at once."""
    program = programs.Program(grasps.pinch("sphere", 2), lambda *_: 3)
    for begun in (False, True):
        monkeypatch.setattr(programs, "process", {"begun": begun, "forked": False})
        programs.note_fork()
        if begun:
            with pytest.raises(RuntimeError, match="forked from one that had simulated.*spawn"):
                program(0, 0)
        else:
            assert program(0, 0) == 3


@pytest.mark.slow  # test_programs_go_when_many_maps_are_taken keeps the idea
def test_many_structures_stay_below_a_limit(monkeypatch):
    """Eight structures under a limit that the maps of four exceed."""
    effects = dict.fromkeys(("disturb", "ungrasp", "palm_object", "palm_table", "twist"), False)
    changes = {f"effects__{name}": value for name, value in effects.items()}
    changes |= {"phases__approach": 0.05, "phases__inflate": 0.1, "phases__lift": 0.15}
    found = []
    for links in range(2, 11):
        scene = grasps.pinch("sphere", links, **changes)
        space = parameters.design_space(scene.hand)
        evaluate = codesign.Task(scene, space, 2).evaluate
        population = np.repeat(np.asarray(space.default(), np.float32)[None], 2, 0)
        jax.block_until_ready(evaluate(population, jax.random.key(0)))
        found.append(memory_maps.count())
        if len(found) == 2:  # the first one also loads libraries
            each = found[1] - found[0]
            most = int((found[1] + 2 * each) / 0.3)
            monkeypatch.setattr(memory_maps, "most", lambda most=most: most)
    # Programs are dropped when the next ones are made.
    assert each > 50 and max(found) < found[1] + 4 * each
