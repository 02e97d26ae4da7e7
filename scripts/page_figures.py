"""Figures of the documentation that no study draws: the arm, film strips, parts, the studio.

    python -m scripts.page_figures [axes] [strategies] [parts] [studio]

All of them without a name.  The studio's needs Chromium and playwright.
"""

import contextlib
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import matplotlib.figure
import numpy as np
from PIL import Image

from codesign_jax import parameters, scene
from codesign_jax.export import casting, meshes, palm, posture, process, sheet
from codesign_jax.report import painter
from codesign_jax.report.bodies import Part
from codesign_jax.report.replay import Camera
from scripts import gallery

DOCS = Path(__file__).parents[1] / "docs"
FIGURES = DOCS / "figures"
DESIGN = DOCS / "gallery" / "first.toml"  # of README's own command
SILICONE = (0.36, 0.57, 0.80)
PRINTED = (0.80, 0.80, 0.78)
CORE = (0.93, 0.72, 0.40)
DARK = (0.42, 0.44, 0.49)
VIEW = "{ azimuth: 1.9, elevation: 0.25, distance: 0.45, target: [0.02, -0.02, 0.27] }"
"""The studio's camera, as web/replay.js has it."""
STRIP = (0.0, 2.0, 2.7, 3.5, 4.5, 7.9, 8.9)
"""Times of the pictures of a film strip [s]."""


def axes() -> None:
    """The hand of the default scene at 0, turned about each axis, and pointing ahead."""
    grasping = scene.load("paper")
    space = parameters.design_space(grasping.hand, "full")
    params = jax.tree.map(np.asarray, space.params(space.default()))
    sizes = process.sizes(grasping.hand, params, process.Process())
    fingers = sheet.corners(grasping, params, sizes)
    disc = grasping.hand.palm
    turns = {**posture.TURNS, "pitch +90°: fingers along +x": {"roll": 0, "yaw": 0, "pitch": 90}}
    figure = matplotlib.figure.Figure(figsize=(11, 2.6))
    for k, (words, angles) in enumerate(turns.items()):
        panel = figure.add_axes((0.01 + 0.198 * k, 0.02, 0.188, 0.86))
        posture.draw(panel, fingers, (1e3 * disc.radius, 1e3 * disc.thickness), angles, words)
        panel.title.set_fontsize(8)
    figure.savefig(FIGURES / "axes.png", dpi=110)


def strategies() -> None:
    """Film strips of the gallery's three further strategies, one below the other."""
    strips = []
    for name in ("two_stage", "push_close", "slide"):
        with Image.open(DOCS / "gallery" / f"{name}.webp") as film:
            pictures = []
            for time in STRIP:
                film.seek(round(time * gallery.RATE))
                pictures.append(np.asarray(film.convert("RGB")))
        strips.append(np.hstack(pictures))
    picture = Image.fromarray(np.vstack(strips)).resize((1400, 600))
    # A palette of 128 colours: photographs compress badly as PNG.
    picture.quantize(128).save(FIGURES / "strategies.png", optimize=True)


def parts() -> None:
    """The parts of the default scene's middle hand: a finger cut open, its moulds, the palm."""
    grasping = scene.load("paper")
    space = parameters.design_space(grasping.hand, "full")
    params = jax.tree.map(np.asarray, space.params(space.default()))
    settings = process.Process()
    sizes = process.sizes(grasping.hand, params, settings)
    standing = meshes.standing(casting.parts(sizes[0], settings))
    whole = palm.palm(grasping, params, sizes, settings)
    cut = standing.finger.trim_by_plane((0.0, 1.0, 0.0), 0.0)
    under = whole.body.rotate([180, 0, 0])
    bar = whole.bars[0]
    laid = (
        ("finger", cut, SILICONE, (-72.0, -72.0)),
        ("tray", standing.tray, PRINTED, (-72.0, -22.0)),
        ("core", standing.core, CORE, (-72.0, 26.0)),
        ("base mould", standing.base, PRINTED, (-72.0, 72.0)),
        ("palm", under, DARK, (72.0, 22.0)),
        ("bar", bar, CORE, (52.0, -66.0)),
    )
    shown = [_laid(name, solid, color, place) for name, solid, color, place in laid]
    camera = Camera(azimuth=97.0, elevation=-38.0, distance=0.28, lookat=(-0.004, -0.004, 0.0))
    picture = painter.still(shown, camera, (1000, 480))
    Image.fromarray(picture).save(DOCS / "export_parts.png", optimize=True)


def _laid(name: str, solid, color: tuple[float, float, float], place: tuple[float, float]) -> Part:
    """A solid in mm on the table, at a place."""
    low, high = np.reshape(solid.bounding_box(), (2, 3))
    middle = (low + high) / 2
    surface = meshes.mesh(solid.translate([place[0] - middle[0], place[1] - middle[1], -low[2]]))
    vertices = 1e-3 * np.asarray(surface.vertices)
    bodies = np.zeros((len(vertices), 2), int)
    faces = np.asarray(surface.faces)
    return Part(name, color, vertices, vertices, bodies, np.zeros(len(vertices)), faces)


def studio() -> None:
    """The page of `codesign studio` with a hand of the gallery, amid the disturbance."""
    with _served() as address, _page(address) as page:
        page.wait_for_selector("#studio .trials button:nth-child(24):is(.kept, .lost)")
        page.evaluate("document.querySelector('.replay').replay.pause()")
        page.evaluate(f"Object.assign(document.querySelector('.replay').replay.camera(), {VIEW})")
        page.evaluate("document.querySelector('.replay').replay.seek(6.0)")
        page.wait_for_timeout(500)
        page.screenshot(path=FIGURES / "studio.png")


@contextlib.contextmanager
def _served() -> Iterator[str]:
    """A studio that has begun; yields its address."""
    from codesign_jax import cli
    from codesign_jax.studio.desk import Desk
    from codesign_jax.studio.studio import Studio

    serving = Studio(Desk(cli.Studio(design=((str(DESIGN),),), out=Path("runs") / "studio")))
    listening, address = serving.listen("127.0.0.1", 0)
    with listening:
        threading.Thread(target=listening.serve_forever, daemon=True).start()
        serving.begin()
        yield address
        serving.close()


@contextlib.contextmanager
def _page(address: str):
    from playwright import sync_api

    program = shutil.which("chromium") or shutil.which("google-chrome")
    flags = ["--headless", "--no-sandbox", "--enable-unsafe-swiftshader"]
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=flags)
        page = browser.new_page(viewport={"width": 1200, "height": 800})
        page.set_default_timeout(300_000)
        page.goto(address)
        yield page
        browser.close()


FUNCTIONS: dict[str, Callable[[], None]] = {
    "axes": axes,
    "strategies": strategies,
    "parts": parts,
    "studio": studio,
}

if __name__ == "__main__":
    for chosen in sys.argv[1:] or FUNCTIONS:
        FUNCTIONS[chosen]()
