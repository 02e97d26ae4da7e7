"""The report and its 3D replay in a headless Chromium: `make test-browser`."""

import numpy as np
import pytest
from PIL import Image

from codesign_jax.report import bodies, viewer
from tests.helpers import grasps
from tests.helpers.browsers import chromium, chromium_launcher  # noqa: F401
from tests.helpers.replays import bent_grasp
from tests.helpers.tiny_run import small_run  # noqa: F401

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def flat_browser(launch):
    """A browser without WebGL."""
    started = launch("--disable-3d-apis")
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
    page.wait_for_function("document.getElementById('cost').naturalWidth > 100")
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
    assert page.locator("img.figure").count() >= 3
    assert complaints == []


def test_a_browser_without_webgl_shows_a_film_strip(run, flat_browser, tmp_path):
    """Pictures at the ends of the phases, and no controls of what is not there."""
    page = flat_browser.new_page(viewport={"width": 1000, "height": 900})
    complaints = []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto((run / "report.html").as_uri())
    assert page.evaluate("document.createElement('canvas').getContext('webgl2')") is None
    assert "this browser offers no WebGL 2" in page.locator("#replay .message").inner_text()
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


def test_browser_skins_as_python_does(browser, tmp_path):
    """Vertices on the page at its frames against those of `bodies`, and between them continuous."""
    the_scene = grasps.pinch("box", links=4, effects__surface="hull")
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
