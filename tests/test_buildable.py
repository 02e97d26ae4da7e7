"""What can be built as a constraint of a search: closed forms, every optimiser, each limit off."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import codesign, optimize, scene
from codesign_jax.judge import stress
from codesign_jax.model import morphology
from codesign_jax.scene import buildable, parameters, silicones
from tests.helpers import grasps
from tests.helpers.refusals import refusal

PAPER = scene.load("paper")
SPACE = parameters.design_space(PAPER.hand, "23d")
TABLE = parameters.design_space(PAPER.hand, "paper-23d")
UNLIMITED = {
    "strain": 10.0,
    "free_bend": 36000.0,
    "pressure_margin": 0.0,
    "finger_length": [0.01, 0.18],
    "finger_slenderness": 0.0,
    "arm_tilt": 180.0,
    "palm_clearance": -1.0,
    "wrist_force": 1e6,
}
"""Every limit at its open end."""


def limited(**limits):
    """The scene and its space with these limits and no other one."""
    overrides = {f"limits.{name}": value for name, value in {**UNLIMITED, **limits}.items()}
    made = scene.load("paper", overrides=overrides)
    return made, parameters.design_space(made.hand, "23d")


def drawn(space, count=200):
    return np.asarray(space.sample(jax.random.key(3), count))


@functools.partial(jax.jit, static_argnums=0)
def projection(space, designs):
    """One program a space; a function that is jitted anew is compiled anew."""
    return jax.vmap(space.project)(designs)


def projected(space, designs):
    return np.asarray(projection(space, designs))


share = jax.jit(buildable.on_lines, static_argnums=2)


def each_params(space, designs):
    every = jax.tree.map(np.asarray, parameters.params_of(space, designs))
    return [jax.tree.map(lambda v, i=i: v[i], every) for i in range(len(designs))]


def all_fingers(space, designs):
    """Parameters of the fingers of all designs, one behind the other as of a single hand."""
    params = parameters.params_of(space, designs)
    rows = {n: getattr(params, n) for n in ("length", "height", "wall", "pressure", "tip")}
    return params._replace(**jax.tree.map(np.ravel, rows))


def by_design(values, designs):
    """Values of `all_fingers`, shape (design, finger)."""
    return values.reshape(len(designs), -1)


def columns(name):
    return [k for k, parameter in enumerate(SPACE.names) if parameter.split("[")[0] == name]


def test_no_proposal_has_a_warning_and_the_paper_s_space_has_table_i_alone():
    designs = drawn(SPACE)
    for params in each_params(SPACE, designs):
        assert stress.of_design(PAPER, params) == []
    np.testing.assert_array_equal(projected(SPACE, designs), designs)
    assert TABLE.names == SPACE.names and TABLE.bounds == SPACE.bounds
    assert TABLE.buildable is None is parameters.design_space(PAPER.hand, "2d").buildable
    of_table = drawn(TABLE)
    warned = [bool(stress.of_design(PAPER, p)) for p in each_params(TABLE, of_table)]
    assert 0.2 < np.mean(warned)
    # Table I's own scene has no limits to keep.
    spheres = scene.load("paper_spheres")
    assert parameters.design_space(spheres.hand).buildable is None


# The limits of `build` take 13 s to compile; quick: those of a section by elements, below.
@pytest.mark.parametrize(
    "name", ["bin", *(pytest.param(n, marks=pytest.mark.slow) for n in ("build", "edge", "shelf"))]
)
def test_no_proposal_of_another_scene_has_a_warning_of_a_finger(name):
    """The palm of `shelf` is upright and that of `edge` tilted: they have no limit there."""
    made = scene.load(name)
    space = parameters.design_space(made.hand, "full")
    designs = drawn(space, 60)
    warned = [w for p in each_params(space, designs) for w in stress.of_design(made, p)]
    assert not [w for w in warned if name in ("bin", "build") or w.startswith("finger")]


def bent_at_most(overrides):
    """Designs as drawn and with a free bend of at most 90 degrees, and which pressures are lower.

    Returns:
      The scene, its design space, both designs, shape (design, parameter), and for each finger
      whether its pressure was lowered, shape (design, finger).
    """
    limits = {f"limits.{n}": v for n, v in {**UNLIMITED, "free_bend": 90.0}.items()}
    made = scene.load("paper", overrides=limits | overrides)
    space = parameters.design_space(made.hand, "23d")
    designs = drawn(TABLE, 60)
    legal = projected(space, designs)
    pressures = columns("pressure")
    lowered = legal[:, pressures] < designs[:, pressures] * (1 - 1e-5)
    return made, space, designs, legal, lowered


@pytest.mark.parametrize("law", silicones.LAWS)
def test_a_lowered_pressure_bends_the_free_finger_by_the_limit(law):
    """By `free_bends`, which halves intervals where the projection inverts in closed form."""
    material = {"hand.material.law": law, "hand.material.shear_modulus": 40e3}
    made, space, designs, legal, lowered = bent_at_most(material)
    fingers = all_fingers(space, legal)
    bends = morphology.free_bends(made.hand, fingers, neo_hookean=silicones.of_law(law))
    bends = by_design(np.degrees(bends), designs)
    # Pressures are rounded to float32, and stay below the limit by 1e-6 of it.
    np.testing.assert_allclose(bends[lowered], 90, rtol=2e-5)
    assert lowered.mean() > 0.3 and (bends <= 90 * (1 + 1e-6)).all()
    others = np.setdiff1d(np.arange(len(space.names)), columns("pressure"))
    np.testing.assert_array_equal(legal[:, others], designs[:, others])


def test_a_section_by_elements_bends_by_the_limit_and_does_not_twist_by_itself():
    """By `free_bends`, which halves intervals of the bend and not of the pressure."""
    law = {"hand.section.law": "elements", "hand.section.winding": "single"}
    made, space, designs, legal, lowered = bent_at_most(law)
    before, after = (all_fingers(space, each) for each in (designs, legal))
    bends = by_design(np.degrees(morphology.free_bends(made.hand, after)), designs)
    assert not morphology.twists_by_itself(made.hand, after).any()
    straight = by_design(morphology.twists_by_itself(made.hand, before), designs)
    # A pressure of single precision bends a thin finger by some 1e-5 more or less.
    assert lowered.mean() > 0.5 and (bends <= 90 * (1 + 1e-4)).all()
    by_bend = lowered & ~straight
    np.testing.assert_allclose(bends[by_bend], 90, rtol=2e-4)
    assert straight.any()


def test_a_lowered_pressure_strains_the_wall_by_the_limit_less_the_margin():
    """Strain is curvature times height; half the margin's pressure is half the limit's."""
    _, space = limited(strain=0.5)
    designs = drawn(TABLE, 60)
    legal = projected(space, designs)
    pressures = columns("pressure")
    lowered = legal[:, pressures] < designs[:, pressures] * (1 - 1e-5)
    fingers = all_fingers(space, legal)
    bends = morphology.free_bends(PAPER.hand, fingers, neo_hookean=True)
    strains = by_design(bends / fingers.length * fingers.height, designs)
    np.testing.assert_allclose(strains[lowered], 0.5, rtol=2e-5)
    _, half = limited(strain=0.5, pressure_margin=0.5)
    lower = projected(half, designs)[:, pressures]
    np.testing.assert_allclose(lower[lowered], 0.5 * legal[:, pressures][lowered], rtol=1e-6)


def test_no_tapered_finger_bends_by_more_than_the_limit():
    limits = {f"limits.{n}": v for n, v in {**UNLIMITED, "free_bend": 60.0}.items()}
    made = scene.load("paper", hand_name="tapered4", overrides=limits)
    space = parameters.design_space(made.hand, "full")
    fingers = all_fingers(space, drawn(space, 40))
    bends = np.degrees(morphology.free_bends(made.hand, fingers, neo_hookean=True))
    assert 45 < bends.max() <= 60 * (1 + 1e-5)


def test_lengths_angles_and_height_are_clipped():
    """By trigonometry: the rim of a palm that is pitched alone is radius * sin(pitch) lower."""
    _, space = limited(finger_length=[0.03, 0.1], finger_slenderness=2.5)
    legal = projected(space, drawn(TABLE))
    lengths = legal[:, columns("length")]
    least = np.maximum(0.03, 2.5 * legal[:, columns("height")])
    assert (lengths >= least * (1 - 1e-6)).all() and (lengths <= 0.1 * (1 + 1e-6)).all()
    assert lengths.max() > 0.099
    _, space = limited(arm_tilt=15.0)
    tilts = np.degrees(
        projected(space, drawn(TABLE))[:, columns("arm_roll") + columns("arm_pitch")]
    )
    assert np.abs(tilts).max() == pytest.approx(15, rel=1e-5)
    design = SPACE.default()
    design[columns("arm_z")] = -0.05
    pitch = np.radians(12.0)
    design[columns("arm_pitch")] = pitch
    made, space = limited(palm_clearance=0.01)
    [raised] = projected(space, design[None])[:, columns("arm_z")[0]]
    rim = made.hand.palm.radius * np.sin(pitch)
    assert made.arm.zero_height + raised == pytest.approx(0.01 + rim, rel=1e-4)
    # The cylinder, 72 mm high, is the tallest object.
    made, space = limited(wrist_force=2.0)
    [raised] = projected(space, design[None])[:, columns("arm_z")[0]]
    pushed = 0.072 - (made.arm.zero_height + raised)
    assert made.hand.wrist.linear_stiffness * pushed == pytest.approx(2.0, rel=1e-4)


@pytest.mark.parametrize("name", UNLIMITED)
def test_each_limit_is_closed_on_its_own(name):
    """With one at its open end something is drawn that the scene's limits would change."""
    open_scene = scene.load("paper", overrides={f"limits.{name}": UNLIMITED[name]})
    designs = drawn(parameters.design_space(open_scene.hand, "23d"), 2000)
    changed = (projected(SPACE, designs) != designs).any(0)
    parameters_changed = {SPACE.names[k].split("[")[0] for k in np.flatnonzero(changed)}
    expected = {"finger_length": "length", "finger_slenderness": "length"}
    expected |= {"wrist_force": "arm_z", "arm_tilt": "arm_roll"}
    expected |= dict.fromkeys(("strain", "free_bend", "pressure_margin"), "pressure")
    if name == "palm_clearance":  # the wrist's force holds the palm higher than 5 mm
        assert not parameters_changed
        _, clear = limited(palm_clearance=0.005)
        _, unlimited = limited()
        rows = drawn(unlimited)
        assert (projected(clear, rows) != rows).any(0)[columns("arm_z")].all()
    else:
        assert expected[name] in parameters_changed


def test_the_projection_s_gradient_is_finite():
    """Also of a level palm, whose rim has a kink, and at every limit."""
    gradient = jax.jit(jax.vmap(jax.jacobian(SPACE.project)))
    designs = np.array(drawn(TABLE, 20))
    designs[0, columns("arm_roll") + columns("arm_pitch")] = 0.0
    inside = SPACE.default()
    inside[columns("pressure")] = 30e3
    inside[columns("arm_pitch")] = 0.1
    slopes = gradient(jnp.asarray([*designs, inside]))
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(slopes[-1], np.eye(23), atol=1e-6)


QUICK = "screened-es", "particle-filter"
"""The default and the paper's; the others project by the same function."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in optimize.NAMES],
)
def test_every_optimiser_proposes_and_recommends_what_can_be_built(name):
    made = codesign.make_optimizer(name, SPACE)
    if hasattr(made, "screening"):
        made = dataclasses.replace(made, screening=1, retests=1)
    count = 12
    mask = np.ones(SPACE.num_parameters, bool)

    @jax.jit
    def begin(key):
        first = optimize.candidates(jax.random.key(1), made.space, np.arange(1))[0]
        return made.init(key, first, count)

    state = begin(jax.random.key(0))
    ask = jax.jit(made.ask)
    tell = jax.jit(made.tell)
    random = np.random.default_rng(0)
    for _ in range(4):
        population = ask(state, mask)
        np.testing.assert_array_equal(projected(SPACE, population), population)
        state, _ = tell(state, population, random.random(count).astype(np.float32), mask)
    for params in each_params(SPACE, np.asarray(state.particles)):
        assert stress.of_design(PAPER, params) == []


@pytest.mark.parametrize(
    ("changes", "code", "keys"),
    [
        ({"finger_length": [0.04]}, "size", ["limits.finger_length"]),
        ({"finger_length": [0.2, 0.1]}, "order", ["limits.finger_length"]),
        ({"finger_length": 0.04}, "type", ["limits.finger_length"]),
        ({"finger_length": [0.2, 0.3]}, "range", [f"length[{i}]" for i in range(4)]),
        ({"free_bend": 6.28}, "range", ["limits.free_bend"]),
        ({"strain": 120}, "range", ["limits.strain"]),
        ({"wrist_force": "soft"}, "type", ["limits.wrist_force"]),
        ({"free_bent": 360}, "unknown", ["limits.free_bent"]),
    ],
)
def test_bad_limits_are_refused(changes, code, keys):
    limits = {f"limits.{name}": value for name, value in changes.items()}

    def space():
        return parameters.design_space(scene.load("paper", overrides=limits).hand)

    assert refusal(space) == [(code, key) for key in keys]


# --- pressure lines ------------------------------------------------------------------------------


def with_valves(**valves):
    overrides = {f"hand.valves.{name}": value for name, value in valves.items()}
    made = scene.load("paper", overrides=overrides)
    return made, parameters.design_space(made.hand, "23d")


@pytest.mark.parametrize(
    ("pressures", "highest", "lines", "expected"),
    [
        ([10, 90, 20, 80], [100] * 4, 2, [15, 85, 15, 85]),
        ([10, 90, 20, 80], [100] * 4, 3, [10, 85, 20, 85]),  # as near as [15, 90, 15, 80]
        ([10, 90, 20, 80], [100, 90, 18, 82], 1, [18] * 4),
        ([10, 90, 20, 80], [100, 90, 20, 82], 2, [15, 82, 15, 82]),
        ([50, 50, 50, 50], [50.0] * 4, 2, [50] * 4),
        ([30, 10, 10, 30], [40.0] * 4, 3, [30, 10, 10, 30]),
    ],
)
def test_fingers_share_the_nearest_pressures(pressures, highest, lines, expected):
    allowed = share(np.array(pressures, float), np.array(highest, float), lines)
    np.testing.assert_allclose(allowed, expected, rtol=1e-6)


def test_fingers_of_lines_are_those_of_the_nearest_groups():
    """Against all ways to put five fingers on lines, where no limit interferes."""
    random = np.random.default_rng(1)
    for lines in (2, 3):
        for pressures in random.random((20, 5)):
            allowed = np.asarray(share(pressures, np.ones(5), lines))
            least = np.inf
            for line in itertools.product(range(lines), repeat=5):
                means = [pressures[np.equal(line, k)].mean() for k in line]
                least = min(least, np.square(pressures - means).sum())
            assert len(np.unique(allowed)) == lines
            assert np.square(allowed - pressures).sum() == pytest.approx(least, rel=1e-4)


def test_searched_lines_limit_the_pressures_of_each_proposal():
    for lines in (2, 3):
        made, space = with_valves(lines=lines)
        designs = drawn(space)
        pressures = designs[:, columns("pressure")]
        assert {len(np.unique(row)) for row in pressures} <= {*range(1, lines + 1)}
        # Two programs round the highest pressure of a line in the last bit of float32.
        np.testing.assert_allclose(projected(space, designs), designs, rtol=2e-7)
        for params in each_params(space, designs[:40]):
            assert stress.of_design(made, params) == []
        # Every pair of fingers shares a line in some design.
        for i, j in itertools.combinations(range(4), 2):
            assert (pressures[:, i] == pressures[:, j]).any()
    with pytest.warns(UserWarning, match="1 of 1 designs with more pressures than the hand's 3"):
        space.check(np.where(np.arange(23) == columns("pressure")[0], 7e3, drawn(SPACE, 1)))


def test_fingers_of_one_line_get_the_same_pressure_course():
    made, space = with_valves(groups=[[0, 1], [2, 3]])
    assert [n for n in space.names if "pressure" in n] == ["pressure[0+1]", "pressure[2+3]"]
    [params] = each_params(space, space.default()[None])
    params = params._replace(pressure=np.array([9e4, 9e4, 7e4, 7e4], np.float32))
    course = np.asarray(grasps.world_inputs(made, params, grasps.still())[1])[:, -4:]
    np.testing.assert_array_equal(course[:, 0], course[:, 1])
    np.testing.assert_array_equal(course[:, 2], course[:, 3])
    assert course[:, 0].max() == pytest.approx(9e4) and course[:, 2].max() == pytest.approx(7e4)
    # One line is a group of all fingers, as a preset with `tied = true` has it.
    single = with_valves(lines=1)[1]
    assert single.num_parameters == 20 and "pressure" in single.names
    np.testing.assert_array_equal(drawn(single), drawn(with_valves(groups=[[0, 1, 2, 3]])[1]))
    # As many lines as fingers are those of a hand without the table, and no line is simulated.
    four = with_valves(lines=4)
    np.testing.assert_array_equal(drawn(four[1]), drawn(SPACE))
    assert four[0].structure == made.structure == PAPER.structure


@pytest.mark.parametrize(
    ("hand", "changes", "code", "key"),
    [
        ("pneuflex4", {"lines": 5}, "conflict", "hand.valves.lines"),
        ("pneuflex4", {"lines": 0}, "range", "hand.valves.lines"),
        ("pneuflex4", {"lines": 2, "groups": [[0, 1]]}, "conflict", "hand.valves"),
        ("pneuflex4", {"groups": [[0, 7]]}, "size", "hand.valves.groups"),
        ("pneuflex4", {"groups": [[0, 1], [1, 2]]}, "size", "hand.valves.groups"),
        ("pneuflex4", {"groups": [[0]]}, "size", "hand.valves.groups"),
        ("pneuflex4", {"line": 2}, "unknown", "hand.valves.line"),
        ("thumb4", {"groups": [[2, 3]]}, "conflict", ""),
        ("two_stage", {"groups": [[1, 2]]}, "conflict", "control.frame[2].pressure"),
        ("two_stage", {"lines": 2}, "conflict", "control.frame[2].pressure"),
    ],
)
def test_bad_lines_are_refused(hand, changes, code, key):
    overrides = {f"hand.valves.{name}": value for name, value in changes.items()}
    if hand == "two_stage":
        overrides["control"] = hand
        hand = "pneuflex4"

    def space():
        loaded = scene.load("paper", hand_name=hand, overrides=overrides)
        return parameters.design_space(loaded.hand, "2d")

    assert refusal(space) == [(code, key)]
