"""A headless Chromium."""

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
