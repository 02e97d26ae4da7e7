"""Exports: parts and moulds, build sheet and tolerances, and grasps in plain MuJoCo."""

import csv
import dataclasses
import hashlib
import itertools
import json
import re
import shlex
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import manifold3d
import matplotlib.figure
import mujoco
import numpy as np
import pytest
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from numpy.polynomial import Polynomial

from codesign_jax import cli, control, files, model, rollout, scene, tolerances
from codesign_jax.cost import outcome
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.export import (
    arm,
    casting,
    drawing,
    finger_drawing,
    fonts,
    grasps,
    meshes,
    mould_drawing,
    palm,
    paper,
    plain,
    pose,
    process,
    quantities,
    sheet,
    skin,
    tables,
    valves,
)
from codesign_jax.export.play import play
from codesign_jax.export.process import Process, Section, Size
from codesign_jax.judge import cases
from codesign_jax.model import build_spec
from codesign_jax.scene import beams, hand, parameters, silicones
from codesign_jax.types import failed
from scripts.section import study
from tests.helpers.command_runs import command
from tests.helpers.grasps import (
    batch_inputs,
    hand_world,
    hurried,
    lanes,
    nth,
    pinch,
    repeat,
    stack,
    world_inputs,
)
from tests.helpers.refusals import refusal, refusal_of_command
from tests.helpers.solids import object_file
from tests.helpers.toy_engine import TINY, ToyEngine, tiny


def uniform(length, width, height, wall):
    section = Section(width, height, wall)
    return Size(length, section, section, wall)


USUAL = uniform(95, 20, 20, 5)
FLAT = uniform(170, 20, 15, 7)
SHORT = uniform(12, 20, 25, 2)
TAPERED = Size(120, Section(24, 22, 5), Section(16, 14, 3), 4.0)
# STL holds float32: seven digits of lengths of up to 200 mm.
EXACT = 1e-4


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Folder of the parts of three fingers, and what was said of them."""
    folder = tmp_path_factory.mktemp("parts")
    printed_parts = meshes.write(folder, [USUAL, FLAT, USUAL, SHORT], Process())
    return folder, {part.name: part for part in printed_parts}


def test_equal_fingers_are_written_once_in_both_formats(written):
    folder, parts = written
    labels = ["0_2", "1", "3"]
    kinds = ["", "_tray", "_core", "_base"]
    names = {f"finger_{label}{kind}" for label in labels for kind in kinds}
    assert set(parts) == names
    assert {p.name for p in folder.iterdir()} == {f"{n}.{e}" for n in names for e in meshes.FORMATS}
    assert parts["finger_0_2"].fingers == (0, 2)


def test_files_hold_closed_bodies_in_millimetres(written):
    folder, parts = written
    for path in folder.iterdir():
        surface = trimesh.load_mesh(path)
        part = parts[path.stem]
        assert surface.is_watertight and surface.is_winding_consistent
        assert surface.volume == pytest.approx(part.volume, rel=EXACT) and surface.volume > 0
        np.testing.assert_allclose(surface.bounds[0, 2], 0, atol=EXACT)  # on the printer's bed
        if path.suffix == ".3mf":
            text = zipfile.ZipFile(path).read("3D/3dmodel.model").decode()
            assert 'unit="millimeter"' in text
    assert np.allclose(parts["finger_1"].extents, (170, 20, 15), atol=EXACT)


@pytest.mark.parametrize(("name", "size"), [("0_2", USUAL), ("1", FLAT), ("3", SHORT)])
def test_walls_and_chamber_are_the_design_s(written, name, size):
    """Rays through the finger meet its surfaces at the thickness of the walls."""
    part = solid(written[0] / f"finger_{name}.stl")
    wall = size.base.wall
    across, up = size.base.chamber
    low, high = np.reshape(part.bounding_box(), (2, 3))
    inside = np.array([size.length / 2, 0.3 * across / 2, wall + 0.3 * up])
    for axis, thick in enumerate((size.end, wall, wall)):
        step = 10 * np.eye(3)[axis]
        ends = (
            np.where(step > 0, place + way * step, inside) for way, place in ((-1, low), (1, high))
        )
        hits = part.ray_cast(*ends)
        places = sorted(hit.position[axis] for hit in hits)
        expected = [low[axis], low[axis] + thick, high[axis] - thick, high[axis]]
        np.testing.assert_allclose(places, expected, atol=EXACT)


def solid(path):
    """A part's file as a solid, for booleans."""
    surface = trimesh.load_mesh(path)
    return manifold3d.Manifold(
        manifold3d.Mesh64(np.asarray(surface.vertices, float), np.asarray(surface.faces, "uint64"))
    )


def box(low, high):
    return manifold3d.Manifold.cube(np.subtract(high, low)).translate(low)


@pytest.mark.parametrize("draft", [0.0, 3.0])
def test_what_the_moulds_hold_is_the_finger(tmp_path, draft):
    """The closed mould's cavity, from the files: the shell; the base's pocket: the bottom wall."""
    size = USUAL
    settings = Process(draft=draft, inlet=0.0)
    meshes.write(tmp_path, [size], settings)
    length = size.length
    width, height, wall = size.base
    # Back into the frame of the finger: the tray was turned over, the core's bars stood below it.
    tray = solid(tmp_path / "finger_0_tray.stl").translate([0, 0, -height - settings.mould_wall])
    tray = tray.rotate([180, 0, 0])
    core = solid(tmp_path / "finger_0_core.stl").translate([0, 0, wall - settings.mould_wall])
    assert (tray ^ core).volume() == pytest.approx(0, abs=1e-2)  # they fit: rounding of float32
    room = box([-2, -width / 2 - 2, wall], [length + 2, width / 2 + 2, height])
    cast = room - tray - core
    z = Polynomial([0, 1])
    side = np.tan(np.radians(draft)) * ((wall + height) / 2 - z)

    def prism(a, b, low, high):
        integral = ((a + 2 * side) * (b + 2 * side)).integ()
        return integral(high) - integral(low)

    chamber = length - 2 * wall, size.base.chamber[0]
    shell = prism(length, width, wall, height) - prism(*chamber, wall, height - wall)
    assert cast.volume() == pytest.approx(shell, rel=EXACT)
    base = solid(tmp_path / "finger_0_base.stl").translate([0, 0, -settings.mould_wall])
    pocket = box([-2, -width / 2 - 2, 0], [length + 2, width / 2 + 2, wall]) - base
    bottom = (length + 2 * side(wall)) * (width + 2 * side(wall)) * wall
    assert pocket.volume() == pytest.approx(bottom, rel=EXACT)
    if not draft:
        assert cast.volume() + pocket.volume() == pytest.approx(size.volume, rel=EXACT)
    # The walls keep their thickness: what is between core and tray at any height.
    for height_at in (wall + 1, height - wall - 1):
        [ray] = cast.ray_cast([50.0, -50, height_at], [50.0, -chamber[1] / 2, height_at])[:1]
        inner = cast.ray_cast([50.0, -50, height_at], [50.0, 0, height_at])[1]
        assert inner.position[1] - ray.position[1] == pytest.approx(wall, abs=1e-3)


@pytest.mark.parametrize("root", [0.0, 12.0])
def test_moulds_of_a_tapered_finger_hold_it(tmp_path, root):
    """Shell and bottom wall are the finger, by Simpson's rule over its sections; walls have the
    thickness of the place."""
    settings = Process(inlet=0.0)
    size = TAPERED._replace(root=root)
    meshes.write(tmp_path, [size], settings)
    finger, tray, core, base = (
        solid(tmp_path / f"finger_0{kind}.stl") for kind in ("", "_tray", "_core", "_base")
    )
    assert finger.volume() == pytest.approx(size.volume, rel=EXACT)
    made = casting.parts(size, settings)
    for part, file in zip(made, (finger, tray, core, base), strict=True):
        assert part.volume() == pytest.approx(file.volume(), rel=EXACT)
    assert (made.tray ^ made.core).volume() == pytest.approx(0, abs=1e-6)
    assert core.genus() == 2 * len(casting.bars_of(size))
    x = (-2.0 - root, 122.0)
    half = casting.shifted(casting.half_width(size), 2.0)
    rim = casting._rim(size)

    def top(x):
        return size.at(x).height

    shell = casting.prism(x, half, rim, top) - made.tray - made.core
    pocket = casting.prism(x, half, lambda x: 0.0, rim) - made.base
    assert shell.volume() + pocket.volume() == pytest.approx(size.volume, rel=1e-6)
    for x in (10.0, 110.0):
        top = size.at(x).height
        hits = finger.ray_cast([x, 0.3, top + 5], [x, 0.3, -5])
        at = sorted(hit.position[2] for hit in hits)
        wall = size.at(x).wall
        np.testing.assert_allclose(at, [0, wall, top - wall, top], atol=1e-3)


@pytest.mark.parametrize("size", [USUAL._replace(root=10.0), TAPERED._replace(root=5.0), SHORT])
def test_a_pin_keeps_the_inlet_free(size):
    """From outside of the tray into the core, through nothing but their holes."""
    settings = Process(inlet=2.0)
    made = casting.parts(size, settings)
    start, end = size.chamber_ends
    depth = min(casting.PIN, (end - start) / 2)
    pin = manifold3d.Manifold.cylinder(60, 0.99, 0.99, 32).rotate([0, 90, 0])
    pin = pin.translate([start + depth - 60.01, 0, size.base.height / 2])
    assert (pin ^ made.tray).volume() == 0 and (pin ^ made.core).volume() == 0
    deeper = pin.translate([1, 0, 0])
    assert (deeper ^ made.core).volume() > 0.9 * np.pi  # a millimetre into the core
    # The pin stands where the finger has its inlet, all the way into the chamber.
    assert (pin ^ made.finger).volume() == 0


# --- build sheet and tolerances: a yield that is known is found, and the page says it -------------


KINDS = ("wall",) * 4 + ("length",) * 4 + ("modulus",)


def cast(hands, seed, half=None):
    """Hands whose kept share falls with the squares of their walls' deviations and the modulus."""
    random = np.random.default_rng(seed)
    scores = random.normal(size=(hands + 1, len(KINDS)))
    scores[0] = 0.0
    scores[:, np.array(KINDS) == half] /= 2
    logit = 5 - 0.84 * (scores[:, :4] ** 2).sum(1) - 0.8 * scores[:, 8]
    kept = random.binomial(24, 1 / (1 + np.exp(-logit)))
    return tolerances.Yield(kept, 24, scores, KINDS, {"wall": 0.5})


def test_the_worth_of_a_tolerance_is_found():
    """Of 64 hands, against a hundred thousand of which that tolerance is halved."""
    truth = cast(100_000, 1).share.value
    expected = {name: cast(100_000, 1, name).share.value - truth for name in dict.fromkeys(KINDS)}
    hand_yield = cast(64, 2)
    assert hand_yield.needed == 23 and hand_yield.share.low < truth < hand_yield.share.high
    gains = hand_yield.halved()
    # The ridge draws slopes to 0, so that the gain of walls, 48 points, is up to a sixth short.
    assert gains["wall"].value == pytest.approx(expected["wall"], rel=0.2)
    for name in ("length", "modulus"):
        assert gains[name].low - 0.03 < expected[name] < gains[name].high + 0.03
    assert [row[0] for row in hand_yield.rows][0] == tolerances.KINDS["wall"].words
    assert (
        hand_yield.rows[0][1] == "0.5 mm"
        and "of 64 cast hands keep 95 % of 24" in hand_yield.summary
    )


def test_deviations_are_those_of_each_finger():
    """A finger's own wall, at the tip as well, and the mounts and modulus of a table."""
    the_scene = scene.load("paper")
    deviations, kinds = tolerances.table(the_scene, {"length": 0.0})
    assert kinds == ("wall",) * 4 + ("modulus",) + ("mount",) * 8
    spread = {entry.key: entry.sd for entry in deviations.constant}
    assert spread["design.wall.2"] == pytest.approx(0.15e-3)
    assert spread["hand.material.shear_modulus"] == pytest.approx(0.05)
    assert spread["hand.finger.3.azimuth"] == 1.0
    space = parameters.design_space(the_scene.hand, "full")
    params = jax.tree.map(lambda v: jnp.stack([v, v]), space.params(space.default()))
    thicker = tolerances.deviating(params, ("design", "wall", "2"), jnp.array([0.0, 1e-4]))
    assert np.argwhere(np.asarray(thicker.wall != params.wall)).tolist() == [[1, 2]]
    assert tolerances.read(("wall=0.5",)) == {"wall": 0.5}
    problems = refusal(tolerances.read, ("wal=0.5", "mount=x", "length=-1"))
    assert [code for code, _ in problems] == ["unknown", "range", "range"]


@pytest.fixture(scope="module")
def toy():
    """An engine that two tests share, and with it their program."""
    return ToyEngine(tiny()[0])


@pytest.fixture(scope="module")
def page():
    """Scene, parameters, sizes and tolerances of a design."""
    the_scene = scene.load("paper_spheres")
    space = parameters.design_space(the_scene.hand, "full")
    params = jax.tree.map(np.asarray, space.params(space.default()))
    sizes = process.sizes(the_scene.hand, params, Process())
    return the_scene, params, sizes, cast(64, 2)


ORIGIN = {"design": "x", "command": "y", "version": "z", "objects": ["box"], "notes": []}


def written_sheet(page, folder, printed=None, **tests):
    """The sheet's text, with each paragraph on one line."""
    the_scene, params, sizes, hand_yield = page
    hand = sheet.Hand(the_scene, params, sizes, Process(), printed)
    known = sheet.Tests(cast=hand_yield, **tests)
    text = sheet.write(folder, hand, known, ORIGIN, (100.0, 10.0)).read_text()
    return re.sub(r"(?<=[^|\n])\n *(?=[^|\s])", " ", text)


def table_below(text, title):
    """Rows of the first table below a title, as lists of cells by their first cell."""
    lines = text.partition(f"## {title}\n")[2].partition("\n## ")[0].splitlines()
    cells = [line.strip("| ").split(" | ") for line in lines if line.startswith("|")]
    return {row[0]: row[1:] for row in cells}


def test_sheet_has_dimensions_pressures_and_tolerances(page, tmp_path):
    text = written_sheet(page, tmp_path)
    fingers = (
        "| 0 | 110.00 | 20.00 | 20.00 | 5.00 | 100.00 x 10.00 x 10.00 | 38.0 | 40.7 | 120.0 (200) |"
    )
    assert fingers in text  # 120 x 20 x 20 with the root - 100 x 10 x 10 = 38 cm^3 of 1.07 g
    assert "| walls of each finger | 0.5 mm | +4" in text and "cast hands keep 95 %" in text


LONG = "Build sheet: " + "a_name_as_data_sets_have " * 20


@pytest.mark.parametrize(
    "title", [pytest.param("Build sheet", marks=pytest.mark.slow), LONG + "日本の手" * 30]
)
def test_drawings_stand_apart_and_within_their_pages(page, title):
    the_scene, params, sizes, _ = page
    sizes = [*sizes[:2], TAPERED, *sizes[3:]]
    printed = process.Printed(["palm"], 1e5, None, 0.0)
    drawn = drawing.pages(title, the_scene, params, sizes, printed, Process())
    _, _, fingers, _, moulds, _ = drawn
    for figure in drawn:
        FigureCanvasAgg(figure).draw()
        edge = figure.bbox
        titles = (
            part
            for axes in figure.axes
            for part in axes.get_children()
            if isinstance(part, Text) and part not in axes.texts
        )
        texts = [*figure.texts, *titles]
        # Letters of a font that has no bold variant end up to a point further.
        boxes = {t.get_text(): t.get_window_extent() for t in texts if t.get_text()}
        for (text, first), (other, second) in itertools.combinations(boxes.items(), 2):
            assert not first.overlaps(second), (text, other)
        for text, box in boxes.items():
            assert edge.x0 < box.x0 and box.x1 < edge.x1, text
            assert edge.y0 < box.y0 and box.y1 < edge.y1, text
    titles = [axes.get_title() for axes in fingers.axes]
    assert "finger 0, 1, 3" in titles and {"finger 2, base", "finger 2, tip"} < {*titles}
    assert sum("bottom wall, cut" in axes.get_title("left") for axes in moulds.axes) == 1
    assert len(drawing.pages(title, the_scene, params, sizes)) == 5  # no parts, no moulds


def test_views_are_to_scale_with_the_lengths_beside_them(page):
    """The sides of a section on paper, and the numbers of its dimension lines."""
    the_scene, params, sizes, _ = page
    figure = matplotlib.figure.Figure(figsize=(210 / 25.4, 297 / 25.4))
    finger_drawing.fingers_page(figure, [(sizes[0], [0])], paper.About())
    section = next(axes for axes in figure.axes if axes.get_title() == "finger 0")
    width, height, _ = sizes[0].base
    box = section.get_position()
    assert (210 * box.width, 297 * box.height) == pytest.approx((width, height))  # at 1:1
    numbers = {text.get_text() for text in section.texts}
    assert {f"{width:.1f}", f"{height:.1f}"} < numbers
    assert "1:1, on A4" in {text.get_text() for axes in figure.axes for text in axes.texts}


def test_a_free_bend_is_drawn_as_elements_have_it():
    """At 50 kPa, against section "nominal02" of docs/data/section.npz, which scripts.section made.

    The law's errors in docs/notes/section.md are 6 % of the moment and 4 % of the volume, root mean
    squares over all usual sections: one of them may have twice that.
    """
    the_scene = scene.load("paper", overrides={"hand.section.law": "elements"})
    assert the_scene.hand.material.shear_modulus == pytest.approx(88e3)  # as of the elements
    space = parameters.design_space(the_scene.hand, "full")
    params = jax.tree.map(np.asarray, space.params(space.default()))
    sides = {"height": 20e-3, "wall": 5e-3, "pressure": 50e3}
    params = params._replace(**{k: np.full_like(params.height, v) for k, v in sides.items()})
    bend = finger_drawing.Bend(the_scene, params, 0)
    _, states = study.read(ROOT / "docs" / "data" / "section.npz")["nominal02"]
    [free] = np.flatnonzero((states["pressure"] == 50e3) & (abs(states["moment_bend"]) < 1e-6))
    assert bend.pressure == pytest.approx(50e3)
    assert bend.angle == pytest.approx(states["bend"][free] * bend.length / 1e3, rel=0.12)
    filled, rest = bend.air
    assert rest == pytest.approx(14 * 10, rel=2e-3)  # the smooth slack of the fabric has a share
    assert filled == pytest.approx(1e6 * states["volume"][free], rel=0.08)
    # A circle; straight pieces of it, 400 of them, are a millionth off.
    radius = bend.length / bend.angle
    tip = radius * np.array([np.sin(bend.angle), np.cos(bend.angle) - 1])
    np.testing.assert_allclose(bend.fabric[-1], tip, rtol=1e-4)
    steps = np.hypot(*np.diff(bend.fabric, axis=0).T)
    assert steps.sum() == pytest.approx(bend.length)


def test_beam_theory_has_no_deformed_chamber(page):
    the_scene, params, *_ = page
    assert finger_drawing.Bend(the_scene, params, 0).air is None


@pytest.mark.parametrize(("plane", "at"), [("along", 0.0), ("along", 4.0), ("across", 50.0)])
def test_cuts_of_the_moulds_have_the_sections_areas(plane, at):
    """The shell and the bottom wall of a uniform finger, cut, against rectangles."""
    size = USUAL._replace(root=10.0)
    settings = Process(inlet=0)
    first, second = mould_drawing.castings(size, settings)
    width, height, wall = size.base
    long = size.length + size.root
    chamber = (size.length - 2 * size.end) * (height - 2 * wall)
    whole = long * height - chamber
    bottom = long * wall
    if plane == "across":
        whole = width * height - (width - 2 * wall) * (height - 2 * wall)
        bottom = width * wall

    def area(solid):
        return sum(
            0.5 * np.sum(v[:, 0] * np.roll(v[:, 1], -1) - v[:, 1] * np.roll(v[:, 0], -1))
            for v in mould_drawing.cut(solid, plane, at)
        )

    # 0.01 mm beside the plane, which no side of a uniform finger feels.
    assert area(first["silicone"]) == pytest.approx(whole - bottom, rel=1e-6)
    assert area(second["cured shell"]) == pytest.approx(whole - bottom, rel=1e-6)
    assert area(second["bottom wall"]) == pytest.approx(bottom, rel=1e-6)
    # What is poured and what the moulds are made of never share room.
    for solids in (first, second):
        for part, other in itertools.combinations(solids.values(), 2):
            assert (part ^ other).volume() < FINE
    # The fabric, half a millimetre thick, has its way up behind the root.
    strip = box((-10.6, -width / 2, wall + 0.1), (-10.1, width / 2, wall + 20.0))
    assert (strip ^ second["base mould"]).volume() < FINE


def test_letters_of_a_title(tmp_path, page):
    """Mathematics is text, what no font has is a question mark and is named."""
    rendered = fonts.of_text("a\nhand $x_{2 of 日本 \U0010fffd\U0010fffd")
    assert rendered.text.startswith("a hand $x_{2 of ") and rendered.text.endswith("??")
    assert "\U0010fffd" in rendered.lacking and "a" not in rendered.lacking
    the_scene, params, sizes, _ = page
    assert drawing.write(tmp_path, "\U0010fffd $\\frac", the_scene, params, sizes) == ["\U0010fffd"]
    data = (tmp_path / "build_sheet.pdf").read_bytes()
    assert data.startswith(b"%PDF") and b"/Count 5" in data


def test_the_sheet_s_lists_add_up(page, tmp_path):
    """Silicone of the solids, all fingers' castings, and what every step of the work takes."""
    the_scene, params, sizes, _ = page
    settings = Process()
    made = palm.palm(the_scene, params, sizes, settings)
    printed = process.Printed(["palm", "bar_0_1"], 1e5, made.flange, made.below)
    text = written_sheet(page, tmp_path, printed)
    bought = table_below(text, "What to buy")
    solids = [casting.parts(size, Process(inlet=0)).finger.volume() for size in sizes]
    assert bought["silicone"][1].startswith(f"{sum(solids) / 1e3:.0f} cm³ cast + 15 % loss")
    grams = float(bought["silicone"][0].removesuffix(" g"))
    castings = table_below(text, "Silicone by casting")
    cast = [float(cell.split()[0]) for i in range(4) for cell in castings[str(i)]]
    assert sum(cast) == pytest.approx(grams, abs=len(cast))  # whole grams
    bottoms = [quantities.bottom(size) for size in sizes]
    pockets = [(s.length + s.root) * s.base.width * s.base.wall for s in sizes]
    np.testing.assert_allclose(bottoms, pockets)
    # Of a hanging hand by hand: 0.25 kg and four fingers of 34 cm^3 of 1.07 g, on its spring.
    weight = 9.81 * (0.25 + 4 * 34e-6 * 1070)
    hangs = 1e3 * weight / the_scene.hand.wrist.linear_stiffness
    assert quantities.sag(the_scene, sizes) == pytest.approx(hangs, rel=1e-3)
    # 110 mm of 80 mm around, a turn every 4 mm there and back, four times, and a fifth more.
    assert bought["thread"][0] == f"{1.2 * 4 * 2 * 110 / 4 * 0.08:.1f} m"
    # 10 cm^3 rise by 120 kPa within 1.5 s: l/min at standard pressure, of one and of all.
    flow = 60 * 0.01 * 120 / 1.5 / 101.325
    np.testing.assert_allclose(quantities.flows(the_scene, params, sizes), flow, rtol=1e-6)
    assert f"{flow:.1f} l/min" in bought["pressure regulators"][1]
    assert f"{4 * flow:.1f} l/min" in bought["compressed air"][1]
    assert bought["analog outputs"][0] == "4" and "0.12 kPa" in bought["analog outputs"][1]
    counts = {"dump valves": "4", "relief valves": "4", "screws of the bars": "8", "manifold": "1"}
    assert {name: bought[name][0] for name in counts} == counts
    # Walls of 5 mm stand 200 kPa.
    assert "finger 0 200, finger 1 200" in bought["relief valves"][1]
    # 250 g of palm less 100 cm^3 of plastic of 1.24 g.
    assert bought["ballast"][0] == "126 g"
    thick = 1e3 * the_scene.hand.palm.thickness
    assert f"; {thick - 5.5:.1f} mm of palm" in bought["screws to the wrist"][1]
    assert "finger 0 120 kPa, finger 1 120 kPa" in text.partition("Leak test")[2]
    assert table_below(text, "What to print")["bar_0_1"][0] == "2"


@pytest.mark.parametrize(
    ("change", "named", "nearest"),
    [
        ({"silicone": "ecoflex_00_30", "law": "neo_hookean"}, "Ecoflex 00-30", "Ecoflex 00-30"),
        ({"shear_modulus": 90e3, "law": "neo_hookean"}, None, "Dragon Skin 10 Medium"),
        # 1.78 times as much under the neo-Hookean law.
        ({"shear_modulus": 90e3, "law": "linear"}, None, "Dragon Skin 20"),
    ],
)
def test_a_hand_s_silicone_is_named_or_the_nearest_is(change, named, nearest):
    plain = hand.Material(27.6e3, 1070.0, 3e-3)
    material = dataclasses.replace(plain, **change)
    rubber = quantities.silicone_of(material)
    assert (rubber and rubber.name) == named and quantities.nearest_silicone(
        material, neo_hookean=silicones.of_law(material.law)
    ).name == nearest


@pytest.mark.parametrize(
    ("length", "pressure", "idle"), [(0.017, 4e4, True), (0.11, 0.0, True), (0.11, 1.2e5, False)]
)
def test_a_finger_that_does_nothing_is_named(page, length, pressure, idle):
    the_scene, params, _, _ = page
    first_finger = np.array([True, False, False, False])
    rest = params
    params = rest._replace(
        length=np.where(first_finger, length, rest.length),
        pressure=np.where(first_finger, pressure, rest.pressure),
    )
    sentences = sheet.idle_fingers(
        the_scene, params, process.sizes(the_scene.hand, params, Process())
    )
    assert [words.startswith("finger 0 does next to nothing") for words in sentences] == [
        True
    ] * idle


def test_the_sheet_says_how_fingers_press_and_whence_the_object_falls(page, tmp_path):
    """A level hand: a tip is the length times the sine of the tilt below the palm."""
    the_scene, params, sizes, _ = page

    def heights(design):
        corners = sheet.corners(the_scene, design, sizes)
        return quantities.tip_heights(the_scene, design, corners)

    level = params._replace(arm=np.array([0, 0, params.arm[2], 0, 0, 0], float))
    poses = arm.key_poses(the_scene, level)
    lowest = poses[:, 3].min()
    tilts = np.radians([finger.tilt for finger in the_scene.hand.finger])
    expected = lowest - np.array([size.length for size in sizes]) * np.sin(tilts)
    tips = heights(level)
    np.testing.assert_allclose(tips, expected, atol=1e-3)  # float32
    low = level._replace(arm=level.arm - 1e-3 * (tips.min() + 20) * np.eye(6)[2])
    text = written_sheet((the_scene, low, sizes, None), tmp_path)
    force = 0.02 * the_scene.hand.wrist.linear_stiffness
    assert "by up to 20 mm" in text and f"at most {force:.1f} N" in text
    high = level._replace(arm=level.arm - 1e-3 * (tips.min() - 20) * np.eye(6)[2])
    text = written_sheet((the_scene, high, sizes, None), tmp_path)
    assert "None is pressed on the table" in text and "rams" not in text
    assert quantities.drop(the_scene, level)[0] == pytest.approx(poses[:, 3].max() - lowest)
    # The closed form of the strain's pressure gives the limits back.
    strains = quantities.limit_strains(the_scene, params)
    material = the_scene.hand.material
    pressures = beams.strain_pressure(
        strains,
        params.height,
        params.wall,
        width=the_scene.hand.section.width,
        shear_modulus=material.shear_modulus / material.moment_factor,
        neo_hookean=bool(the_scene.effects.neo_hookean),
    )
    np.testing.assert_allclose(pressures, 2e5, rtol=1e-5)  # float32


# --- the palm: fingers fit into its seats, in any hand -------------------------------------------


HANDS = {
    "pneuflex4": {},
    "tripod3": {},
    "thumb4": {},
    "tapered4": {},
    "level": {f"hand.finger.{i}.tilt": 0.0 for i in range(4)},
    "upright": {f"hand.finger.{i}.tilt": 90.0 for i in range(4)},
    "small": {"hand.palm.radius": 0.02, "hand.palm.thickness": 0.005},
    "far": {
        f"hand.finger.{i}.base": base
        for i, base in enumerate([[0.09, 0.02], [0.09, -0.02], [-0.09, -0.02], [-0.09, 0.02]])
    },
}
FINE = 1e-2  # mm^3: seats are rounded to hundredths of a millimetre along their edges


@pytest.mark.parametrize("name", HANDS)
def test_fingers_fit_into_the_palm(name, tmp_path):
    hand = name if not HANDS[name] else "pneuflex4"
    the_scene = scene.load("paper_spheres", hand_name=hand, overrides=HANDS[name])
    space = parameters.design_space(the_scene.hand, "full")
    params = jax.tree.map(np.asarray, space.params(space.default()))
    settings = Process()
    sizes = process.sizes(the_scene.hand, params, settings)
    made = palm.palm(the_scene, params, sizes, settings)
    meshes.write_palm(tmp_path, made)
    body = solid(tmp_path / "palm.stl")
    low = made.body.bounding_box()[2]
    body = body.translate([0, 0, low])
    assert trimesh.load_mesh(tmp_path / "palm.stl").is_watertight and len(body.decompose()) == 1
    assert low == pytest.approx(-made.below, abs=1e-6)
    assert made.below == 0 or name == "level"
    for i, (size, frame) in enumerate(zip(sizes, palm.frames(the_scene, params), strict=True)):
        finger = casting.parts(size, settings).finger.transform(frame)
        bar = made.bars[i].transform(frame)
        assert (body ^ finger).volume() < FINE and (body ^ bar).volume() < FINE
        # The bar presses the root by its share of the height, over the root's length and width.
        ends = [size.at(x) for x in (-size.root, -size.root / 2, 0.0)]
        areas = [z.width * (z.height - size.pressed) for z in ends]
        expected = size.root * (areas[0] + 4 * areas[1] + areas[2]) / 6
        assert (bar ^ finger).volume() == pytest.approx(expected, rel=1e-3)  # the screws' holes
        assert size.pressed == pytest.approx(0.95 * size.base.height)
        # The root cannot turn or sink: a hair to either side, in or backwards it meets the palm.
        for x, y, z in ((-1, 0, 0), (0, 0.5, 0), (0, -0.5, 0), (0, 0, -0.5)):
            displaced = finger.translate(frame[:, :3] @ [x, y, z])
            assert (body ^ displaced).volume() > 1, (i, x, y, z)
        # Each screw cuts its thread in the palm and passes the bar; the tube comes out on top.
        for x, y in palm.screws(size, settings):
            for radius, cuts in ((1.2, False), (1.5, True)):
                screw = manifold3d.Manifold.cylinder(16, radius, radius, 32)
                screw = screw.translate([x, y, size.pressed + process.BAR - 16]).transform(frame)
                assert (screw ^ bar).volume() < FINE
                assert ((screw ^ body).volume() > 10) == cuts
    assert made.flange is not None and (made.flange.diameter < 31.5) == (name in ("small", "level"))
    assert not made.problems or name == "level" and "clamp bars" in made.problems[0]


def test_what_cannot_be_built_is_named():
    """Fingers whose bases stand in one another, as in the hand of one circle at little spread."""
    the_scene = scene.load("paper_spheres", hand_name="pneuflex4_circle")
    space = parameters.design_space(the_scene.hand, "full")
    params = space.params(space.default())._replace(spread=np.float32(0.0))
    sizes = process.sizes(the_scene.hand, params, Process())
    made = palm.palm(the_scene, params, sizes, Process())
    assert made.problems[0] == "the bases of fingers 0 and 1 stand in one another"


def test_the_assembly_stands_as_mujoco_has_it(page):
    """By its kinematics: frames of the fingers' first bodies, lengths along x, up from z = 0."""
    the_scene, params, sizes, _ = page
    nominal = jax.tree.map(np.asarray, rollout.nominal_trial(the_scene))
    data = mujoco.MjData(compiled := model.compile_model(the_scene, params, nominal))
    mujoco.mj_kinematics(compiled, data)
    palm = data.xmat[1].reshape(3, 3)
    drawn = sheet.corners(the_scene, params, sizes)
    for stub, size, outline in zip(model.layout(the_scene).stubs, sizes, drawn, strict=True):
        place = 1e3 * (data.xpos[stub] - data.xpos[1]) @ palm
        turn = palm.T @ data.xmat[stub].reshape(3, 3)
        half = size.base.width / 2
        high = size.tip.height
        np.testing.assert_allclose(outline[0], place + turn @ [0, -half, 0], atol=1e-3)
        np.testing.assert_allclose(outline[6], place + turn @ [size.length, half, high], atol=1e-3)


TOY = ["export", "--scene", str(TINY), "--no-parts", "--design", "length=100", "arm_z=40"]
TOY += ["--set", "objects.noise.position=0"]
CAST = ["--tolerances", "wall=0.2", "--hands", "8"]


@pytest.fixture
def by_toy(toy, tmp_path, monkeypatch):
    """The toy engine simulates; rates are those that were measured elsewhere."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(cases, "make_engine", lambda name, the_scene: toy)


def test_lines_are_what_is_bought_and_played(page, tmp_path):
    """Three lines of four fingers: two share one, whose regulator fills both."""
    the_scene, params, sizes, _ = page
    params = params._replace(
        wall=np.array([0.005, 0.005, 0.005, 0.004]),
        pressure=np.array([1.2e5, 9e4, 1.1e5, 1.2e5]),
    )
    alone = 60 * 0.01 * 120 / 1.5 / 101.325
    for lines in (hand.Valves(groups=((0, 3),)), hand.Valves(lines=3)):
        shared = dataclasses.replace(
            the_scene, hand=dataclasses.replace(the_scene.hand, valves=lines)
        )
        assert valves.lines(shared, params) == [(0, 3), (1,), (2,)]
        text = written_sheet((shared, params, sizes, None), tmp_path)
        bought = table_below(text, "What to buy")
        for part in ("pressure regulators", "relief valves", "dump valves", "analog outputs"):
            assert bought[part][0] == "3", part
        assert f"{2 * alone:.1f} l/min" in bought["pressure regulators"][1]
        assert bought["branches"] == ["1", "of a regulator's tube, with 2 outlets"]
        assert "line 0 (fingers 0, 3) 160, finger 1 200" in bought["relief valves"][1]
        pressures = np.loadtxt(valves.write(tmp_path, shared, params), delimiter=",", skiprows=1)
        np.testing.assert_allclose(pressures[:, 1:].max(0), [120, 90, 110], rtol=1e-6)
        head = table_below(text, "Pressures")["time s"]
        assert head[:2] == ["line 0 (fingers 0, 3) kPa", "finger 1 kPa"]
    two = dataclasses.replace(
        the_scene, hand=dataclasses.replace(the_scene.hand, valves=hand.Valves(lines=2))
    )
    [(code, _)] = refusal(valves.lines, two, params)
    assert code == "geometry"


def test_command_writes_the_sheet(tmp_path, capsys, by_toy):
    assert cli.main([*TOY, "--out", str(tmp_path / "plain")]) == 0
    output = capsys.readouterr().out
    assert "--tolerances --overwrite simulates them, 1,560 grasps" in output
    assert "Not simulated" in (tmp_path / "plain" / "build_sheet.md").read_text()
    words = [*TOY, *CAST, "--out", str(tmp_path / "out")]
    assert cli.main(words) == 0
    output = capsys.readouterr().out
    assert "tolerances: 100 % of 8 cast hands keep 95 % of 24 grasps" in output
    assert "build_sheet.pdf: build sheet" in output and "no tolerances" not in output
    text = (tmp_path / "out" / "build_sheet.md").read_text()
    assert "100 % of 8 cast hands keep 95 % of 24 grasps" in text
    assert "| walls of each finger | 0.2 mm |" in text and "Scene tiny" in text
    listed = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert f"Design: {listed['design']}. Export: {listed['command']}" in text
    assert listed["command"] == shlex.join(["codesign", *words]) and listed["design"]
    assert (tmp_path / "out" / "build_sheet.pdf").exists()
    assert {p.name for p in tmp_path.iterdir()} - {"cache"} == {"out", "plain"}
    lines = (tmp_path / "out" / "valves.csv").read_text().splitlines()
    assert lines[0].startswith("time_s,pressure_0_kPa")
    (tmp_path / "out" / "mine.txt").touch()
    assert cli.main([*TOY, "--no-sheet", "--overwrite", "--out", str(tmp_path / "out")]) == 0
    assert "left there, no part of this export: mine.txt" in capsys.readouterr().out
    assert not (tmp_path / "out" / "build_sheet.pdf").exists()
    with files.whole_folder(tmp_path / "busy"):
        problems = refusal_of_command(*TOY, "--no-sheet", "--out", tmp_path / "busy")
        assert problems == [("file", f"--out {tmp_path / 'busy'}")]
    [(code, _)] = refusal_of_command(*TOY, "--tolerances", "walls=1", "--out", tmp_path / "no")
    assert code == "unknown" and not (tmp_path / "no").exists()


def fill(path, *names, **kwargs):
    """Fills a folder with files that hold their names."""
    with files.whole_folder(path, **kwargs) as part:
        for name in names:
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).write_text(name)


def below(path):
    return {p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file()}


def test_a_folder_is_there_as_a_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a" / "folder"
    with pytest.raises(ValueError), files.whole_folder(path) as part:
        (part / "half").touch()
        raise ValueError
    assert [*(tmp_path / "a").iterdir()] == []
    part.mkdir()
    (part / "of a killed process").touch()
    (part.parent / ".folder.other.part").mkdir()  # of a folder whose name begins alike
    fill(path, "new")
    assert below(tmp_path / "a") == {"folder/new", "folder/manifest.json"}
    assert {p.name for p in path.parent.iterdir()} == {"folder", ".folder.other.part"}


def test_what_belongs_to_a_folder_is_replaced_whole(tmp_path):
    """Of what an earlier call wrote nothing stays, of others' files all, whatever their place."""
    path = tmp_path / "folder"
    outside = tmp_path / "outside"
    fill(path, "kept", "changed", "parts/old", "deep/er/old", "edited")
    (path / "foreign").touch()
    (path / "parts" / "mine").touch()
    (path / "edited").write_text("by its reader")
    fill(path, "kept", "changed", "parts/new")
    others = ["edited", "foreign", "parts/mine"]
    assert files.foreign(path) == others
    assert below(path) == {*others, "kept", "changed", "parts/new", "manifest.json"}
    assert not (path / "deep").exists()
    # A list is data: it deletes nothing outside of its folder, and a damaged one nothing at all.
    outside.write_text("outside")
    digest = hashlib.sha256(b"outside").hexdigest()
    for name in ("../outside", str(outside), "link/outside"):
        (path / files.MANIFEST).write_text(json.dumps({"files": {name: digest}}))
        (path / "link").is_symlink() or (path / "link").symlink_to(tmp_path)
        fill(path, "kept")
        assert outside.exists(), name
    for text in ("", "[]", "{}", '{"files": 3}'):
        (path / files.MANIFEST).write_text(text)
        fill(path, "kept")
        assert files.foreign(path) == ["changed", *others[:2], *sorted(["parts/mine", "parts/new"])]


def test_one_call_fills_a_folder_at_a_time(tmp_path):
    path = tmp_path / "folder"
    with files.whole_folder(path) as part:
        (part / "first").touch()
        with pytest.raises(BlockingIOError):
            fill(path, "second")
        fill(tmp_path / "beside", "other")
    assert below(path) == {"first", "manifest.json"}
    with pytest.raises(FileExistsError):
        fill(path, "second", replace=False)
    (path / "second").mkdir()
    with pytest.raises(IsADirectoryError):
        fill(path, "second")
    assert "first" in below(path) and {p.name for p in tmp_path.iterdir()} == {"folder", "beside"}


# --- exported grasps: plain MuJoCo simulates the files as the engine mujoco does ------------------


ROOT = Path(__file__).parent.parent

# A grasp in 2.2 s, with all joints and contacts.
HURRIED = hurried(0.5, 0.8, 1.2, 1.6, 2.2)


def by_engine(the_scene, params, trials):
    """Trace and outcomes of the engine `mujoco` in float64."""
    with jax.enable_x64(True):
        inputs = jax.tree.map(np.asarray, batch_inputs(the_scene, params, trials))
        trace = MujocoEngine(the_scene).rollout(*inputs, trajectory=True)
        judged = jax.jit(jax.vmap(lambda t: outcome(the_scene, t)))(trace)
        return jax.tree.map(np.asarray, (trace, judged))


@pytest.fixture(scope="module")
def grasped():
    """A scene and three grasps: one that holds, one with every noise, one of slack fingers."""
    the_scene = pinch("box", **HURRIED)
    arm = np.array([0, 0, 0.03, 0, 0, 0])
    holding, still = hand_world(the_scene, length=0.10, pressure=1.9e5)
    holding = holding._replace(arm=arm)
    noisy = still._replace(
        position=np.array([0.004, -0.003]),
        arm_tilt=np.array([0.05, -0.03]),
        mass=np.array(1.1),
        size=np.array(0.95),
        friction=np.array(1.2),
        stiffness=np.array(0.9),
        hand_mass=np.array(1.1),
    )
    slack = holding._replace(pressure=0.1 * holding.pressure)
    worlds = [(holding, still), (holding, noisy), (slack, still)]
    with jax.enable_x64(True):
        params, trials = stack(*worlds)
    trace, judged = by_engine(the_scene, params, trials)
    return the_scene, worlds, trace, judged


def read(path):
    """Rows of a table."""
    return list(csv.DictReader(path.read_text().splitlines()))


def errors(states, trace, index):
    """Largest difference of a generalized position in each step [m or rad]."""
    return np.abs(states[:, : trace.qpos.shape[2]] - trace.qpos[index]).max(1)


def test_plain_mujoco_plays_the_files_as_the_engine(grasped, tmp_path):
    the_scene, worlds, trace, judged = grasped
    assert np.isinf(judged.lost_time).tolist() == [True, False, False]
    simulated = [grasps.grasp(the_scene, *world) for world in worlds]
    trials = [(f"grasp_{i}", trial) for i, (_, trial) in enumerate(worlds)]
    list(tables.write_grasps(tmp_path, the_scene, trials, simulated))
    for i, (name, _) in enumerate(trials):
        controls = np.loadtxt(tmp_path / f"{name}_controls.csv", delimiter=",", skiprows=1)
        xml = mujoco.MjModel.from_xml_path(str(tmp_path / f"{name}.xml"))
        binary = mujoco.MjModel.from_binary_path(str(tmp_path / f"{name}.mjb"))
        for loaded in (xml, binary):
            assert loaded.nlight and loaded.vis.headlight.diffuse.min() > 0.3 and loaded.ntex
            when, _, states = play(loaded, controls)
            assert when == judged.lost_time[i]
            # Rounding of 1e-16 grows while fingers slide on the sphere, here to 1e-11.
            assert errors(states, trace, i).max() < 1e-7
        # Plain MuJoCo tells no warnings.
        assert simulated[i].outcome.status == judged.status[i] & ~8


def assert_declared(alone, spec, shares):
    """K I, B and R of every constraint row, in the file and in the model with declared weights.

    In a state with many contacts; the normal's stiffness k_n = K I / R is the declared one of two
    bodies, twice as large at the table, times the share of a sphere on a finger.
    """
    rows = []
    written = plain.text(alone, spec.copy(), shares)
    declared = plain.engine_model(alone, spec, shares)
    for played in (declared, mujoco.MjModel.from_xml_string(written)):
        data = mujoco.MjData(played)
        # Palm, straight fingers, object and table are in one another.
        data.qpos[2] = 0.005
        data.qpos[-7:-4] = [0.03, 0, 0.02]
        mujoco.mj_forward(played, data)
        k, b, impedance = data.efc_KBIP[:, :3].T
        rows.append(np.stack([k * impedance, b, data.efc_R]))
    assert rows[0].shape[1] > 10
    np.testing.assert_allclose(rows[1], rows[0], rtol=1e-10)  # rounding
    stiffness = rows[0][0] / rows[0][2]
    touching = 0
    for contact in data.contact:
        names = [played.geom(g).name for g in contact.geom]
        share = min(shares.get(name, 1.0) for name in names)
        expected = share * alone.contact.normal_stiffness * 2 / (1 if "table" in names else 2)
        assert stiffness[contact.efc_address] == pytest.approx(expected, rel=1e-9)
        touching += share < 1
    assert touching > 2 or not shares


@pytest.mark.parametrize("friction", ["none", "coulomb"])
def test_contacts_have_the_declared_stiffness(friction):
    the_scene = pinch("box", effects__friction=friction, effects__finger_finger=True)
    params, trial = hand_world(the_scene)
    alone, trial = plain.single_object(the_scene, params, trial)
    assert_declared(alone, build_spec(alone, params, trial), {})


def test_sections_by_elements_bend_as_far_in_the_model():
    """Free bends of linear springs under the exported gains, with a finger without pressure."""
    law = {"section__law": "elements", "effects__neo_hookean": True}
    the_scene = pinch("box", links=2, **law, **HURRIED)
    params, trial = hand_world(the_scene)
    params = params._replace(pressure=np.array([40e3, 0.0]))
    exported = grasps.world(the_scene, params, trial)
    played = grasps.grasp(the_scene, params, trial)
    assert np.isfinite(played.states).all()
    assert not failed(played.outcome.status)
    dofs = model.layout(the_scene).dofs[..., 0]
    gain = exported.actuator_gainprm[6:, 0]
    bends = (params.pressure * gain)[:, None] / exported.jnt_stiffness[exported.dof_jntid[dofs]]
    expected = model.morphology.free_bends(the_scene.hand, params)
    np.testing.assert_allclose(bends.sum(1), expected, rtol=1e-6)
    assert expected[0] > 0.3
    assert any("hand.section.law" in sentence for sentence in plain.differences(the_scene))


@pytest.fixture(scope="module")
def skinned():
    """A scene with the hull, contact between fingers and one object, a hand, and its spec."""
    the_scene = pinch(
        "box", links=2, effects__surface="hull", effects__finger_finger=True, **HURRIED
    )
    params, trial = hand_world(the_scene, length=0.08)
    alone, trial = plain.single_object(the_scene, params, trial)
    spec = build_spec(alone, params, trial)
    return alone, params, trial, spec, skin.add(alone, spec, params)


def test_spheres_stand_where_the_engine_has_its_rings(skinned):
    """In the engine's own table of rings; their shares are the finger's length in widths."""
    alone, params, trial, _, shares = skinned
    fields, _ = world_inputs(alone, params, trial)
    hand = lanes(alone, repeat(fields, 1))
    rings = np.asarray(hand.ring)[:, :, 1, 0]
    segment = params.length[1] / alone.discretization.links
    spheres = skin.balls(alone, 1, params)
    np.testing.assert_allclose([b.place for b in spheres], rings[:, :3], atol=1e-6)
    np.testing.assert_allclose([b.share for b in spheres], rings[:, 6], rtol=1e-5)
    total = sum(share for name, share in shares.items() if name.startswith("finger_1"))
    length = params.length[1] - segment / 2  # the half link at the palm is the palm's
    assert total == pytest.approx(length / alone.hand.section.width)


def test_a_sphere_is_as_stiff_as_its_share_of_the_finger(skinned):
    alone, _, _, spec, shares = skinned
    assert_declared(alone, spec, shares)


def test_commands_are_the_key_frames(tmp_path):
    the_scene = scene.load("paper_spheres")
    space = parameters.design_space(the_scene.hand, "2d")
    with jax.enable_x64(True):
        design = nth(space.params(space.default()), ...)
    nominal = jax.tree.map(np.asarray, rollout.nominal_trial(the_scene))
    rows = read(arm.write(tmp_path, the_scene, design, nominal))
    head = [*arm.COLUMNS, *(f"pressure_{i}_kPa" for i in (1, 2, 3))]
    assert [*rows[0]] == head and len(rows) == 900
    at = {row["time_s"]: {k: v for k, v in row.items() if k != "phase"} for row in rows}
    values = {t: {k: float(v) for k, v in row.items()} for t, row in at.items()}
    # mm, as in the scene file
    top = 300
    grasp = 60 + float(1e3 * design.arm[2])
    heights = {"0": top, "1": (top + grasp) / 2, "2": grasp, "4.5": top}
    for time, height in heights.items():
        assert values[time]["arm_z_mm"] == pytest.approx(height, rel=1e-6)
    assert values["2.75"]["pressure_3_kPa"] == pytest.approx(60, abs=1e-4)
    assert values["0"]["arm_pitch_deg"] == pytest.approx(15, rel=1e-6)
    phase = {row["time_s"]: row["phase"] for row in rows}
    assert [phase[t] for t in ("1.99", "2", "4.49")] == ["approach", "inflate", "lift"]


def by_column(text, title):
    """Columns of the first table below a title."""
    rows = [[first, *cells] for first, cells in table_below(text, title).items() if first != "---"]
    return {head: list(column) for head, *column in zip(*rows, strict=True)}


@pytest.mark.parametrize("settle", [0.0, 0.25])
def test_commands_played_back_are_the_sheet_s_poses(tmp_path, settle):
    """One sign and one order of the angles: the commands, the sheet and MuJoCo's hinges agree."""
    the_scene = scene.load("paper_spheres", overrides={"phases.settle": settle})
    space = parameters.design_space(the_scene.hand, "full")
    params = jax.tree.map(lambda v: np.asarray(v, float), space.params(space.default()))
    angles = {"roll": 35.0, "yaw": -20.0, "pitch": 50.0}
    turned = np.array([0.02, -0.03, 0.04, *np.radians([35.0, 50.0, -20.0])])
    params = params._replace(arm=turned)
    nominal = jax.tree.map(np.asarray, rollout.nominal_trial(the_scene))
    controls = grasps.timed_controls(the_scene, params, nominal)
    path = arm.write(tmp_path, the_scene, params, nominal)
    rows = {round(float(row["time_s"]), 6): row for row in read(path)}
    sizes = process.sizes(the_scene.hand, params, Process())
    text = written_sheet((the_scene, params, sizes, None), tmp_path)
    arms, pressures = (by_column(text, title) for title in ("Arm", "Pressures"))
    compared = 0
    for k, time in enumerate(map(float, arms["time s"])):
        if time not in rows:
            continue  # the end, which is no step
        row = rows[time]
        compared = compared + 1
        for name in ("x mm", "y mm", "z mm", "roll °", "yaw °", "pitch °"):
            word, unit = name.split()
            column = f"arm_{word}_{'deg' if unit == '°' else unit}"
            assert float(row[column]) == pytest.approx(float(arms[name][k]), abs=0.051), name
        turn = [float(row[f"arm_q{c}"]) for c in "wxyz"]
        written = [float(v) for v in arms["quaternion w x y z"][k].split()]
        np.testing.assert_allclose(written, turn, atol=5.1e-5)  # four digits behind the point
        for f in range(the_scene.num_fingers):
            pressure = float(pressures[f"finger {f} kPa"][k])
            assert float(row[f"pressure_{f}_kPa"]) == pytest.approx(pressure, abs=0.051)
    assert compared >= 5
    # No shaking: the fastest rows are those between two key frames.
    moves = np.diff(np.array([[float(v) for v in arms[f"{a} mm"]] for a in "xyz"]), axis=1)
    spans = np.diff(np.array(arms["time s"], float))
    fastest = (np.linalg.norm(moves, axis=0) / spans).max()
    assert arm.speeds(path) == pytest.approx((fastest, 0.0), abs=0.3)  # mm of a rounded table
    # MuJoCo turns the palm by the controls as the commands say.
    compiled = model.compile_model(the_scene, params, nominal)
    data = mujoco.MjData(compiled)
    k = round((settle + 2) / 0.01)
    data.qpos[:6] = controls[k, 1:7]
    mujoco.mj_kinematics(compiled, data)
    palm_turn = data.xmat[1].reshape(3, 3)
    np.testing.assert_allclose(pose.rotation(**angles).as_matrix(), palm_turn, atol=1e-6)  # float32


def test_angles_of_the_arm_turn_the_palm_as_the_words_say():
    for name, way in {"roll": (0, 1), "pitch": (1, 0)}.items():
        alone = {a: 30.0 * (a == name) for a in pose.ANGLES}
        down = pose.rotation(**alone).apply([0, 0, -1])
        np.testing.assert_allclose(down[:2], 0.5 * np.array(way), atol=1e-12)
    turned = pose.rotation(roll=0.0, yaw=30.0, pitch=0.0).apply([1, 0, 0])
    assert turned[1] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["box", "a/b: c"], ["box", "a_b_c"]),
        (["scan_of_a_ball_" * 20] * 2, [("scan_of_a_ball_" * 20)[:79] + f"_{i}" for i in (0, 1)]),
        (["日本語の" * 30], [("日本語の" * 30)[:26]]),
        (["Ball", "ball"], ["Ball_0", "ball_1"]),
        (["", "***"], ["object_0", "object_1"]),
        (["trial_000_box"], ["object_trial_000_box"]),
        (["u\u0308", "ü"], ["ü_0", "ü_1"]),
    ],
)
def test_files_have_names_that_a_disk_takes(names, expected):
    assert tables.names_of(names) == expected


def test_the_room_behind_a_tilted_palm(page):
    """By hand: a palm pitched by 60 degrees, its rim 10 mm above the table."""
    the_scene, params, _, _ = page
    height = 1e3 * the_scene.hand.palm.radius * np.sin(np.radians(60)) + 10
    reference = np.min(arm.key_poses(the_scene, params)[:, 3])
    lifted = np.array(params.arm, float)
    lifted[2] += 1e-3 * (height - reference)
    lifted[3:] = np.radians([0.0, 60.0, 0.0])
    tilted = params._replace(arm=lifted)
    lowest = np.min(arm.key_poses(the_scene, tilted)[:, 3])
    assert lowest == pytest.approx(height, abs=1e-3)
    assert quantities.rim_clearance(the_scene, tilted)[0] == pytest.approx(10, abs=1e-3)
    length = arm.spacer(the_scene, tilted)
    thick = 1e3 * the_scene.hand.palm.thickness
    reached = height + 0.5 * (thick + length) - arm.LAST_LINK * np.sin(np.radians(60))
    assert length > 0 and reached == pytest.approx(arm.CLEARANCE, abs=1e-3)
    level = params._replace(arm=np.array([0, 0, 0.1, 0, 0, 0], float))
    assert arm.spacer(the_scene, level) == 0
    over = params._replace(arm=np.array([0, 0, 0.1, 0, np.radians(120), 0], float))
    assert arm.spacer(the_scene, over) is None


def test_the_table_of_valves_is_what_the_control_commands(tmp_path):
    """Held values jump; between the rows the pressure is linear."""
    (tmp_path / "held.toml").write_text(
        'name = "held"\ndescription = "steps"\nframe = [\n{ time = 0, pressure = "0.2 * pressure", '
        'interpolation = "held" },\n{ time = "approach", pressure = "pressure" },\n'
        '{ time = "lift", pressure = 0 },\n]\n'
    )
    overrides = {"control": str(tmp_path / "held.toml"), "phases.settle": 0.5}
    the_scene = scene.load("paper_spheres", overrides=overrides)
    space = parameters.design_space(the_scene.hand, "2d")
    params = jax.tree.map(np.asarray, space.params(space.default()))
    rows = np.loadtxt(valves.write(tmp_path, the_scene, params), delimiter=",", skiprows=1)
    assert rows[:, 0].tolist() == [0.5, 2.5, 2.5, 5.0] and rows.shape[1] == 5
    nominal = jax.tree.map(np.asarray, rollout.nominal_trial(the_scene))
    commanded = 1e-3 * np.asarray(jax.jit(control.plan)(the_scene, params, nominal).pressure)
    times = np.arange(len(commanded)) * the_scene.discretization.timestep
    sent = np.stack([np.interp(times, rows[:, 0], column) for column in rows.T[1:]], axis=1)
    # The time of a jump is a step's beginning, whose rounding belongs to either side.
    steady = np.abs(times - 2.5) > 1e-6
    np.testing.assert_allclose(sent[steady], commanded[steady], atol=1e-3)


def test_command_writes_models_of_the_default_scene_s_kind(tmp_path, capsys):
    """Hull, effects that plain MuJoCo does not have, and a mesh: models without them, and notes."""
    out = tmp_path / "out"
    settings = [
        "effects.surface=hull",
        "effects.finger_finger=true",
        "effects.friction_memory=true",
    ]
    mug = 'name = "mug"; type = "mesh"; unit = "mm"; mass = 0.1; friction = 0.8; '
    mesh = object_file(tmp_path, f'{mug}file = "{ROOT / "objects" / "household" / "mug.stl"}"')
    settings += ["effects.neo_hookean=true", "--objects", mesh]
    arguments = ["--scene", TINY, "--out", out, "--no-parts", "--no-sheet", "--set", *settings]
    assert command("export", *arguments) == 0
    output = capsys.readouterr().out
    notes = (out / "model" / "README.txt").read_text()
    for words in ("without effects.neo_hookean", "without effects.friction_memory", "mesh 'mug'"):
        assert f"note: the model {'has the ' * ('mesh' in words)}" in output
        assert words in output and words in notes
    [mug] = scene.load("paper", object_set=mesh).objects.object
    loaded = mujoco.MjModel.from_xml_path(str(out / "model" / "mug.xml"))
    data = mujoco.MjData(loaded)
    mujoco.mj_resetDataKeyframe(loaded, data, 0)
    mujoco.mj_kinematics(loaded, data)
    # The file's vertices stand in the world where the mesh's do, in the orientation of the start.
    turn = data.body("object").xmat.reshape(3, 3)
    place = data.body("object").xpos
    geom = data.geom("object_0")
    vertices = loaded.mesh_vert @ geom.xmat.reshape(3, 3).T + geom.xpos
    np.testing.assert_allclose(vertices, mug.mesh.vertices @ turn.T + place, atol=1e-7)  # float32
