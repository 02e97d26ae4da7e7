"""A headless Chromium."""

import itertools
import shutil

import pytest


@pytest.fixture(scope="module", name="launch")
def chromium_launcher():
    """Starts a headless Chromium of the system, or one that playwright installed."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome", "chromium-headless-shell")
    program = next(filter(None, map(shutil.which, names)), None)
    off = ("background-networking", "component-update", "sync", "gpu")
    flags = ["--headless", "--no-sandbox", *(f"--disable-{feature}" for feature in off)]
    with api.sync_playwright() as play:

        def start(*more):
            try:
                return play.chromium.launch(executable_path=program, args=[*flags, *more])
            except api.Error as error:
                if program is None:
                    pytest.skip("no Chromium: apt-get install chromium, or playwright install it")
                raise error

        yield start


@pytest.fixture(scope="module", name="browser")
def chromium(launch):
    """A browser with WebGL by software."""
    started = launch("--enable-unsafe-swiftshader")
    yield started
    started.close()


def spot_of(page, canvas, view, part):
    """Where on a canvas a part is seen [pixels], the nearest to the middle.

    Each look draws the whole picture by software, so that few are taken, and no finger is narrower
    than their distance.

    Args:
      canvas: Selector of the canvas.
      view: JavaScript expression of its viewer.
      part: Name of the part.
    """
    size = page.locator(canvas).bounding_box()
    middle = size["width"] / 2, size["height"] / 2
    grid = itertools.product(*(range(8, int(length), 16) for length in (2 * x for x in middle)))
    spots = sorted(grid, key=lambda at: abs(at[0] - middle[0]) + abs(at[1] - middle[1]))
    find = f"([spots, part]) => spots.find(([x, y]) => {view}.pick(x, y) === part)"
    spot = page.evaluate(find, [spots, part])
    assert spot, f"{part} is out of sight"
    return spot
