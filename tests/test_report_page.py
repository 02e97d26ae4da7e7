"""The report of a run and its 3D replay: right numbers and shapes, and they work in a browser."""

import csv
import importlib
import json
import re
import shutil
import sys

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy import stats
from toy import TINY

from codesign_jax import cli, model, runs
from codesign_jax.report import animation, bodies, viewer
from codesign_jax.runs import choice
from codesign_jax.scene.schema import SceneError
from codesign_jax.types import Outcome, failed
from tests import small

pytest.importorskip("plotly", reason="the extra 'report' is not installed")

RUN = [
    *("optimize", "--scene", str(TINY), "--seed", "3", "--engine", "mujoco"),
    *("--particles", "4", "--trials", "2", "--episodes", "3", "--test-trials", "4"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A small run with its report."""
    folder = tmp_path_factory.mktemp("report") / "<run> & 1"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder.parent / "cache"))
        assert cli.main([*RUN, "--out", str(folder)]) == 0
        assert cli.main(["report", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def text(run):
    return (run / "report.html").read_text(encoding="utf-8")


def data_of(page):
    """What the page hands to its viewer."""
    [found] = re.findall(r"startReplay\(document.getElementById\(\"replay\"\), (\{.*\})\);", page)
    return json.loads(found)


def test_report_shows_the_best_tested_particle_with_its_interval(run, text):
    with (run / "tests.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    best = min(rows, key=lambda row: float(row["test_cost"]))  # the first of equal ones
    the_scene, _ = runs.read_run(run)
    chosen = choice.choose(the_scene, choice.read_record(run))
    kept = int(((chosen.trials.cost < 0.01) & ~failed(chosen.trials.status)).sum())
    counted = int(best["trials"]) - int(best["failed_trials"])
    low, high = stats.binomtest(kept, counted).proportion_ci(0.95, method="wilson")
    share = f"{kept} of {counted}: {100 * kept / counted:.0f} %"
    assert f"{share}, 95 % interval {100 * low:.0f} to {100 * high:.0f} %" in text
    assert f"Particle {best['particle']}, mean cost {float(best['test_cost']):.4f}" in text
    for column, unit in (("length_mm", "mm"), ("arm_z_mm", "mm")):
        value = f"{float(best[column]):.4g}"
        assert re.search(rf"<td class='number'>{re.escape(value)}</td>.*<td>{unit}</td>", text)


def test_report_is_one_small_file_that_names_its_origin(run, text):
    assert (run / "report.html").stat().st_size < 10e6
    provenance = json.loads((run / "provenance.json").read_text())
    assert provenance["environment"]["versions"]["mujoco"] in text
    assert "&lt;run&gt; &amp; 1" in text and "<run>" not in text, "names are text, not HTML"
    page = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert not re.search(r"(src|href)\s*=", page), "nothing is loaded from elsewhere"


def test_failures_count_the_trials_of_the_table(run, text):
    with (run / "trials.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    bad = sum(row["status"] not in ("OK", "SOLVER_CAP") for row in rows)
    assert f"{bad} of {len(rows)} trials failed" in text


def test_grasp_is_the_one_of_the_table(run):
    """Noise, design and verdict of a row of trials.csv come back from its three numbers."""
    the_scene, _ = runs.read_run(run)
    record = choice.read_record(run)
    with (run / "trials.csv").open(newline="") as file:
        rows = {
            (int(r["episode"]), int(r["particle"]), int(r["trial"])): r
            for r in csv.DictReader(file)
        }
    for place in ((1, 2, 0), (2, 0, 1)):
        episode, particle, trial = place
        found = choice.find_grasp(
            the_scene, record, episode=episode, particle=particle, trial=trial
        )
        assert found.place == place
        assert float(rows[place]["cost"]) == pytest.approx(float(found.outcome.cost), rel=1e-6)
    # The best one is the chosen particle's ancestor in the last episode.
    best, chosen = choice.find_grasp(the_scene, record), choice.choose(the_scene, record)
    np.testing.assert_array_equal(best.design, chosen.design)
    assert float(best.outcome.cost) == record.history.trials.cost[-1, chosen.row].min()
    with pytest.raises(SceneError) as error:
        choice.find_grasp(the_scene, record, episode=4, trial=2)
    assert len(error.value.problems) == 2 and "--episode = 4 is outside [1, 3]" in str(error.value)


def test_unfinished_run_reports_its_finished_episodes(run, tmp_path, capsys):
    """Without a final test, and with room for an episode that was never simulated."""
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    last = max(
        (p for p in (copy / "checkpoints").iterdir() if p.is_dir()), key=lambda p: int(p.name)
    )
    for step in (int(last.name), int(last.name) - 1):  # the test's, and the last episode's
        shutil.rmtree(copy / "checkpoints" / str(step))
        (copy / "checkpoints" / f"{step}.sha256").unlink()
    assert cli.main(["report", str(copy), "--no-replay", "--out", str(tmp_path / "r.html")]) == 0
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "2 of 3 episodes" in page and "not tested" in page
    assert "startReplay(document" not in page
    assert f"report: {tmp_path / 'r.html'}" in capsys.readouterr().out


def test_errors_are_words(run, tmp_path, capsys, monkeypatch):
    assert cli.main(["report", str(tmp_path)]) == 2
    assert "is not a run folder" in capsys.readouterr().err
    empty = tmp_path / "empty"
    shutil.copytree(run, empty)
    shutil.rmtree(empty / "checkpoints")
    assert cli.main(["report", str(empty)]) == 2
    assert "has no finished episode yet" in capsys.readouterr().err
    assert cli.main(["report", str(run), "--engine", "mujco"]) == 2
    assert "mujoco" in capsys.readouterr().err
    for name in ("codesign_jax.report.page", "codesign_jax.report.charts"):
        monkeypatch.delitem(sys.modules, name, raising=False)
        monkeypatch.delattr(
            importlib.import_module("codesign_jax.report"), name[20:], raising=False
        )
    monkeypatch.setitem(sys.modules, "plotly", None)
    assert cli.main(["report", str(run)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "plotly" in line and "pip install 'codesign-jax[report]'" in line


def bent_grasp(the_scene):
    """Three frames of a hand with random joint angles, as a replay."""
    params, trial = small.hand_world(the_scene, length=0.11, height=0.018)
    data = mujoco.MjData(model.compile_model(the_scene, params, trial))
    turn = np.random.default_rng(0).uniform(-0.4, 0.4, (3, data.qpos.size - 7))
    qpos = np.tile(data.qpos, (3, 1))
    qpos[:, :-7] += turn
    return animation.Replay(params, trial, Outcome(*np.zeros(4)), qpos)


def test_fingers_move_as_in_mujoco():
    """Skins of MuJoCo's own linear blend skinning, and the palm where its disc is."""
    the_scene = small.pinch("box", links=4, effects__surface="hull")
    grasp = bent_grasp(the_scene)
    shown, motion = bodies.parts(the_scene, grasp), bodies.motion(the_scene, grasp, rate=1000.0)
    assert motion.rate == pytest.approx(1 / the_scene.discretization.timestep)
    compiled = model.compile_model(the_scene, grasp.params, grasp.trial, visual=True)
    data, view = mujoco.MjData(compiled), mujoco.MjvScene(compiled, maxgeom=100)
    every, camera = int(mujoco.mjtCatBit.mjCAT_ALL), mujoco.MjvCamera()
    for q, pose in zip(grasp.qpos, motion.pose, strict=True):
        data.qpos[:] = q
        mujoco.mj_forward(compiled, data)
        mujoco.mjv_updateScene(compiled, data, mujoco.MjvOption(), None, camera, every, view)
        theirs = np.asarray(view.skinvert).reshape(the_scene.num_fingers, -1, 3)
        ours = [bodies.vertices(part, pose) for part in shown[: the_scene.num_fingers]]
        np.testing.assert_allclose(ours, theirs, atol=2e-7)  # float32 of both
        palm = bodies.vertices(shown[-2], pose)
        centre = data.geom("palm_disc").xpos
        np.testing.assert_allclose(palm.mean(0), centre, atol=1e-6)


@pytest.mark.parametrize("name", small.SHAPES)
def test_objects_have_their_size(name):
    """Volume of the drawn mesh against the solid's; round ones are polyhedra inside it."""
    the_scene = small.pinch(name)
    a, b, c = the_scene.objects.object[0].half_sizes
    solid = {
        "box": 8 * a * b * c,
        "cylinder": 2 * np.pi * a**2 * b,
        "sphere": 4 / 3 * np.pi * a**3,
    }
    mesh = trimesh.Trimesh(*bodies.object_mesh(the_scene, 0))
    assert mesh.is_watertight
    # A prism of 64 sides has 0.16 % less than its cylinder, an icosphere of 5120 faces 0.2 %.
    assert mesh.volume == pytest.approx(solid[name], rel=3e-3)


def test_large_meshes_are_drawn_coarser():
    fine = trimesh.creation.icosphere(7, 0.03)  # 327,680 faces
    vertices, faces = bodies._coarse(np.asarray(fine.vertices), np.asarray(fine.faces))
    assert len(faces) <= bodies._MOST_FACES
    distance = np.linalg.norm(vertices[faces].mean(1), axis=1)
    assert np.abs(distance - 0.03).max() < 0.001  # of a cell of at most 0.06 m / 84


# ---- in a browser


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium of the system, or one that playwright installed."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    program = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
    flags += [f"--disable-{what}" for what in ("background-networking", "component-update", "sync")]
    with api.sync_playwright() as play:
        try:
            started = play.chromium.launch(executable_path=program, args=flags)
        except api.Error as error:
            if program is None:
                pytest.skip("no Chromium: apt-get install chromium, or playwright install chromium")
            raise error
        yield started
        started.close()


@pytest.fixture
def opened(run, browser):
    """The report in a browser, and what it complained about or asked a network for."""
    page = browser.new_page(viewport={"width": 1000, "height": 900})
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    page.on("request", lambda r: None if r.url.startswith("file:") else complaints.append(r.url))
    page.goto((run / "report.html").as_uri())
    page.wait_for_selector("#cost .main-svg")
    yield page, complaints
    page.close()


def picture(page, tmp_path):
    """Pixels of the 3D view."""
    path = tmp_path / "view.png"
    page.locator("#replay .view").screenshot(path=path)
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def assert_hand_and_object(pixels):
    r, g, b = np.moveaxis(pixels, -1, 0)
    assert ((r > 140) & (b < 80)).sum() > 100, "an orange object"
    assert ((b > r + 40) & (b > 90)).sum() > 100, "blue fingers"


@pytest.mark.browser
def test_replay_plays_in_a_browser(opened, tmp_path):
    page, complaints = opened
    play = page.locator("#replay .play")
    view = "document.getElementById('replay').replay"
    page.evaluate(f"{view}.seek(0)")
    page.wait_for_timeout(200)
    first = picture(page, tmp_path)
    assert_hand_and_object(first)
    page.locator("#replay .speed").select_option("0.25")  # the grasp has 1.2 s
    play.click()
    page.wait_for_function(f"{view}.time() > 0.4")
    assert play.inner_text() == "Pause"
    play.click()
    assert play.inner_text() == "Play"
    later = picture(page, tmp_path)
    assert_hand_and_object(later)
    assert (np.abs(later - first).max(-1) > 20).sum() > 500, "frames differ"
    at = page.evaluate(f"{view}.time()")
    page.wait_for_timeout(300)
    assert page.evaluate(f"{view}.time()") == at, "it stands still"
    page.locator("#replay .time").fill("1")
    assert page.evaluate(f"{view}.time()") == 1
    page.wait_for_function(
        "document.querySelector('#replay .label').innerText.startsWith('1.00 s')"
    )
    assert page.locator(".js-plotly-plot").count() >= 3
    assert complaints == []


@pytest.mark.browser
def test_camera_turns_while_it_plays(opened, tmp_path):
    page, complaints = opened
    camera = "document.getElementById('replay').replay.camera()"
    before = page.evaluate(camera)
    page.locator("#replay .speed").select_option("0.1")
    page.locator("#replay .play").click()  # scrolls there, too
    box = page.locator("#replay .view").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 100, y + 30, steps=5)
    page.mouse.up()
    page.mouse.wheel(0, -300)
    page.wait_for_timeout(200)
    after = page.evaluate(camera)
    assert after["azimuth"] == pytest.approx(before["azimuth"] - 1.0)
    assert after["elevation"] == pytest.approx(before["elevation"] + 0.3)
    assert after["distance"] < before["distance"]
    assert page.evaluate("document.getElementById('replay').replay.playing()")
    assert_hand_and_object(picture(page, tmp_path))
    page.locator("#replay .home").click()
    assert page.evaluate(camera) == before
    assert complaints == []


@pytest.mark.browser
def test_browser_skins_as_python_does(browser, tmp_path):
    """Vertices on the page at its frames against those of `bodies`, and between them continuous."""
    the_scene = small.pinch("box", links=4, effects__surface="hull")
    grasp = bent_grasp(the_scene)
    path = viewer.write(the_scene, grasp, tmp_path / "r.html", title="<b>", text=["a & b"])
    page = browser.new_page()
    page.goto(path.as_uri())
    view = "document.getElementById('replay').replay"
    assert page.locator("h1").inner_text() == "<b>"
    motion = bodies.motion(the_scene, grasp)
    for k, pose in enumerate(motion.pose):
        page.evaluate(f"{view}.seek({k / motion.rate})")
        page.wait_for_timeout(100)
        for part in bodies.parts(the_scene, grasp):
            theirs = page.evaluate(f"{view}.vertices('{part.name}')")
            ours = bodies.vertices(part, pose)
            np.testing.assert_allclose(np.reshape(theirs, (-1, 3)), ours, atol=2e-6)  # float32
    page.close()
