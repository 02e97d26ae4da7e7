"""`codesign render`, `replay` and `landscape`: one grasp is simulated, a grid is complete."""

import csv
import dataclasses
import json
import re
import sys

import jax
import numpy as np
import pytest
from PIL import Image

from codesign_jax import batch, cli, codesign, runs
from codesign_jax import scene as scenes
from codesign_jax.commands import common, flags, grid
from codesign_jax.commands import landscape as landscapes
from codesign_jax.engines import make_engine
from codesign_jax.report import animation, landscape
from codesign_jax.runs import selection
from codesign_jax.scene.parameters import design_space
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome, failed
from tests.helpers.command_runs import small_run  # noqa: F401
from tests.helpers.refusals import refusal_of_command
from tests.helpers.toy_engine import TINY

GRID = ("landscape", "--scene", str(TINY), "--engine", "mujoco", "--parameters")
DESIGN = ["--scene", str(TINY), "--engine", "mujoco", "--design", "length=100", "arm_z=0"]


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    """An empty working directory and a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


@pytest.fixture
def simulated(monkeypatch):
    """Worlds that were simulated for pictures."""
    counts = []
    original = animation.replay

    def replay(the_scene, engine, params, trials):
        counts.append(trials.yaw.shape[0])
        return original(the_scene, engine, params, trials)

    monkeypatch.setattr(animation, "replay", replay)
    return counts


def test_render_draws_one_grasp_of_a_design(workplace, simulated, capsys):
    assert (
        cli.main(["render", *DESIGN, "--out", "s.png", "--times", "0", "1.1", "--size", "40"]) == 0
    )
    with Image.open(workplace / "s.png") as image:
        assert image.size == (80, 40)
    assert simulated == [1]
    assert "length=100 mm arm_z=0 mm" in capsys.readouterr().out


def test_render_draws_a_row_of_the_table(run, workplace, simulated, capsys):
    place = ["--episode", "1", "--particle", "2", "--trial", "1"]
    assert cli.main(["render", "--run", str(run), *place, "--out", "g.gif", "--size", "32"]) == 0
    with Image.open(workplace / "g.gif") as image:
        assert image.size == (32, 32) and image.n_frames > 2
    assert simulated == [1]
    output = capsys.readouterr().out
    rows = list(csv.DictReader((run / "trials.csv").read_text().splitlines()))
    [row] = [r for r in rows if [r["episode"], r["particle"], r["trial"]] == ["1", "2", "1"]]
    lost = float(row["lost_time_s"])
    verdict = "object kept" if np.isinf(lost) else f"object lost at {lost:.2f} s"
    # MuJoCo C in float64 meets the same grasp again, whatever the batch.
    assert f"in the run: {verdict}; here: {verdict}" in output


def test_replay_writes_the_best_grasp_of_a_run(run, simulated, tmp_path, capsys):
    out = tmp_path / "new" / "r.html"
    assert cli.main(["replay", str(run), "--out", str(out)]) == 0
    assert simulated == [1]
    the_scene, _ = runs.read_run(run)
    best = selection.find_grasp(the_scene, selection.read_record(run))
    assert "episode {}, particle {}, trial {}:".format(*best.place) in capsys.readouterr().out
    page = out.read_text(encoding="utf-8")
    [data] = re.findall(r"startReplay\(.*?, (\{.*\})\);", page)
    parts = json.loads(data)["parts"]
    names = [part["name"] for part in parts]
    assert names[:2] == ["finger 0", "finger 1"] and names[-2:] == ["palm", "object"]
    assert not re.search(r"(src|href)\s*=\s*[\"']", page), "nothing is loaded from elsewhere"
    assert re.search(r"<p>design: length=\S+ mm arm_z=\S+ mm</p>", page)


def test_wrong_grasps_are_refused(run, workplace, capsys):
    run_flags = ["--run", str(run)]
    cases = {
        ("render", *DESIGN, "--trial", "0"): ("missing", "--trial"),
        ("render", *DESIGN, "--object", "spheer"): ("unknown", ""),
        ("render", *DESIGN, "--out", "a.jpg"): ("file", "--out a.jpg"),
        ("render", *DESIGN, "--out", "a.mp4", "--times", "0"): ("unsupported", "--times"),
        ("render", *DESIGN, "--camera", "frnt"): ("syntax", "--camera 'frnt'"),
        ("render", *DESIGN, "--camera", "side", "zoom=2"): ("syntax", "--camera 'zoom'"),
        ("render", *DESIGN, "--camera", "distance=0"): ("range", "--camera distance"),
        ("render", *DESIGN, "--size", "5000"): ("range", "--size"),
        ("render", *DESIGN, "--out", "a.png", "--times", "5"): ("range", "--times"),
        ("render", *run_flags, "--trial", "0", "--object", "sphere"): ("conflict", ""),
        ("render", *run_flags, "--trial", "3"): ("range", "--trial"),
        ("replay", *run_flags, "--objects", "household"): ("missing", ""),
        ("replay", *run_flags, "--out", "a.gif"): ("file", "--out a.gif"),
        ("landscape", *DESIGN, "--parameters", "length", "arm_q"): (
            "unknown",
            "--parameters 'arm_q'",
        ),
        ("landscape", *DESIGN[:4], "--preset", "full"): ("syntax", "--parameters"),
        (*GRID, "gravity", "length"): ("unknown", "--parameters 'gravity'"),
        (*GRID, "contact.friction_ratio", "length"): (
            "unknown",
            "--parameters 'contact.friction_ratio'",
        ),
        ("landscape", "--preset", "23d", "--parameters", "length=60:90", "gravity=3:9"): (
            "unknown",
            "--parameters 'length'",
        ),
        (*GRID, "gravity=3", "length"): ("syntax", ""),
        (*GRID, "gravity=9:3", "length"): ("syntax", ""),
        (*GRID, "gravity=3:9"): ("syntax", "--parameters"),
        (*GRID, "gravity=3:9", "gravity=1:2"): ("syntax", "--parameters"),
        (*GRID, "gravty=3:9", "length"): ("unknown", "gravty"),
        (*GRID, "gravity=3:900", "length"): ("range", "gravity"),
        (*GRID, "length=1:2000", "arm_z"): ("range", "--parameters length"),
        (*GRID, "discretization.links=2:4", "length"): ("type", "discretization.links"),
        (*GRID, "objects.object.cube.mass=0.1:1", "length"): ("unknown", "objects.object"),
    }
    problems = {arguments: refusal_of_command(*arguments) for arguments in cases}
    assert problems == {arguments: [problem] for arguments, problem in cases.items()}
    capsys.readouterr()
    with pytest.raises(SystemExit):  # by the parser
        cli.main(["replay", str(run), *run_flags])
    assert "give one of them" in " ".join(capsys.readouterr().err.split())  # lines are filled
    assert not list(workplace.iterdir()), "nothing was written"


def test_places_that_cannot_be_written_are_said_before_a_simulation(run, workplace, simulated):
    (workplace / "file").touch()
    cases = {
        ("render", *DESIGN, "--out"): "file/a.gif",
        ("replay", *DESIGN, "--out"): "file/folder/a.html",
        ("report", str(run), "--out"): "file/a.html",
        ("optimize", *DESIGN[:2], "--out"): "file/folder",
        ("export", *DESIGN[:2], "--out"): "file/out",
    }
    for arguments, place in cases.items():
        problem = ("file", f"{arguments[-1]} {place}")
        assert refusal_of_command(*arguments, place) == [problem], arguments
    problems = refusal_of_command("report", run, "--out", workplace)
    assert problems == [("file", f"--out {workplace}")]
    assert simulated == [] and [p.name for p in workplace.iterdir()] == ["file"]


@pytest.mark.slow  # 10 s; quick: test_docs runs landscape
def test_landscape_has_every_point(run, monkeypatch, capsys):
    """Cut into calls, it is what one evaluation of all designs says; files and report agree."""
    monkeypatch.setitem(batch.WORLDS, "cpu", 10)  # five designs; the last call is filled up
    sizes = ["--points", "3", "--trials", "2", "--seed", "5"]
    assert cli.main(["landscape", "--run", str(run), *sizes]) == 0
    assert "grasps: 18 in 2 calls" in capsys.readouterr().out
    plane = landscape.load(run / landscape.FILE)
    the_scene, settings = runs.read_run(run)
    space = design_space(the_scene.hand, settings.preset)
    low, high = (space.in_units(np.array(v)) for v in (space.low, space.high))
    np.testing.assert_allclose(plane.first, np.linspace(low[0], high[0], 3))
    np.testing.assert_allclose(plane.second, np.linspace(low[1], high[1], 3))
    designs = space.from_units([[a, b] for a in plane.first for b in plane.second])
    engine = make_engine("mujoco", the_scene)
    evaluate = codesign.Task(the_scene, space, 2, engine).evaluate
    # As many designs in a call as the command has: the same program, which is there already.
    parts = [evaluate(np.float32(part), jax.random.key(5)) for part in (designs[:5], designs[4:])]
    joined = jax.tree.map(lambda a, b: np.concatenate([a, b[1:]]), *parts)
    cost = codesign.particle_cost(
        the_scene, joined
    )  # leaves out failed trials, such as a stuck one
    np.testing.assert_allclose(plane.cost.ravel(), cost, rtol=1e-6)
    assert len(np.unique(cost.round(3))) > 3, "points differ"
    np.testing.assert_array_equal(plane.counted.ravel(), (~failed(joined.status)).sum(1))
    rows = list(csv.DictReader((run / landscape.TABLE).read_text().splitlines()))
    assert len(rows) == 9
    assert float(rows[5]["length_mm"]) == pytest.approx(plane.first[1])
    assert float(rows[5]["arm_z_mm"]) == pytest.approx(plane.second[2])
    assert float(rows[5]["mean_cost"]) == pytest.approx(plane.cost[1, 2], rel=1e-8)
    assert (run / "figures" / "landscape.png").exists()
    assert cli.main(["report", str(run), "--no-replay"]) == 0
    assert "mean cost over 2 trials a point" in (run / "report.html").read_text(encoding="utf-8")


def test_a_search_at_each_point_adapts_the_rest_alone():
    """Of a cost whose lowest place is known: the height is to be a tenth of length and gravity."""
    words = ("length", "gravity=3:9")
    options = flags.Landscape(
        scene=str(TINY), engine="mujoco", parameters=words, points=3, trials=2, search=30
    )
    case = common.find_case(options)
    plane = landscapes.make_plane(case, grid.axes(case, options))
    length, height = (case.space.names.index(name) for name in ("length", "arm_z"))
    gravities = np.repeat([[3.0, 6.0, 9.0]], 3, axis=0).ravel()

    def best(designs, gravity):
        return 0.1 * designs[:, length] + 0.01 * gravity

    def simulate(designs, numbers, key, advance):
        every = np.repeat(gravities, landscapes.PARTICLES)
        assert len(numbers) == len(designs) == len(every)
        cost = np.repeat((designs[:, height] - best(designs, every))[:, None] ** 2, 2, axis=1)
        whole = np.zeros(cost.shape, np.int32)
        return Outcome(cost.astype(np.float32), whole, np.full(cost.shape, np.inf), whole - 1)

    adapted = landscapes.search(case, plane, simulate, options, Console())
    np.testing.assert_array_equal(adapted.designs[:, length], plane.designs[:, length])
    # Thirty steps of CMA-ES shrink a quarter of 200 mm to well below a tenth of it.
    np.testing.assert_allclose(
        adapted.designs[:, height], best(plane.designs, gravities), atol=5e-3
    )


@pytest.mark.parametrize(
    ("words", "names", "varied"),
    [
        (["gravity=3:9", "length"], ["gravity", "length"], {"gravity"}),
        (
            ["objects.object.mass=0.1:0.3", "objects.noise.mass=0:0.1"],
            ["objects.object.mass", "objects.noise.mass"],
            {"objects.object.mass", "objects.noise.mass"},
        ),
        (["hand.material.shear_modulus=3e4:6e4", "arm_z=10:40"], ["hand.material.shear_modulus",
         "arm_z"], {"hand.material.shear_modulus"}),
        (["length", "arm_z"], ["length", "arm_z"], set()),
    ],
)  # fmt: skip
def test_a_landscape_is_over_any_numbers(words, names, varied):
    """Each point has the scene that --set makes of both values; of a list all entries change."""
    options = flags.Landscape(
        scene=str(TINY), engine="mujoco", design=(("length=44", "arm_z=20"),), points=2
    )
    options = dataclasses.replace(options, parameters=tuple(words))
    case = common.find_case(options)
    pair = grid.axes(case, options)
    assert [axis.name for axis in pair] == names
    made = landscapes.make_plane(case, pair)
    assert (made.numbers is None) == (not varied)
    tree = jax.tree.structure(case.scene)
    for i, j in np.ndindex(2, 2):
        values = {n: axis.values[k] for n, axis, k in zip(names, pair, (i, j), strict=True)}
        for k, name in enumerate(case.space.names):
            expected = values.get(name, case.space.in_units(case.design)[k])
            assert case.space.in_units(made.designs[2 * i + j])[k] == pytest.approx(expected)
        if made.numbers is None:
            continue
        numbers = {n: float(values[n]) for n in varied}
        count = len(case.scene.objects.object)
        numbers = {
            n.replace("object.mass", f"object.{k}.mass"): v
            for n, v in numbers.items()
            for k in range(count)
        }
        expected_scene = scenes.load(TINY, overrides=numbers)
        point_scene = jax.tree.unflatten(tree, made.numbers[2 * i + j].tolist())
        np.testing.assert_allclose(
            jax.tree.leaves(point_scene), jax.tree.leaves(expected_scene), rtol=1e-12
        )


def test_missing_extra_is_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "av", None)
    for arguments in (["render", *DESIGN, "--out"], ["evaluate", *DESIGN, "--render"]):
        assert cli.main([*arguments, "a.mp4"]) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert "PyAV" in line
