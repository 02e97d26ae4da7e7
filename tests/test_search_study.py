"""`scripts.search`: seeds in lock step are runs of the library, and go on where they stopped."""

import json

import jax
import numpy as np
import pytest

from codesign_jax import codesign
from codesign_jax.cost import particle_cost
from scripts.search import report, study
from scripts.search.study import Study, make_case
from tests.helpers.toy_engine import tiny

SIZES = "particles=4,trials=2"


def make(path, name, budget=140):
    the_scene, space, engine = tiny()
    case = make_case(f"{name}:{SIZES}", space, "2d")
    how = {"seeds": 3, "budget": budget, "tests": 5, "chunk": 20}
    return Study(case, the_scene, engine, space, **how, path=path)


def finish(made):
    while not made.finished:
        made.step()
    made.save()
    return made


@pytest.mark.parametrize("name", ["screened-cma-es", "particle-filter"])
def test_seeds_are_runs_of_the_library_and_go_on(name, tmp_path):
    whole = finish(make(tmp_path / "whole.npz", name))
    begun = make(tmp_path / "begun.npz", name)
    for _ in range(3):
        begun.step()
    begun.save()
    again = finish(make(tmp_path / "begun.npz", name))
    assert again.row() == whole.row()
    np.testing.assert_array_equal(again.state.particles, whole.state.particles)
    # The same by the library, of one seed alone.
    the_scene, space, engine = tiny()
    optimizer = whole.case.optimizer
    task = codesign.Task(the_scene, space, 2, engine)
    state = jax.tree.map(lambda v: v[1], make(tmp_path / "none.npz", name).state)
    for _ in range(whole.done):
        state, _ = task.episode(optimizer, state)
    # Two programs round in the last bit.
    np.testing.assert_allclose(whole.state.particles[1], state.particles, rtol=1e-4, atol=1e-6)
    # All grasps are counted: those that find a poor seed, the episodes, and the test.
    before = 8 if name == "particle-filter" else 0
    assert whole.row()["grasps"][-1] == before + 8 * whole.done + 4 * study.ROUNDS


def test_what_is_recommended_was_chosen_by_fresh_trials(tmp_path):
    """The particle of the lowest cost in the mark's own trials, by the library's evaluation."""
    made = finish(make(tmp_path / "one.npz", "particle-filter"))
    the_scene, space, engine = tiny()
    task = codesign.Task(the_scene, space, study.ROUNDS, engine)
    assert made.last is not None
    candidates = made.last[0][2][np.argsort(made.last[1][2], stable=True)]
    noise = codesign.stream_key(made.keys[2], codesign.STREAM_TEST, made.done)
    costs = particle_cost(the_scene, task.evaluate(candidates, noise))
    np.testing.assert_array_equal(made.designs[made.done][2], candidates[np.argmin(costs)])


def test_the_page_gets_a_table_and_a_figure(tmp_path):
    row = {"optimizer": "ours", "preset": "2d", "grasps": [10, 20, 40]}
    row["kept"] = [[0.5, 0.96, 0.2, 0.96], [0.96, 0.97, 1.0, 0.99], [0.96, 0.97, 1.0, 0.5]]
    (tmp_path / "2d-ours.json").write_text(json.dumps(row))
    page = tmp_path / "page.md"
    page.write_text("<!-- search:begin -->\n<!-- search:end -->\n")
    figure = tmp_path / "search.png"
    assert report.main([str(tmp_path), "--page", str(page), "--figure", str(figure)]) == 0
    line = page.read_text().splitlines()[4]
    assert "| `ours` | 2d | 4 | 40 | 0.965 |" in line and "0.75 (0.30 to 0.95)" in line
    assert line.endswith("| not reached |") and figure.exists()
    assert report.reached(row | {"kept": row["kept"][:2]}, 0.9) == "20"
