"""Scene, hand and object files: every problem is found, said once, and said helpfully."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import model, scene
from codesign_jax.commands import common, flags
from codesign_jax.engines import make_engine
from codesign_jax.scene import (
    constants,
    hand,
    key_frames,
    keypaths,
    library,
    objects,
    parameters,
    schema,
    silicones,
)
from codesign_jax.scene.scene_files import write_scene
from tests.helpers.grasps import batch_inputs, nth, repeat, stack, still
from tests.helpers.refusals import refusal

NAMES = silicones.SILICONES
HANDS = sorted(library.available("hands"))
OBJECTS = sorted(library.available("objects"))


def text_of(kind, name):
    return library.available(kind)[name].read_text()


def problems_of(loader, path):
    with pytest.raises(schema.InputError) as caught:
        loader(path)
    assert str(caught.value).splitlines() == caught.value.problems
    return caught.value.problems


def edited(tmp_path, kind, name, *edits):
    """Copy of a built-in file with (old, new) replacements, each of which must apply."""
    text = text_of(kind, name)
    for old, new in edits:
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / f"{kind}.toml"
    path.write_text(text)
    return path


def hand_problems(tmp_path, *edits):
    return problems_of(hand.load, edited(tmp_path, "hands", "pneuflex4", *edits))


BY_PATH = {
    "discretization.links=5": lambda s: s.discretization.links == 5,
    "hand=tripod3": lambda s: s.hand.name == "tripod3",
    "hand.material={law='linear', shear_modulus=60e3, density=1.0e3, damping_time=0.0}": lambda s: (
        s.hand.material.shear_modulus == 60e3
    ),
    "hand.material=ecoflex_00_30": lambda s: (
        s.effects.neo_hookean and s.hand.material.shear_modulus == 27.6e3
    ),
    "hand.material={silicone='dragon_skin_30', density=1100.0}": lambda s: (
        s.hand.material.silicone == "dragon_skin_30" and s.hand.material.density == 1100.0
    ),
    "hand.preset.2d.fixed.pressure=110": lambda s: s.hand.preset[0].fixed["pressure"] == 110,
    "hand.parameter.length.default=[110, 110, 60, 90]": lambda s: (
        s.hand.parameter[0].default == (110.0, 110.0, 60.0, 90.0)
    ),
    "hand.preset.2d.free.arm_z.high=150": lambda s: s.hand.preset[0].free[1].high == 150.0,
    "objects.object.sphere.mass=0.2": lambda s: s.objects.object[2].mass == 0.2,
    "objects.object.mass=0.2": lambda s: [o.mass for o in s.objects.object] == [0.2] * 3,
    "hand.finger.tilt=50": lambda s: [f.tilt for f in s.hand.finger] == [50.0] * 4,
}


OF_LIBRARIES = [
    ("gravity", np.float32(3.75), 3.75),
    ("gravity", jnp.bfloat16(3.5), 3.5),
    ("gravity", np.array(4), 4.0),
    ("discretization.links", np.int64(5), 5),
    ("discretization.links", jnp.int32(5), 5),
    ("effects.wrist", np.bool_(False), False),
    ("hand.finger.0.base", np.array([0.03, 0.02]), (0.03, 0.02)),
    ("hand.finger.0.base", (np.float16(0.25 / 8), 0), (0.03125, 0.0)),
    ("control", library.available("controls")["slide"], "slide"),
    ("control.frame.2.pressure", jnp.array([1e4, 0, 0, 0]), (1e4, 0.0, 0.0, 0.0)),
]
"""A key, a value as Python programs have it, and what it is in a scene."""


@pytest.mark.parametrize("key, value, expected", OF_LIBRARIES)
def test_numbers_arrays_and_paths_of_libraries_are_taken(key, value, expected):
    loaded = scene.load("paper", overrides={key: value})
    for part in keypaths.flatten({key: 0}).popitem()[0]:
        loaded = loaded[int(part)] if part.isdecimal() else getattr(loaded, part)
    if isinstance(loaded, key_frames.Control):
        loaded = loaded.name
    if isinstance(loaded, tuple):
        loaded = tuple(getattr(v, "number", v) for v in loaded)
    assert loaded == expected
    assert [type(v) for v in np.atleast_1d(expected)] == [type(v) for v in np.atleast_1d(loaded)]


OF_NO_FILE = [
    (("type", "gravity"), {"gravity": np.array([3.7, 1])}),
    (("type", "gravity"), {"gravity": np.str_("3")}),
    (("range", "gravity"), {"gravity": np.float32("nan")}),
    (("type", "discretization.links"), {"discretization": {"links": np.float64(5)}}),
    (("type", "gravity"), {"gravity": np.complex64(1)}),
]


@pytest.mark.parametrize(("kind", "changes"), OF_NO_FILE)
def test_what_a_file_could_not_have_is_refused_by_its_value(kind, changes):
    assert refusal(scene.load, "paper", overrides=changes) == [kind]


def test_a_traced_override_is_refused_with_what_takes_it():
    def weigh(gravity):
        return scene.load("paper", overrides={"gravity": gravity}).gravity

    assert refusal(jax.eval_shape, weigh, 1.0) == [("type", "gravity")]


@pytest.mark.parametrize("pair", BY_PATH)
def test_a_key_path_changes_its_value_and_the_resolved_scene_has_it(pair, tmp_path):
    changed = scene.load("paper", overrides=keypaths.parse([pair]))
    assert BY_PATH[pair](changed) and changed != scene.load("paper")
    write_scene(changed, tmp_path)
    assert scene.load(tmp_path / "scene.toml") == changed


def test_key_paths_may_be_nested_or_dotted_and_the_last_of_a_key_holds():
    nested = {"hand": {"wrist": {"linear_stiffness": 60}}, "solver.iterations": 7}
    pairs = ["solver.iterations=9", "hand.wrist={linear_stiffness=60}", "solver.iterations=7"]
    nested_scene = scene.load(overrides=nested)
    assert nested_scene.solver.iterations == 7 and nested_scene.hand.wrist.linear_stiffness == 60.0
    assert scene.load(overrides=keypaths.parse(pairs)) == nested_scene


# Key paths, and what is said of each.
WRONG_PATHS = {
    "objects.noise.size=2": ("range", "objects.noise.size"),
    "gravty=3": ("unknown", "gravty"),
    "hand.section.width=18": ("range", "hand.section.width"),
    "objects.object.mas=1": ("unknown", "objects.object"),
    "objects.object.mass=99": ("range", "objects.object[2].mass"),
    "objects.object.spher.mass=1": ("unknown", "objects.object"),
    "discretization.links=10.0": ("type", "discretization.links"),
    "cost.maximum=2000": ("range", "cost.maximum"),
    "hand.material=dragonskin": ("unknown", "hand.material.silicone"),
    "hand.material=5": ("type", "hand.material"),
    "hand.material.silicone=[1]": ("unknown", "hand.material.silicone"),
    "hand.material.law=mooney_rivlin": ("unknown", "hand.material.law"),
}


# Changes of material and effects, and what law and modulus [kPa] they give, or what is said.
GIVEN = "hand.material=dragon_skin_10"
LAWS = {
    (GIVEN,): (True, 88.0),
    (GIVEN, "effects.neo_hookean=true"): (True, 88.0),
    (GIVEN, "hand.material.damping_time=0.005"): (True, 88.0),
    (GIVEN, "hand.material.law=linear", "hand.material.shear_modulus=50e3"): (False, 50.0),
    ("hand.material.law=neo_hookean", "hand.material.shear_modulus=70e3"): (True, 70.0),
    (GIVEN, "effects.neo_hookean=false"): "effects.neo_hookean",
    (GIVEN, "hand.material.shear_modulus=60e3"): "hand.material.shear_modulus",
    (GIVEN, "hand.material.law=linear"): "hand.material.law",
    (
        "hand.material.law=linear",
        "hand.material.shear_modulus=50e3",
        "effects.neo_hookean=true",
    ): "effects.neo_hookean",
}


@pytest.mark.parametrize("pairs", LAWS)
def test_a_modulus_comes_with_its_law(pairs):
    def load(name):
        return scene.load(name, overrides=keypaths.parse(pairs))

    if isinstance(LAWS[pairs], str):
        assert refusal(load, "paper") == [("conflict", LAWS[pairs])]
        return
    loaded = load("paper")
    material = loaded.hand.material
    assert (loaded.effects.neo_hookean, material.shear_modulus) == (
        LAWS[pairs][0],
        1e3 * LAWS[pairs][1],
    )
    assert material.lateral_factor == scene.load("paper").hand.material.lateral_factor
    # In Python the law of another hand is not that of the scene's effects.
    law = silicones.LAWS[not loaded.effects.neo_hookean]
    other = dataclasses.replace(material, law=law)
    changed = dataclasses.replace(loaded, hand=dataclasses.replace(loaded.hand, material=other))
    assert refusal(constants.check, changed) == [("conflict", "scene.effects.neo_hookean")]
    # Names of silicones and laws are no part of what is compiled: numbers are data.
    plain = dataclasses.replace(material, law=None, silicone=None, shear_modulus=1e5)
    changed = dataclasses.replace(loaded, hand=dataclasses.replace(loaded.hand, material=plain))
    assert changed.structure == loaded.structure


def test_a_hand_file_names_its_silicone_in_a_line(tmp_path):
    text = text_of("hands", "tripod3")
    start = text.index("[material]")
    end = text.index("[palm]")
    (tmp_path / "mine.toml").write_text('material = "ecoflex_00_50"\n' + text[:start] + text[end:])
    mine = hand.load(tmp_path / "mine.toml").material
    assert mine.law == "neo_hookean" and mine.shear_modulus == silicones.get(mine.silicone)[2]
    assert scene.load("paper", hand_name=tmp_path / "mine.toml").effects.neo_hookean
    material = hand.load(tmp_path / "mine.toml", overrides={"material": "dragon_skin_20"}).material
    assert material.shear_modulus == silicones.get("dragon_skin_20").shear_modulus
    assert refusal(silicones.get, "ecoflex")[0][0] == "unknown"


def test_silicones_lie_within_their_measurements():
    for name, s in silicones.SILICONES.items():
        low, high = s.interval
        assert low <= s.shear_modulus <= high, name
        span = s.damping_interval or (s.damping_time, s.damping_time)
        assert span[0] <= s.damping_time <= span[1]
        # Crosshead strain is too large, so that its modulus is the lowest of all.
        assert s.crosshead_modulus < min(s.shear_modulus, s.sheet_modulus)
        if "geometric" in s.source:
            expected = np.sqrt(s.crosshead_modulus * s.sheet_modulus)
            assert s.shear_modulus == pytest.approx(expected, rel=0.005)  # three digits
            np.testing.assert_allclose(
                s.interval, [s.crosshead_modulus, s.sheet_modulus], rtol=3e-3
            )


@pytest.mark.parametrize(
    "words",
    [["gravity", "=", "3.7"], ["gravity=", "3.7"], ["gravity", "=3.7"], ["gravity=3.7"]],
)
def test_blanks_around_the_sign_of_a_value_are_let_pass(words):
    links = ("discretization", "links")
    values = keypaths.parse([*words, "discretization.links=5"])
    assert values == {("gravity",): 3.7, links: 5}
    assert keypaths.parse(["discretization.links=5", *words]) == values
    design = [w.replace("gravity", "length") for w in words]
    assert common.open_designs(design)[0]["--design"] == ["length=3.7"]


def test_a_rigid_mount_is_the_effect_and_set_holds():
    wrist = ("effects", "wrist")
    assert common.changes(flags.Evaluate(rigid_mount=True)) == {wrist: False}
    compliant = flags.Evaluate(rigid_mount=True, overrides=(("effects.wrist=true",),))
    assert common.changes(compliant) == {wrist: True}


def test_signs_of_an_editor_are_read_in_numbers_and_kept_in_names():
    minus = "\N{MINUS SIGN}"
    dash = "\N{EN DASH}"
    values = keypaths.parse([f"gravity={minus}3.7", f'hand.name="a{dash}b"', f"scene=c{dash}d"])
    assert [*values.values()] == [-3.7, f"a{dash}b", f"c{dash}d"]


@pytest.mark.parametrize(
    "value, unit, low, high, guess",
    [
        (9.5, "mm", 20, 200, "95? (cm given where mm is expected)"),
        (3.5, "m", 0.005, 0.1, "0.035? (cm given where m is expected)"),
        (981, "m/s^2", 0, 100, "9.81? (cm/s^2 given where m/s^2 is expected)"),
        (18.0, "m", 0.005, 0.1, "0.018? (mm given where m is expected)"),
        (18, "mm", 20, 200, None),  # just below the bound, and not 180
        (9.5, "m^2", 20, 200, None),
        (9.5, "kPa", 20, 200, None),
    ],
)
def test_centimetres_are_guessed_where_nothing_nearer_explains_a_length(
    value, unit, low, high, guess
):
    problem = schema.range_problem("size", value, unit, low, high)
    assert problem and (
        problem.endswith(f"did you mean {guess}") if guess else "mean" not in problem
    )


@pytest.mark.parametrize("pair", WRONG_PATHS)
def test_a_wrong_key_path_is_told_by_its_key(pair):
    assert WRONG_PATHS[pair] in refusal(scene.load, "paper", overrides=keypaths.parse([pair]))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        # millimetres for metres
        ("size = [0.030]", "size = [30]", ("range", "objects.toml.object[2].size[0]")),
        ("[table]\nfriction = 0.37", "", ("missing", "objects.toml.table")),
        ("size = [0.030, 0.036]", "size = [0.030]", ("size", "objects.toml.object cylinder")),
        ('name = "sphere"', 'name = "cuboid"', ("conflict", "objects.toml.object cuboid")),
    ],
)
def test_a_wrong_object_file(tmp_path, old, new, expected):
    told = refusal(objects.load, edited(tmp_path, "objects", "paper", (old, new)))
    assert told.count(expected) == 1, told


@pytest.mark.parametrize("bad", ["nan", "inf", "-inf"])
def test_not_finite_values_are_refused(tmp_path, bad):
    edit = "mass = 0.25", f"mass = {bad}"
    told = refusal(hand.load, edited(tmp_path, "hands", "pneuflex4", edit))
    assert told == [("range", "hands.toml.palm.mass")]
    edit = "high = 180\ndefault", f"high = {bad}\ndefault"
    told = refusal(hand.load, edited(tmp_path, "hands", "pneuflex4", edit))
    assert any("length" in key for _, key in told)


def test_phases_out_of_order():
    phases = {"phases": {"inflate": 5.0, "lift": 4.5, "disturb": 8.6}}
    assert refusal(scene.load, "paper", overrides=phases) == [
        ("order", "phases.lift"),
        ("order", "paper.toml.phases.deflate_time"),
    ]


def test_all_problems_of_all_files_at_once(tmp_path):
    hand_path = edited(
        tmp_path, "hands", "pneuflex4", ("width = 0.024", "width = 18"), ("low = 10", "low = 190")
    )
    object_path = edited(
        tmp_path, "objects", "paper", ("mass = 0.05", "mass = -1"), ('type = "box"', 'type = "bx"')
    )
    with pytest.raises(schema.InputError) as caught:
        scene.load(
            "paper",
            hand_name=hand_path,
            object_set=object_path,
            overrides={"solver": {"tolerance": -1.0}, "cost": {"failure": "ignore"}},
        )
    text = "\n".join(caught.value.problems)
    for part in ("width", "mass", "type = 'bx'", "tolerance", "failure"):
        assert part in text
    assert len(caught.value.problems) == 5


BASE = "base = [0.037, 0.015]\n"
LOW = "low = 10\nhigh = 180\ndefault"  # of the length


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("thickness = 0", "thicknes = 0", ("unknown", "palm.thicknes")),
        # What does not fit together
        (LOW, "low = 200\nhigh = 180\ndefault", ("order", "parameter length")),
        ('name = "wall"', 'name = "height"', ("conflict", "parameter 'wall'")),
        (
            "\nwall = 5",
            "\nwall = 2.5",
            ("range", "preset 2d"),
        ),  # 120 kPa exceeds 40 kPa/mm * 2.5 mm
        ("[preset.fixed]", "[preset.fixed]\nlength = 100", ("conflict", "preset 2d")),
        (
            '[[preset]]\nname = "2d"',
            '[[preset]]\nname = "full"',
            ("conflict", "preset full"),
        ),
        # Mounts of fingers
        (BASE, "", ("missing", "finger[0]")),
        (BASE, f"{BASE}radius = 0.035\n", ("conflict", "finger[0]")),
        ("base = [0.037", "base = [37", ("range", "finger[0].base[0]")),
        # Numbers of fingers that do not fit the hand
        (
            "\npressure = 120",
            "\npressure = [120, 110]",
            ("size", "preset 2d.fixed.pressure"),
        ),
        ("\nwall = 5", "\nwall = [5, 5, 2.5, 5]", ("range", "preset 2d")),
        ("\nspread = 45", "\nspread = [45]", ("size", "preset 2d.fixed.spread")),
        (
            "tied = true\nlow = 10",
            "tied = [[0, 4]]\nlow = 10",
            ("size", "preset 2d.free length.tied"),
        ),
        (
            "tied = true\nlow = 10",
            "tied = [[0], [1, 2]]\nlow = 10",
            ("size", "preset 2d.free length.tied"),
        ),
        (
            "tied = true\nlow = 10",
            "tied = [[0, 1], [1, 2]]\nlow = 10",
            ("size", "preset 2d.free length.tied"),
        ),
        (
            "tied = true\nlow = 10",
            "tied = [0, 1]\nlow = 10",
            ("type", "preset[0].free[0].tied[0]"),
        ),
        (
            "tied = true\nlow = 10",
            "tied = 'all'\nlow = 10",
            ("type", "preset[0].free[0].tied"),
        ),
        (
            "tied = true\nlow = 10",
            "tied = true\nlow = [10, 10, 10, 20]",
            ("type", "preset 2d.free length.low"),
        ),
    ],
)
def test_a_wrong_hand_file(tmp_path, old, new, expected):
    """Each problem is told once."""
    told = refusal(hand.load, edited(tmp_path, "hands", "pneuflex4", (old, new)))
    code, key = expected
    assert told.count((code, f"hands.toml.{key}")) == 1, told


def test_sections_at_the_tips_are_for_tapered_fingers():
    cases = (
        ("pneuflex4", {"hand.section.tapered": True}, "conflict", "parameter 'tip_wall'"),
        ("tapered4", {"hand.section.tapered": False}, "unsupported", "parameter 'tip_width'"),
        ("tapered4", {"hand.parameter.tip_height.low": 7}, "geometry", ""),
    )
    for name, changes, code, key in cases:
        told = refusal(scene.load, "paper", hand_name=name, overrides=changes)
        assert (code, f"{name}.toml.{key}".rstrip(".")) in told, told


def test_unknown_names_and_files(tmp_path):
    (tmp_path / "myhand.toml").write_text("")
    (tmp_path / "broken.toml").write_text("a = = 1")
    files = {"pneuflex": "unknown", "nowhere/hand.toml": "missing"}
    files |= {tmp_path / "myhand": "unknown", tmp_path / "broken.toml": "syntax"}
    for path, code in files.items():
        assert [kind for kind, _ in refusal(hand.load, path)] == [code], path


def test_paths_in_a_scene_file_are_relative_to_it(tmp_path):
    text = text_of("scenes", "paper").replace('hand = "pneuflex4"', 'hand = "mine.toml"')
    (tmp_path / "scene.toml").write_text(text)
    mine = text_of("hands", "pneuflex4").replace('name = "pneuflex4"', 'name = "mine"')
    (tmp_path / "mine.toml").write_text(mine)
    assert scene.load(tmp_path / "scene.toml").hand.name == "mine"


def test_the_grasp_is_the_papers():
    the_scene = scene.load("paper")
    assert the_scene.num_steps == 900 and the_scene.end_time == 9.0
    assert the_scene.window == (3.5, 8.0)
    short = scene.load("paper", overrides={"effects": {"ungrasp": False, "disturb": False}})
    assert short.end_time == 4.5 and short.window == (3.5, 4.5)


# Sets with meshes are stepped in test_meshes.py: stock MuJoCo does not take them.
STEPPED = [o for o in OBJECTS if 'type = "mesh"' not in text_of("objects", o)]


PLAIN = "pneuflex4", "tripod3", "tapered4"
"""Hands that have what the others have as well."""


@pytest.mark.parametrize(
    "hand_name, object_set",
    [
        pytest.param(
            hand, STEPPED[i % len(STEPPED)], marks=[pytest.mark.slow] * (hand not in PLAIN)
        )
        for i, hand in enumerate(HANDS)
    ],
)
def test_every_hand_and_object_set_steps_finitely(hand_name, object_set):
    spheres = {"effects": {"surface": "spheres"}}  # MuJoCo C has no contact with the skinned hull
    the_scene = scene.load("paper", hand_name=hand_name, object_set=object_set, overrides=spheres)
    space = parameters.design_space(the_scene.hand)
    trials = [still(i) for i in range(len(the_scene.objects.object))]
    params = parameters.params_of(space, repeat(space.default(), len(trials)))
    fields, ctrl = batch_inputs(the_scene, params, stack(*trials))
    trace = make_engine("mujoco", the_scene).rollout(fields, ctrl[:, :60])
    assert np.isfinite(trace.distance).all()
    assert (trace.speed < 20.0).all()  # a hand at rest that starts an approach, in rad/s and m/s
    # The object settles into the table: m g / k with k = 4 kN/m of one contact at the least, and
    # 1 % for what is left to settle.
    for i, shape in enumerate(the_scene.objects.object):
        sunk = nth(fields, i).start[-5] - trace.height[i, -1]
        assert 0.0 < sunk < 1.01 * shape.mass * 9.81 / (2 * the_scene.contact.normal_stiffness)


def test_effects_that_are_off_are_not_in_the_model():
    full = model.compile_template(scene.load("paper_spheres"))
    for effect, changed in (
        ("lateral_bending", "nv"),
        ("twist", "nv"),
        ("finger_object", "npair"),
        ("finger_table", "npair"),
        ("palm_object", "npair"),
        ("palm_table", "npair"),
        ("object_table", "npair"),
    ):
        reduced = model.compile_template(
            scene.load("paper_spheres", overrides={"effects": {effect: False}})
        )
        assert getattr(reduced, changed) < getattr(full, changed)
    assert full.nv == 6 + 4 * 10 * 3 + 6
