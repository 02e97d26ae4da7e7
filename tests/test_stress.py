"""A design under other conditions, and what is amiss with the design itself."""

import io

import jax
import numpy as np
import pytest
from rich.console import Console
from scipy import integrate, optimize

from codesign_jax import constants, model, runs, scene
from codesign_jax.commands import reference
from codesign_jax.model import overlap
from codesign_jax.report import stress
from codesign_jax.scene import beams, parameters
from tests.helpers.command_runs import command, finished_run, own_workplace  # noqa: F401

PAPER = scene.load("paper")
SPACE = parameters.design_space(PAPER.hand, "full")
HAND = jax.tree.map(np.asarray, SPACE.params(SPACE.default()))


def test_conditions_are_numbers_within_the_files_ranges():
    """Masses are four and ten times as large, at most 500 g; what is not named stays."""
    found = [*stress.variants(PAPER)]
    names = [name for name, _ in found]
    assert names[:3] == ["objects of 200 g", "objects of 500 g", "friction 0.4 on the hand"]
    assert len(names) == 3 + stress.DRAWS and len({*names[3:]}) == 1
    for _, other in found:
        constants.check(other)
        assert other.phases == PAPER.phases and other.hand.palm == PAPER.hand.palm
    assert [o.mass for o in found[1][1].objects.object] == [0.5] * 3
    ratio = [c.contact.normal_stiffness / PAPER.contact.normal_stiffness for _, c in found[3:]]
    low, high = stress.FACTORS["contact", "normal_stiffness"]
    assert len({*ratio}) == len(ratio) and low <= min(ratio) and max(ratio) <= high
    masses = {f"objects.object.{o.name}.mass": 0.18 for o in PAPER.objects.object}
    heavy = scene.load("paper", overrides=masses | {"objects.object.sphere.mass": 0.7})
    [(name, numbers), (after, _), *_] = stress.variants(heavy)
    assert (name, after) == ("objects of 500 to 700 g", "friction 0.4 on the hand")
    assert [o.mass for o in numbers.objects.object] == [0.5, 0.5, 0.7]


def placed():
    """Poses (state, body, 3), all turned alike: fingers a metre apart, links in a row."""
    lay = model.layout(PAPER)
    place = np.zeros((1, len(lay.centre_weights), 3))
    for f, bodies in enumerate(lay.bodies):
        segment = HAND.length[f] / lay.links
        place[0, bodies] = np.c_[segment * np.arange(lay.links), np.full((lay.links, 2), f + 1.0)]
    return lay, place, np.broadcast_to(np.eye(3), (*place.shape[:2], 3, 3))


def test_overlaps_are_depths_of_sections():
    """A bottom face that is d below another section's top is d deep, in itself and in others."""
    lay, place, turn = placed()
    alone = overlap.overlaps(PAPER, HAND, place, turn)
    assert not alone.fingers.any() and not alone.palm.any()
    depth, height = 0.004, float(HAND.height[0])
    place[0, lay.bodies[1]] = place[0, lay.bodies[0]] + [0, 0, height - depth]
    found = overlap.overlaps(PAPER, HAND, place, turn).fingers[0]
    # To first order: the rounded outline is 1 % nearer beside the middle.
    assert found[1, 0] == pytest.approx(depth, rel=0.02) == found[0, 1]
    found[1, 0] = found[0, 1] = 0
    assert not found.any()
    lay, place, turn = placed()
    place[0, lay.bodies[2][7]] = place[0, lay.bodies[2][1]] + [0, 0, height - depth]
    place[0, lay.bodies[3][5]] = [0, 0, PAPER.hand.palm.thickness - depth]
    found = overlap.overlaps(PAPER, HAND, place, turn)
    assert found.fingers[0, 2, 2] == pytest.approx(depth, rel=0.02)
    assert found.palm[0] == pytest.approx([0, 0, 0, depth])
    words = stress.of_overlaps(PAPER, HAND, [found])
    assert words[0].startswith("finger 2 stands 4 mm deep in itself")
    assert words[1] == "finger 3 stands 4 mm deep in the palm" and len(words) == 2


def test_strain_is_curvature_times_height():
    bends = np.full((1, 1, 4, 10), np.radians(40.0))  # 400 degrees each
    strain = overlap.wall_strain(PAPER, HAND, bends)
    np.testing.assert_allclose(strain[0, 0, 0], np.radians(400) / HAND.length[0] * HAND.height[0])
    words = stress.of_bends(strain, bends)
    assert len(words) == 8 and words[0].startswith(
        f"finger 0: its walls stretch by {100 * strain.max():.0f} %"
    )
    assert words[4] == "finger 0 bends by 400° in grasps, more than a turn"
    assert stress.of_bends(strain[:0], bends[:0]) == [] == stress.of_overlaps(PAPER, HAND, [])


@pytest.mark.parametrize("neo_hookean", [False, True])
def test_the_strain_s_pressure_is_that_of_the_wall_s_stress(neo_hookean):
    """By SciPy: the curvature at which the integral of the stress over the section balances
    the pressure's moment; 4 G e of the linear law, G (l - l^-3) of the neo-Hookean one."""
    height, wall, width, modulus, strain = 0.02, 0.004, 0.024, 35e3, 1.3
    how = {"width": width, "shear_modulus": modulus, "neo_hookean": neo_hookean}
    pressure = beams.strain_pressure(strain, np.array(height), np.array(wall), **how)

    def stress_at(e):
        return modulus * (1 + e - (1 + e) ** -3) if neo_hookean else 4 * modulus * e

    def moment(curvature):
        def block(breadth, low, high):
            return breadth * integrate.quad(lambda y: stress_at(curvature * y) * y, low, high)[0]

        return block(width, 0, height) - block(width - 2 * wall, wall, height - wall)

    chamber = (width - 2 * wall) * (height - 2 * wall) * height / 2
    curvature = optimize.brentq(lambda k: moment(k) - pressure * chamber, 1.0, 500.0)
    assert curvature * height == pytest.approx(strain, rel=1e-6)


@pytest.mark.parametrize("law", ["false", "true"])
def test_no_design_of_a_space_is_beyond_the_strain(law):
    """Those that are drawn and projected; pressures alone change. Without the limit Table I allows
    more."""
    limited = scene.load(
        "paper", overrides={"limits.strain": 1.0, "effects.neo_hookean": law == "true"}
    )
    space = parameters.design_space(limited.hand, "full")
    drawn = {s: np.asarray(s.sample(jax.random.key(1), 200)) for s in (space, SPACE)}

    def highest(designs):
        """Largest pressure of each design over that of the strain."""
        own = parameters.params_of(SPACE, designs)
        how = {
            "width": PAPER.hand.section.width,
            "shear_modulus": PAPER.hand.material.shear_modulus,
        }
        caps = beams.strain_pressure(1.0, own.height, own.wall, neo_hookean=law == "true", **how)
        return np.asarray(own.pressure / caps).max(1)

    before, after = highest(drawn[SPACE]), highest(drawn[space])
    assert before.max() > 1.2 and after.max() <= 1 and (after[before > 1] > 0.999).all()
    same = [k for k, name in enumerate(space.names) if not name.startswith("pressure")]
    np.testing.assert_array_equal(drawn[space][:, same], drawn[SPACE][:, same])
    with pytest.warns(UserWarning, match="pressure above the limit"):
        space.check(drawn[SPACE])


def test_stress_is_told_kept_and_reported(finished, capsys):
    """Kept grasps of each condition are those of `codesign evaluate` with its numbers."""
    settings = runs.read_run(finished)[1]
    assert reference.stored_stress(finished, settings) is None
    text = io.StringIO()
    reference.stress_run(finished, settings, Console(file=text, width=100))
    found = reference.stored_stress(finished, settings)
    assert [*dict.fromkeys(found.conditions)][-1] == "neo-Hookean bending law"
    assert "under other conditions, 12 grasps each" in text.getvalue()
    for line in found.lines():
        assert line.strip() in text.getvalue()
    (finished / "report.html").unlink(missing_ok=True)
    assert command("report", finished, "--no-replay") == 0
    page = (finished / "report.html").read_text(encoding="utf-8")
    assert "Under other conditions, 12 grasps each" in page and "neo-Hookean bending law" in page
    other = settings.__class__(**{**vars(settings), "seed": settings.seed + 1})
    assert reference.stored_stress(finished, other) is None
