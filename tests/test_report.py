"""Figures, animations, the report's page and its 3D replay show what they should."""

import csv
import json
import re
import shutil

import av
import jax
import jax.numpy as jnp
import matplotlib
import mujoco
import numpy as np
import pytest
from PIL import Image
from scipy import stats

from codesign_jax import array_files, cli, model, rollout, runs, scene, terminal
from codesign_jax.commands import optimize
from codesign_jax.engines import make_engine
from codesign_jax.judge import sentences
from codesign_jax.report import animation, bodies, chosen, figures, painter, raster, viewer
from codesign_jax.runs import reference, selection
from codesign_jax.scene import parameters
from codesign_jax.types import Forces, Outcome, Status, Touch, Trace, failed
from tests.helpers import grasps
from tests.helpers.browsers import chromium, chromium_launcher, spot_of  # noqa: F401
from tests.helpers.command_runs import small_run  # noqa: F401
from tests.helpers.refusals import refusal, refusal_of_command
from tests.helpers.toy_engine import TINY


def bent_grasp(the_scene):
    """Three frames of a hand with random joint angles, as a replay."""
    params, trial = grasps.hand_world(the_scene, length=0.11, height=0.018)
    data = mujoco.MjData(model.compile_model(the_scene, params, trial))
    turn = np.random.default_rng(0).uniform(-0.4, 0.4, (3, data.qpos.size - 7))
    qpos = np.tile(data.qpos, (3, 1))
    qpos[:, :-7] += turn
    return animation.Replay(params, trial, Outcome(*np.zeros(4)), qpos)


@pytest.mark.slow  # 5 s; quick: a run's report below, and a design's verdict (test_compare)
def test_a_design_file_has_a_report_of_what_evaluate_says(tmp_path, capsys):
    """The same trials, so the same verdict; its parameters, its air and its own text."""
    file = tmp_path / "mine.toml"
    file.write_text(f'preset = "2d"\nscene = "{TINY}"\n[design]\nlength = 96.5\narm_z = 0\n')
    assert cli.main(["evaluate", str(file), "--engine", "mujoco"]) == 0
    printed = capsys.readouterr().out
    assert cli.main(["report", str(file), "--engine", "mujoco"]) == 0
    assert f"report: {tmp_path / 'mine.html'}" in capsys.readouterr().out
    shown = (tmp_path / "mine.html").read_text(encoding="utf-8")
    [details] = re.findall("^ *all: (.*)$", printed, re.M)
    [air] = re.findall(r"chambers: (\S+) cm", printed)
    assert details in shown and f"unloaded chambers: {air} cm" in shown
    assert "Design mine.toml" in shown and "length = 96.5" in shown
    assert all(f">{o.name}</td>" in shown for o in scene.load(TINY).objects.object)
    assert "canvas" in shown, "the grasp in 3D"
    assert cli.main(["report", str(tmp_path / "none.toml")]) == 2


@pytest.fixture(scope="module")
def grasp():
    """A scene and one simulated grasp in it."""
    the_scene = scene.load(TINY)
    space = parameters.design_space(the_scene.hand, "2d")
    trials = rollout.sample_trials(the_scene, jax.random.key(0), 1)
    params = space.params(jnp.asarray([0.1, 0.0]))
    [replay] = animation.replay(the_scene, make_engine("mujoco", the_scene), params, trials)
    return the_scene, replay


def test_a_picture_shows_the_object_where_a_pinhole_camera_does(grasp):
    the_scene, replay = grasp
    side = 200
    away = 0.6
    place = np.array(replay.qpos[0, -7:-4])
    camera = animation.Camera(azimuth=90.0, elevation=0.0, distance=away, lookat=(0.0, 0.0, 0.1))
    [picture] = animation.frames(the_scene, replay, np.zeros(1), size=(side, side), camera=camera)
    focal = side / 2 / np.tan(np.radians(45.0) / 2)  # MuJoCo's field of view
    expected = side / 2 + focal * np.array([place[0], 0.1 - place[2]]) / (away + place[1])
    red, _, blue = np.moveaxis(picture.astype(int), -1, 0)
    centre = np.argwhere(red > blue + 60)[:, ::-1].mean(0)  # orange; the hand is above it
    np.testing.assert_allclose(centre + 0.5, expected, atol=1.5)  # its near faces are larger


def test_the_nearest_triangle_is_that_of_a_ray_s_first_hit():
    """Each pixel's ray against each triangle by Möller and Trumbore's formula."""
    random = np.random.default_rng(2)
    middle = random.uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 1.0], (60, 1, 3))
    triangles = middle + random.normal(0, 0.08, (60, 3, 3))
    size = (37, 29)
    scale = 30.0
    corners = triangles[..., :2] / triangles[..., 2:] * scale + np.array(size) / 2
    pixels = raster.nearest(corners, triangles[..., 2], size)
    column, row = np.meshgrid(*map(np.arange, size))
    flat = np.stack([column.ravel() + 0.5, row.ravel() + 0.5], 1)
    rays = np.column_stack([(flat - np.array(size) / 2) / scale, np.ones(len(flat))])
    origin, first, second = (triangles[:, k] for k in range(3))
    edges = first - origin, second - origin
    across = np.cross(rays[:, None], edges[1])
    scaled = 1 / (across * edges[0]).sum(-1)
    u = -(across * origin).sum(-1) * scaled
    turned = np.cross(-origin, edges[0])
    v = (rays[:, None] * turned).sum(-1) * scaled
    away = (edges[1] * turned).sum(-1) * scaled
    away = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (away > 0), away, np.inf)
    hit = np.isfinite(away).any(1)
    assert 100 < hit.sum() < len(hit)
    np.testing.assert_array_equal(np.sort(pixels.at), np.flatnonzero(hit))
    np.testing.assert_array_equal(pixels.face, away.argmin(1)[pixels.at])
    np.testing.assert_allclose(pixels.away, away.min(1)[pixels.at], rtol=1e-9)
    place = (pixels.share[..., None] * triangles[pixels.face]).sum(1)
    np.testing.assert_allclose(place, pixels.away[:, None] * rays[pixels.at], atol=1e-9)


def test_an_object_has_its_shadow_where_light_falls_from_it(grasp):
    """The table under the light's ray through the object's middle is darker than around."""
    the_scene, replay = grasp
    lifted = np.array(replay.qpos)
    lifted[:, -7:-4] = [0.0, 0.0, 0.1]
    lifted[:, :3] = [0.3, 0.3, 0.2]  # the hand is aside
    camera = animation.Camera(azimuth=90.0, elevation=-70.0, distance=0.7, lookat=(0.0, 0.0, 0.0))
    aside = replay._replace(qpos=lifted)
    [picture] = painter.paint(the_scene, aside, np.zeros(1, int), (120, 120), camera)
    view = painter.View(camera, (120, 120))
    fall = painter.light(camera)
    middle = np.array([0.0, 0.0, 0.1]) - 0.1 / fall[2] * fall
    assert np.linalg.norm(middle) > 0.05  # not behind the object

    def brightness(place):
        column, row = np.floor(view.pixels(np.array([place]))[0][0]).astype(int)
        return float(picture[row - 1 : row + 2, column - 1 : column + 2].mean())

    around = [brightness(middle + [0.12 * np.cos(a), 0.12 * np.sin(a), 0]) for a in (2, 4, 6)]
    assert brightness(middle) < 0.8 * min(around)


def test_a_camera_follows_hand_and_object(grasp):
    the_scene, replay = grasp
    times = np.array([0.0, 3.0, the_scene.end_time])
    seen = animation.following(the_scene, replay, times, animation.CAMERA, lag=0.0)
    middle = (replay.qpos[:, :3] + replay.qpos[:, -7:-4]) / 2
    h = the_scene.discretization.timestep
    steps = np.minimum(np.rint(times / h).astype(int), len(middle) - 1)
    np.testing.assert_allclose([camera.lookat for camera in seen], middle[steps])
    drawn = animation.frames(the_scene, replay, times, size=(40, 40), camera=seen)
    assert drawn.shape == (3, 40, 40, 3)


def test_gif_plays_in_real_time(grasp, tmp_path):
    the_scene, replay = grasp
    path = tmp_path / "new" / "grasp.gif"
    animation.write_film(the_scene, [replay, replay], path, size=(80, 60))
    with Image.open(path) as image:
        assert image.size == (160, 60)
        total = 0
        for k in range(image.n_frames):
            image.seek(k)
            total += image.info["duration"]
    assert total == pytest.approx(1000 * the_scene.end_time, abs=80)  # one frame at most


def test_mp4_plays_in_real_time_with_even_sides(grasp, tmp_path):
    """Read back by FFmpeg: players need even sides, so an odd one has its edge twice."""
    the_scene, replay = grasp
    path = animation.write_film(the_scene, [replay], tmp_path / "g.mp4", size=(81, 61))
    with av.open(str(path)) as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        assert film.streams.video[0].average_rate == 25
    assert pictures[0].shape == (62, 82, 3)
    assert len(pictures) == round(25 * the_scene.end_time)
    drawn = animation.frames(the_scene, replay, np.array([0.0]), size=(81, 61))[0]
    # Colours are kept for blocks of four pixels alone, so that lines of one pixel blur.
    assert np.abs(pictures[0][:61, :81].astype(int) - drawn).mean() < 6


def test_fingers_move_as_in_mujoco():
    """Skins of MuJoCo's own linear blend skinning, and the palm where its disc is."""
    the_scene = grasps.pinch("box", links=4, effects__surface="hull")
    grasp = bent_grasp(the_scene)
    shown = bodies.parts(the_scene, grasp)
    motion = bodies.motion(the_scene, grasp, rate=1000.0)
    assert motion.rate == pytest.approx(1 / the_scene.discretization.timestep)
    compiled = model.compile_model(the_scene, grasp.params, grasp.trial, visual=True)
    data = mujoco.MjData(compiled)
    view = mujoco.MjvScene(compiled, maxgeom=100)
    every = int(mujoco.mjtCatBit.mjCAT_ALL)
    camera = mujoco.MjvCamera()
    for q, *now in zip(grasp.qpos, motion.pose, motion.size, strict=True):
        data.qpos[:] = q
        mujoco.mj_forward(compiled, data)
        mujoco.mjv_updateScene(compiled, data, mujoco.MjvOption(), None, camera, every, view)
        theirs = np.asarray(view.skinvert).reshape(the_scene.num_fingers, -1, 3)
        ours = [bodies.vertices(part, *now) for part in shown[: the_scene.num_fingers]]
        np.testing.assert_allclose(ours, theirs, atol=2e-7)  # float32 of both
        palm = bodies.vertices(shown[-2], *now)
        centre = data.geom("palm_disc").xpos
        np.testing.assert_allclose(palm.mean(0), centre, atol=1e-6)


# --- the report of a run: the numbers of its tables, in one file, and errors in words -------------


@pytest.fixture(scope="module")
def text(run):
    return (run / "report.html").read_text(encoding="utf-8")


def test_report_shows_the_best_tested_particle_with_its_interval(run, text):
    rows = list(csv.DictReader((run / "tests.csv").read_text().splitlines()))
    best = min(rows, key=lambda row: float(row["test_cost"]))  # the first of equal ones
    the_scene, _ = runs.read_run(run)
    winner = selection.choose(the_scene, selection.read_record(run))
    kept = int(((winner.outcomes.cost < 0.01) & ~failed(winner.outcomes.status)).sum())
    low, high = stats.binomtest(kept, int(best["trials"])).proportion_ci(0.95, method="wilson")
    share = f"({100 * low:.0f} to {100 * high:.0f} %): not good"
    assert f"kept {kept} of {best['trials']}, " in text and share in text
    assert f"Particle {best['particle']}, chosen as the best by the final test" in text
    assert f"; mean cost {float(best['test_cost']):.4f}" in text
    for column, unit in (("length_mm", "mm"), ("arm_z_mm", "mm")):
        value = f"{float(best[column]):.4g}"
        assert f"<th class='number'>{column[: -len(unit) - 1]} {unit}</th>" in text
        assert f">{value}<div class='scale'>" in text


def test_report_is_one_small_file_that_names_its_origin(run, text):
    assert (run / "report.html").stat().st_size < 2e6
    provenance = json.loads((run / "provenance.json").read_text())
    assert provenance["environment"]["versions"]["mujoco"] in text
    assert "&lt;run&gt; &amp; 1" in text and "<run>" not in text, "names are text, not HTML"
    page = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    outside = re.search(r"(src|href)\s*=\s*['\"](?!data:)", page)
    assert not outside, "nothing is loaded from elsewhere"


def test_grasp_is_the_one_of_the_table(run):
    """Noise, design and verdict of a row of trials.csv come back from its three numbers."""
    the_scene, _ = runs.read_run(run)
    record = selection.read_record(run)
    trials = csv.DictReader((run / "trials.csv").read_text().splitlines())
    rows = {tuple(int(r[n]) for n in ("episode", "particle", "trial")): r for r in trials}
    for place in ((1, 2, 0), (2, 0, 1)):
        episode, particle, trial = place
        row_grasp = selection.find_grasp(
            the_scene, record, episode=episode, particle=particle, trial=trial
        )
        assert row_grasp.place == place
        assert float(rows[place]["cost"]) == pytest.approx(float(row_grasp.outcome.cost), rel=1e-6)
    # The best one is the chosen particle's ancestor.
    best = selection.find_grasp(the_scene, record)
    winner = selection.choose(the_scene, record)
    np.testing.assert_array_equal(best.design, winner.design)
    problems = refusal(selection.find_grasp, the_scene, record, episode=4, trial=3)
    assert problems == [("range", "--episode"), ("range", "--trial")]


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


def test_fresh_trials_at_reference_are_in_the_report(run, tmp_path, capsys):
    """Those of the run's design; not those of the design before the run was extended."""
    copy = shutil.copytree(run, tmp_path / "run")
    settings = runs.read_run(copy)[1]
    trials = 5
    cost = np.array([0.0, 0.0, 0.0, 2.0, 3.0])
    status = np.array([0, 0, 0, 0, int(Status.STUCK)])
    lost = np.where(cost == 2.0, 5.0, np.inf)
    outcomes = Outcome(cost, status, lost, np.full(trials, -1))
    for design, words in (("own", True), ("other", False)):
        case = selection.case_of_run(copy, accuracy="reference")
        tested = case if design == "own" else case._replace(design=case.design + 1)
        array_files.save_results(
            copy / reference.FILE, tested.digest(settings.seed), outcomes._asdict()
        )
        page = tmp_path / f"{design}.html"
        assert cli.main(["report", str(copy), "--no-replay", "--out", str(page)]) == 0
        low, high = stats.binomtest(3, 5).proportion_ci(0.95, method="wilson")
        text = page.read_text(encoding="utf-8")
        grasps = f"fresh grasps of {sentences.objects(case.scene)}"
        share = (
            f"keeps 60 % of 5 {grasps} ({100 * low:.0f} to {100 * high:.0f} %): not enough trials"
        )
        assert (share in text) == words
        assert ("; accuracy reference, steps of " in text) == words
        assert ("1 of 5 trials failed (STUCK 1)" in text) == words


def test_what_is_no_run_is_refused(run, tmp_path, capsys):
    assert refusal_of_command("report", tmp_path) == [("damaged", str(tmp_path))]
    for seed in (0, 1):
        folder = tmp_path / "seeds" / f"seed-{seed}"
        folder.mkdir(parents=True)
        shutil.copy(run / "provenance.json", folder)
    folder = tmp_path / "seeds"
    capsys.readouterr()
    assert refusal_of_command("report", folder) == [("damaged", str(folder))]
    assert str(folder / "seed-0") in capsys.readouterr().err  # one to give


# --- the report and its 3D replay in a headless Chromium ------------------------------------------


@pytest.fixture(scope="module")
def flat_browser(launch):
    """A browser without WebGL."""
    started = launch("--disable-3d-apis")
    yield started
    started.close()


@pytest.fixture
def opened(run, browser):
    """The report in a browser, and what it complained about or asked a network for."""
    page = browser.new_page(viewport={"width": 1000, "height": 900}, reduced_motion="reduce")
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    page.on("request", lambda r: None if r.url.startswith("file:") else complaints.append(r.url))
    page.goto((run / "report.html").as_uri())
    page.wait_for_selector("#cost circle")
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
    assert complaints == []


def shown_colors(page, selector):
    """Colours of elements as the browser has them."""
    return page.locator(selector).evaluate_all(
        "e => e.map(x => getComputedStyle(x).backgroundColor)"
    )


@pytest.mark.browser
def test_a_finger_has_one_colour_and_answers_where_it_is_clicked(grasp, browser, tmp_path):
    """In the picture and in the table; a click on either marks both."""
    the_scene, replay = grasp
    space = parameters.design_space(the_scene.hand, "full")
    table = chosen.parameters(the_scene, space, space.default())
    body = viewer.fragment(the_scene, replay) + table
    path = tmp_path / "page.html"
    path.write_text(viewer.page("fingers", body, viewer.web("report.js")), encoding="utf-8")
    page = browser.new_page(viewport={"width": 1000, "height": 900}, reduced_motion="reduce")
    page.goto(path.as_uri())
    view = "document.getElementById('replay').replay"
    fingers = [bodies.finger_color(f) for f in range(2)]
    assert [c for c in shown_colors(page, "tr[data-part] .swatch")] == [
        f"rgb({int(c[1:3], 16)}, {int(c[3:5], 16)}, {int(c[5:], 16)})" for c in fingers
    ]
    page.evaluate(f"{view}.seek(0)")
    place = spot_of(page, "#replay .view", view, "finger 1")
    row = page.locator("tr[data-part='finger 1']").first
    page.locator("#replay .view").click(position={"x": place[0], "y": place[1]})
    assert "picked" in row.get_attribute("class")
    assert "picked" not in (
        page.locator("tr[data-part='finger 0']").first.get_attribute("class") or ""
    )
    row.click()
    assert "picked" not in row.get_attribute("class")
    page.close()


@pytest.mark.browser
def test_a_chart_answers_to_the_pointer(run, opened):
    """It reads the costs of the run's episodes, zooms, and hides what a click on its name names."""
    page, complaints = opened
    the_scene, _ = runs.read_run(run)
    cost = selection.read_record(run).history.cost
    chart = page.locator("#cost .chart")
    chart.scroll_into_view_if_needed()
    assert page.locator("#cost circle").count() == cost.size
    dot = page.locator("#cost circle").nth(cost.shape[1])  # of the second episode
    box = dot.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    told = page.locator("#cost .readout").inner_text()
    assert "episode: 2" in told
    [mean] = re.findall(r"mean of the particles: (\S+)", told)
    assert float(mean) == pytest.approx(cost[1].mean(), rel=1e-3)
    shown = page.evaluate("document.getElementById('cost').chart.shown()")
    assert shown == [0.5, len(cost) + 0.5]
    page.mouse.down()
    page.mouse.move(box["x"] + 150, box["y"])
    page.mouse.up()
    low, high = page.evaluate("document.getElementById('cost').chart.shown()")
    assert low == pytest.approx(2, abs=0.05) and 2 < high < len(cost) + 0.5
    chart.dblclick()
    assert page.evaluate("document.getElementById('cost').chart.shown()") == shown
    page.locator("#cost .legend button", has_text="particles").first.click()
    assert page.locator("#cost circle").count() == 0
    assert complaints == []


@pytest.mark.browser
def test_a_wide_table_shows_that_it_scrolls(run, browser):
    """As long as there is more of it to the right; letters of charts are not scaled down."""
    page = browser.new_page(viewport={"width": 390, "height": 800})
    page.goto((run / "report.html").as_uri())
    table = page.locator(".table", has_text="slipped in the lift").first
    page.wait_for_function("document.querySelectorAll('.table.more').length > 0")
    sign = "e => Number(getComputedStyle(e, '::after').opacity)"
    page.wait_for_timeout(300)
    assert table.evaluate(sign) == 1
    table.evaluate("e => { e.firstElementChild.scrollLeft = 1e4; }")
    page.wait_for_timeout(400)
    assert table.evaluate(sign) == 0
    letters = page.locator("#cost .chart text")
    heights = letters.evaluate_all("e => e.map(x => x.getBoundingClientRect().height)")
    assert min(heights[1:]) >= 11, "px"
    page.close()


@pytest.mark.browser
def test_a_grasp_turns_until_somebody_takes_it(run, browser):
    page = browser.new_page(viewport={"width": 1000, "height": 900})
    page.goto((run / "report.html").as_uri())
    view = "document.getElementById('replay').replay"
    azimuth = page.evaluate(f"{view}.camera().azimuth")
    page.locator("#replay").scroll_into_view_if_needed()
    page.wait_for_function(f"{view}.camera().azimuth > {azimuth} + 0.02")
    page.mouse.move(500, 400)
    page.mouse.down()
    page.mouse.up()
    assert not page.locator("#replay .turning").is_checked()
    page.close()


@pytest.mark.browser
def test_a_notebook_shows_the_same_viewer(grasp, browser, tmp_path):
    """In a frame of its own, without a network."""
    path = tmp_path / "cell.html"
    path.write_text(f"<p>cell</p>{viewer.Notebook(*grasp)._repr_html_()}", encoding="utf-8")
    page = browser.new_page(viewport={"width": 900, "height": 800}, reduced_motion="reduce")
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda r: complaints.append(r.url) if r.url.startswith("http") else None)
    page.goto(path.as_uri())
    view = "document.getElementById('replay').replay"
    page.frames[1].wait_for_function(f"{view} && {view}.time() > 0")
    assert page.frames[1].locator("html").evaluate("e => e.scrollHeight <= e.clientHeight")
    assert complaints == []
    page.close()


@pytest.mark.browser
def test_forces_are_drawn_where_they_press(browser, tmp_path):
    """Sums of contacts by finger on the page are those of the trace, and the picture shows them."""
    the_scene = grasps.pinch("box", links=4, effects__surface="hull")
    grasp = bent_grasp(the_scene)
    random = np.random.default_rng(3)
    shape = (3, the_scene.num_fingers, 4)  # time, finger, ring
    normal = random.normal(size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    pressing = random.uniform(0.5, 1.0, shape) * (random.uniform(size=shape) < 0.6)
    point = random.uniform([-0.05, -0.05, 0.05], [0.05, 0.05, 0.15], (*shape, 3))
    touch = Touch(point, normal, -1e-4 * pressing, pressing, np.zeros((*shape, 3)))
    none = np.zeros((3, 3))
    forces = Forces(*[none] * 8, {}, {"finger": touch})
    trace = Trace(np.zeros(3), np.zeros(3), np.zeros(3), grasp.qpos, forces=forces)
    path = viewer.write(
        the_scene, grasp._replace(trace=trace), tmp_path / "r.html", title="f", text=[]
    )
    page = browser.new_page(viewport={"width": 800, "height": 700}, reduced_motion="reduce")
    page.goto(path.as_uri())
    view = "document.getElementById('replay').replay"
    frames = page.evaluate(f"{view}.contacts()")
    every = round(1 / (25 * the_scene.discretization.timestep))
    for k, shown in enumerate(frames):
        sums = -(pressing[k * every, ..., None] * normal[k * every]).sum(1)
        for f in range(the_scene.num_fingers):
            force = next((sum_["force"] for sum_ in shown if sum_["part"] == f), [0, 0, 0])
            np.testing.assert_allclose(force, sums[f], atol=1e-6)
    page.evaluate(f"{view}.seek(0)")
    page.wait_for_timeout(200)
    before = picture(page, tmp_path)
    page.locator("#replay .forces").check()
    page.wait_for_timeout(200)
    assert (np.abs(picture(page, tmp_path) - before).max(-1) > 20).sum() > 100
    page.close()


@pytest.mark.browser
def test_a_view_that_the_browser_took_away_comes_back(opened, tmp_path):
    """As after a sleep, or a driver that starts again; meanwhile words say what is the matter."""
    page, complaints = opened
    message = page.locator("#replay .message")
    assert_hand_and_object(picture(page, tmp_path))
    page.evaluate(
        """() => {
          const canvas = document.querySelector("#replay .view");
          window.taken = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
          window.taken.loseContext();
        }"""
    )
    page.wait_for_function("document.querySelector('#replay .message').innerText")
    assert "load the page again" in message.inner_text()
    page.evaluate("document.getElementById('replay').replay.seek(0.4)")
    page.wait_for_timeout(200)
    page.evaluate("window.taken.restoreContext()")
    page.wait_for_function("!document.querySelector('#replay .message').innerText")
    page.wait_for_timeout(200)
    assert_hand_and_object(picture(page, tmp_path))
    assert [text for text in complaints if "CONTEXT_LOST" not in text] == []


@pytest.mark.browser
@pytest.mark.parametrize("width", [390, 1000])
def test_a_report_is_as_wide_as_its_window(run, browser, width):
    """Tables that are wider scroll by themselves."""
    page = browser.new_page(viewport={"width": width, "height": 800})
    page.goto((run / "report.html").as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == width
    for table in page.locator(".table").all():
        assert table.bounding_box()["width"] <= width
    page.close()


@pytest.mark.browser
def test_a_browser_without_webgl_shows_a_film_strip(run, flat_browser, tmp_path):
    """Pictures at the ends of the phases, and no controls of what is not there."""
    page = flat_browser.new_page(viewport={"width": 1000, "height": 900})
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto((run / "report.html").as_uri())
    assert page.evaluate("document.createElement('canvas').getContext('webgl2')") is None
    assert "This browser offers no WebGL 2" in page.locator("#replay .message").inner_text()
    pictures = page.locator("#replay .strip img")
    captions = [pictures.nth(k).get_attribute("alt") for k in range(pictures.count())]
    assert len(captions) == 7 and captions[1] == "end of approach, 0.3 s"
    for name in (".view", ".controls", ".label"):
        assert not page.locator(f"#replay {name}").is_visible()
    assert page.locator("#replay").bounding_box()["height"] < 700
    path = tmp_path / "strip.png"
    shown = []
    for k in (0, 2):
        pictures.nth(k).screenshot(path=path)
        with Image.open(path) as image:
            shown.append(np.asarray(image.convert("RGB")).astype(int))
        r, g, b = np.moveaxis(shown[-1], -1, 0)
        assert ((r > b + 80) & (r > g + 40)).sum() > 50, "an orange object"
        assert ((b > r + 60) & (b > 100)).sum() > 50, "blue fingers"
    assert (np.abs(shown[1] - shown[0]).max(-1) > 40).sum() > 100, "pictures differ"
    assert complaints == []
    page.close()


@pytest.mark.browser
def test_browser_skins_as_python_does(browser, tmp_path):
    """Vertices on the page at its frames against those of `bodies`, of fingers that grow."""
    grows = {"effects__surface": "hull", "effects__section_growth": True}
    the_scene = grasps.pinch("box", links=4, **grows)
    grasp = bent_grasp(the_scene)
    qpos = np.repeat(grasp.qpos, 4, 0)  # of 10 ms; a frame is 40 ms
    pressures = np.linspace(0, 80e3, len(qpos))[:, None]
    ctrl = np.hstack([qpos[:, :6], pressures + np.zeros(the_scene.num_fingers)])
    grasp = grasp._replace(qpos=qpos, trace=Trace(*np.zeros((4, len(ctrl))), ctrl=ctrl))
    path = viewer.write(
        the_scene, grasp, tmp_path / "r.html", title="<b>", text=["a & b", "x  y\n1  2"]
    )
    page = browser.new_page()
    page.goto(path.as_uri())
    view = "document.getElementById('replay').replay"
    assert page.locator("h1").inner_text() == "<b>"
    assert page.locator("pre").inner_text() == "x  y\n1  2", "a table's lines"
    motion = bodies.motion(the_scene, grasp)
    assert len(motion.pose) == 3 and motion.size[-1].max() > 1.2
    for k, now in enumerate(zip(motion.pose, motion.size, strict=True)):
        page.evaluate(f"{view}.seek({k / motion.rate})")
        page.wait_for_timeout(100)
        for part in viewer.shown_parts(the_scene, grasp):
            theirs = page.evaluate(f"{view}.vertices('{part.name}')")
            ours = bodies.vertices(part, *now)
            np.testing.assert_allclose(np.reshape(theirs, (-1, 3)), ours, atol=2e-6)  # float32
    page.close()


@pytest.mark.parametrize(
    "settings",
    [
        {"text.usetex": True},
        {"font.family": "no such font", "mathtext.fontset": "stix"},
        {"savefig.format": "no such", "savefig.bbox": "tight", "figure.dpi": 3},
        {"axes.prop_cycle": matplotlib.cycler(color=["red"]), "svg.fonttype": "path"},
    ],
    ids=["LaTeX", "fonts", "sizes", "colours"],
)
def test_a_picture_is_drawn_by_our_settings_not_the_users(settings, tmp_path):
    """Without LaTeX too; the user's settings are as they were afterwards."""
    costs = np.array([[5.0, 3.0], [2.0, 0.5]])

    def drawn(name):
        figures.save(figures.cost_evolution(costs), tmp_path / name)
        return (tmp_path / name).read_bytes()

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        plain = drawn("plain.png")
        matplotlib.rcParams.update(settings)
        users = dict(matplotlib.rcParams)
        assert drawn("other.png") == plain
        assert dict(matplotlib.rcParams) == users


def test_a_picture_that_fails_costs_no_result(tmp_path, monkeypatch, capsys):
    def fail(cost):
        raise RuntimeError("no such letter")

    monkeypatch.setattr(figures, "cost_evolution", fail)
    optimize._draw(np.zeros((2, 2)), tmp_path / "figures" / "a.png", terminal.Console())
    assert "could not be drawn (RuntimeError: no such letter)" in capsys.readouterr().err
