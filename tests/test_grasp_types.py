"""Grasp types: postures are what MuJoCo's joints say, clusters what was planted, videos succeed."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from codesign_jax import rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.report import animation
from codesign_jax.scene import parameters
from codesign_jax.types import Outcome
from scripts.experiments import figures, grasp_types


@pytest.fixture(scope="module")
def setup():
    """The paper's scene with two links a finger, its two parameters, MuJoCo C."""
    the_scene = scene.load("paper_spheres", overrides={"discretization": {"links": 2}})
    space = parameters.design_space(the_scene.hand, "2d")
    return the_scene, make_engine("mujoco", the_scene), space


def planted(counts=(40, 25, 10), seed=0):
    """Groups of known sizes, far apart in features of different scales."""
    draws = np.random.default_rng(seed)
    groups = [[8 * k, 800 * (k % 2)] + draws.normal(size=(n, 2)) * [1, 100] for k, n in
              enumerate(counts)]  # fmt: skip
    labels = np.repeat(np.arange(len(counts)), counts)
    order = draws.permutation(len(labels))
    return np.concatenate(groups)[order], labels[order]


def test_planted_groups_are_found_with_the_largest_first():
    features, labels = planted()
    found, scores = grasp_types.cluster(features)
    np.testing.assert_array_equal(found, labels)
    assert scores.argmax() == 1 and scores[1] > 0.7  # three groups


def test_one_cloud_has_a_small_silhouette():
    cloud = np.random.default_rng(0).normal(size=(200, 3))
    assert grasp_types.cluster(cloud)[1].max() < 0.35
    with pytest.raises(ValueError, match="cannot be clustered"):
        grasp_types.cluster(np.ones((20, 3)))


def test_the_silhouette_is_rousseeuw_s():
    """Against the definition, sample by sample; a cluster of one counts as zero."""
    points, labels = planted((5, 4, 1), seed=1)
    expected = []
    for i, label in enumerate(labels):
        away = np.linalg.norm(points - points[i], axis=1)
        own = (labels == label) & (np.arange(len(labels)) != i)
        others = [away[labels == m].mean() for m in set(labels) - {label}]
        a, b = (away[own].mean() if own.any() else None), min(others)
        expected.append(0.0 if a is None else (b - a) / max(a, b))
    assert grasp_types.silhouette(points, labels) == pytest.approx(np.mean(expected))


def test_postures_are_the_fingers_angles_at_the_end_of_the_lift(setup):
    the_scene, engine, space = setup
    designs = space.from_units(np.array([[60.0, 0.0], [120.0, -20.0], [20.0, 190.0]]))
    bend, kept, tilt = grasp_types.postures(
        the_scene, engine, space, designs, chunk=5, say=lambda _: None
    )
    assert bend.shape == kept.shape == tilt.shape == (3, 3)
    assert not kept[2].any()  # far above the objects
    trials = grasp_types.stack([rollout.nominal_trial(the_scene, 1)])
    replay = animation.replay(the_scene, engine, space.params(designs[1]), trials)[0]
    joints = replay.qpos[450][6:-7].reshape(4, 2, 3)  # finger, link, axis: bending first
    assert bend[1, 1] == pytest.approx(joints[..., 0].sum(1).mean(), abs=1e-6)
    assert bool(kept[1, 1]) == bool(replay.outcome.cost == 0)
    turned = Rotation.from_quat(replay.qpos[:451, -4:], scalar_first=True).apply([0, 0, 1])
    # arccos of float32 near 1 resolves 5e-4.
    assert tilt[1, 1] == pytest.approx(np.arccos(turned[:, 2]).max(), abs=1e-3)
    assert bend[1].mean() > bend[0].mean() > 0.1  # longer fingers curl further


def test_types_stand_at_the_points_that_were_simulated(setup, monkeypatch):
    """Postures that follow from the length alone; one design drops an object."""
    the_scene, engine, space = setup
    x, y = np.linspace(40, 120, 9), np.linspace(-20, 20, 3)
    cost = np.where(x[:, None] + 0 * y < 50, 2.0, 0.5)
    grid = {"first_axis": x, "second_axis": y, "exclude": cost}

    def postures(_scene, _engine, _space, designs, say):
        length = 1e3 * np.asarray(designs)[:, 0]
        kept = np.ones((len(designs), 3), bool)
        kept[np.argmax(length > 115), 1] = False
        bend = np.repeat(np.where(length > 85, 1.5, 0.5)[:, None], 3, 1) + 1e-4 * length[:, None]
        return bend, kept, 2 * bend

    monkeypatch.setattr(grasp_types, "postures", postures)
    found = grasp_types.study(grid, the_scene, engine, space, 1.0)
    expected = np.where(x < 50, -1, np.where(x > 85, 1, 0))[:, None] + np.zeros((9, 3), int)
    expected[8, 0] = -1
    # As many designs on either side: the cluster without the dropped one is the larger.
    np.testing.assert_array_equal(found["type"], expected)
    np.testing.assert_array_equal(np.isnan(found["bend"][..., 0]), cost > 1)
    assert found["bend"][1, 2, 0] == pytest.approx(0.5 + 1e-4 * 50)
    np.testing.assert_allclose(found["tilt"], 2 * found["bend"])


def small():
    """A landscape of 3 x 2 points, four of them of two types."""
    grid = {
        "first_axis": np.array([50.0, 60.0, 120.0]),
        "second_axis": np.array([-20.0, 0.0]),
        "exclude": np.array([[0.1, 0.0], [0.0, 2.0], [0.3, 0.2]]),
        "parameters": np.array(["length", "arm_z"]),
        "units": np.array(["mm", "mm"]),
    }
    bend = np.full((3, 2, 3), np.nan)
    bend[0, 0], bend[0, 1], bend[1, 0], bend[2] = 0.5, 0.9, 0.6, 1.5
    types = np.array([[0, 0], [0, -1], [1, 1]])
    return grid, {"type": types, "bend": bend, "silhouette": np.array([0.7, 0.5])}


def test_a_type_is_shown_by_its_best_and_most_typical_design(tmp_path):
    grid, found = small()
    assert grasp_types.typical(grid, found, 0)[0] == (1, 0)  # 0.6 is nearer the mean than 0.9
    assert grasp_types.typical(grid, found, 1)[0] == (2, 1)
    table = grasp_types.describe(grid, found)
    assert "| 1 | 3 | 50 to 60 | -20 to 0 | 38° [29, 52] | – | 0.03 |" in table
    tilted = grasp_types.describe(grid, found | {"tilt": found["bend"] / 2})
    assert "| 38° [29, 52] | 17° [14, 26] | 0.03 |" in tilted
    assert "2: 0.70, 3: 0.50" in table
    path = figures.landscape(grid, tmp_path / "map.png", types=found["type"])
    plain = figures.landscape(grid, tmp_path / "plain.png")
    assert path.read_bytes() != plain.read_bytes()


def test_videos_are_of_grasps_that_hold(setup, tmp_path, monkeypatch):
    the_scene, engine, space = setup
    grid, found = small()
    shown = []

    def write(_, grasps, path, **options):
        shown.append((path.name, [jax.device_get(g.params.length) for g in grasps]))
        return path

    def replay(cost):
        trial = animation.Replay
        return lambda s, e, params, trials: (
            [
                trial(params, None, Outcome(np.float32(cost), 0, 0, 0), None)  # type: ignore[arg-type]
            ]
            * len(trials.yaw)
        )

    monkeypatch.setattr(animation, "write_gif", write)
    monkeypatch.setattr(animation, "replay", replay(0.0))
    grasp_types.videos(grid, found, the_scene, engine, space, tmp_path)
    assert [name for name, _ in shown] == ["grasp_type_1.gif", "grasp_type_2.gif"]
    for (_, lengths), expected in zip(shown, (0.06, 0.12), strict=True):
        assert len(lengths) == 3
        np.testing.assert_allclose(lengths, expected, rtol=1e-5)
    monkeypatch.setattr(animation, "replay", replay(0.5))
    with pytest.raises(ValueError, match="designs of type 1 lose an object"):
        grasp_types.videos(grid, found, the_scene, engine, space, tmp_path)
