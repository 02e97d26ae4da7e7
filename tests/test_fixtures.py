"""Fixtures: boxes, cylinders and planes that fingers, palm and object touch, against MuJoCo C."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import preflight
from codesign_jax.engines import make_engine
from codesign_jax.runs import scene_files
from codesign_jax.scene import schema
from tests.helpers import grasps
from tests.helpers.fixtures import POST, SHELF, SLOPES, WALL, loaded


@pytest.mark.parametrize(("overhang", "stays"), [(0.02, True), (0.035, False)])
def test_an_object_rests_on_a_shelf_or_tips_over_its_edge(tmp_path, overhang, stays):
    """A box of 60 mm with its face `overhang` beyond the edge, as in MuJoCo C after a second."""
    shelf = SHELF.replace("-0.1, 0.0", f"{-0.08 - overhang:g}, 0.0")  # ends at x = 30 mm - overhang
    the_scene = loaded(tmp_path, shelf, "box", **{"effects.table": False})
    fields, ctrl = grasps.batch_inputs(the_scene, *map(grasps.stack, grasps.hand_world(the_scene)))
    flat = jnp.array([0.0, 0.0, 0.03, 1.0, 0.0, 0.0, 0.0], fields.start.dtype)
    fields = fields._replace(start=fields.start.at[:, -7:].set(flat))
    held = jnp.asarray(np.repeat(ctrl[:, :1], 100, 1))
    engines = make_engine("structured", the_scene).recording(), make_engine("mujoco", the_scene)
    for engine in engines:
        trace = jax.jit(partial(engine.rollout, trajectory=True))(fields, held)
        height = float(trace.height[0, -1])
        assert abs(height - 0.03) < 1e-3 if stays else height < -0.1, height  # no failure
        if trace.forces is not None:
            push = float(trace.forces.table[0, -2, 2])
            weight = 9.81 * float(fields.body_mass[0, -1])
            assert push == pytest.approx(weight if stays else 0.0, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("size = [0.01, 0.1, 0.05]", "size = [0.01, 0.1]"), "a box has 3 values"),
        (("size = [0.01, 0.1, 0.05]", ""), "a box has 3 values"),
        (('type = "box"', 'type = "plane"'), "a plane has no size"),
        (("position = [0.06, 0.0, 0.05]", "position = [0.06, 0.0]"), "three coordinates"),
        (("[0, 10, 0]", "[0, 10]"), "orientation must be roll, pitch and yaw"),
        (('type = "box"', 'type = "mesh"'), "'mesh' is not valid"),
    ],
)
def test_wrong_fixtures_are_told(tmp_path, change, expected):
    with pytest.raises(schema.InputError, match=expected):
        loaded(tmp_path, WALL.replace(*change), "box")


def test_a_hand_that_starts_in_a_fixture_is_refused(tmp_path):
    high = WALL.replace("0.06, 0.0, 0.05", "0.06, 0.0, 0.2")
    the_scene = loaded(tmp_path, high, "box")
    params, _ = grasps.hand_world(the_scene)
    designs = jax.tree.map(lambda v: np.asarray(v)[None], params)
    [refusal] = preflight.refusals(the_scene, designs, ["it"])
    assert "inside the table, a fixture or object 'box'" in refusal


def test_what_mjx_does_not_collide_is_refused(tmp_path):
    with pytest.raises(
        schema.InputError, match="engine mjx: object 'box', a box, with fixture 'post'"
    ):
        make_engine("mjx", loaded(tmp_path, POST, "box"))


def test_a_scene_with_fixtures_is_kept(tmp_path):
    the_scene = loaded(tmp_path, WALL + POST + SLOPES, "box")
    scene_files.write_scene(the_scene, tmp_path / "run")  # reads it back and compares
    assert the_scene.structure != loaded(tmp_path, WALL + POST, "box").structure
