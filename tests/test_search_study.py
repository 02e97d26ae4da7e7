"""`scripts.search`: seeds in lock step are runs of the library, and go on where they stopped."""

import json

import jax
import numpy as np
import pytest

from codesign_jax import codesign
from codesign_jax.cost import particle_cost
from scripts import search
from scripts.search import Study, make_case
from tests.helpers.toy_engine import tiny

SIZES = "particles=4,trials=2"


def make(path, name):
    budget = 176 if name == "screened-es" else 140  # its final test is larger
    the_scene, space, engine = tiny()
    case = make_case(f"{name}:{SIZES}", space, "2d")
    how = {"seeds": 3, "budget": budget, "tests": 5, "chunk": 20}
    return Study(case, the_scene, engine, space, **how, path=path)


def finish(made):
    while not made.finished:
        made.step()
    made.save()
    return made


@pytest.mark.slow  # quick: a vmapped run is that of each seed alone (test_codesign)
def test_seeds_are_runs_of_the_library_and_go_on(tmp_path):
    whole = finish(make(tmp_path / "whole.npz", "screened-es"))
    begun = make(tmp_path / "begun.npz", "screened-es")
    for _ in range(3):
        begun.step()
    begun.save()
    again = finish(make(tmp_path / "begun.npz", "screened-es"))
    assert again.row() == whole.row()
    np.testing.assert_array_equal(again.state.particles, whole.state.particles)
    # The same by the library, of one seed alone.
    the_scene, space, engine = tiny()
    optimizer = whole.case.optimizer
    task = codesign.Task(the_scene, space, 2, engine)
    state = jax.tree.map(lambda v: v[1], make(tmp_path / "none.npz", "screened-es").state)
    for _ in range(whole.done):
        state, _ = task.episode(optimizer, state)
    # Two programs round in the last bit.
    np.testing.assert_allclose(whole.state.particles[1], state.particles, rtol=1e-4, atol=1e-6)
    # All grasps are counted: the episodes and the test.
    assert whole.row()["grasps"][-1] == 8 * whole.done + whole.tested
    assert whole.tested == 4 * 36


@pytest.mark.slow  # quick: what is reported of stored rows, below
def test_what_is_recommended_was_chosen_by_fresh_trials(tmp_path):
    """The particle of the lowest cost in the mark's own trials, by the library's evaluation."""
    made = finish(make(tmp_path / "one.npz", "particle-filter"))
    the_scene, space, engine = tiny()
    task = codesign.Task(the_scene, space, search.ROUNDS, engine)
    # All grasps are counted: those that find a poor seed, the episodes, and the test.
    assert made.row()["grasps"][-1] == 8 + 8 * made.done + made.tested
    assert made.tested == 4 * search.ROUNDS and made.last is not None
    candidates = made.last[0][2][np.argsort(made.last[1][2], stable=True)]
    noise = codesign.stream_key(made.keys[2], codesign.STREAM_TEST, made.done)
    costs = particle_cost(the_scene, task.evaluate(candidates, noise))
    np.testing.assert_array_equal(made.designs[made.done][2], candidates[np.argmin(costs)])


def test_the_page_gets_a_table_and_a_figure(tmp_path):
    row = {"optimizer": "ours", "preset": "2d", "grasps": [10, 20, 40]}
    row |= {"provenance": {"commit": "abc12345"}}
    row["kept"] = [[0.5, 0.96, 0.2, 0.96], [0.96, 0.97, 1.0, 0.99], [0.96, 0.97, 1.0, 0.5]]
    (tmp_path / "2d-ours.json").write_text(json.dumps(row))
    whole = row | {"optimizer": "screened-es", "preset": "23d"}
    part = whole | {"optimizer": "screened-es:tests=0"}
    (tmp_path / "23d-screened-es.json").write_text(json.dumps(whole))
    (tmp_path / "23d-tests0.json").write_text(json.dumps(part))
    page = tmp_path / "page.md"
    page.write_text("<!-- search:begin -->\n<!-- search:end -->\n")
    figure = tmp_path / "search.png"
    command = ["--report", str(tmp_path), "--page", str(page), "--figure", str(figure)]
    assert search.main(command) == 0
    lines = page.read_text().splitlines()
    assert lines[4].startswith("| `screened-es` | 23d |"), "23 parameters first"
    line = lines[5]
    assert "| `ours` | 2d | three | 4 | 40 | 0.965 |" in line and "0.75 (0.30 to 0.95)" in line
    assert not [text for text in lines if "tests=0" in text], "a part of it left out"
    assert line.endswith("| not reached | abc1234 |") and figure.exists()
    assert search.reached(row | {"kept": row["kept"][:2]}, 0.9) == "20"
