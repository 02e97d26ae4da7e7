"""Key frames: files against NumPy's interpolation of what they say, and files that are refused."""

import dataclasses
import re
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w

from codesign_jax import control, parameters, rollout, scene
from codesign_jax.scene import key_frames, library, sums
from codesign_jax.scene.scene_files import write_scene
from tests.helpers.refusals import refusal

CONTROLS = library.available("controls")
PAGE = Path(__file__).parent.parent / "docs" / "control.md"
POSE = ("x", "y", "z", "roll", "pitch", "yaw")


def load(name, **overrides):
    return scene.load(
        "paper", overrides={"control": str(name), "effects.disturb": False} | overrides
    )


def worlds(the_scene, count=3):
    """Random designs of the whole table, a tilted trial, and their commands, in float64."""
    space = parameters.design_space(the_scene.hand)
    with jax.enable_x64(True):
        designs = space.sample(jax.random.key(1), count)
        params = parameters.params_of(space, designs)
        tilt = jnp.array([0.03, -0.05])
        trial = rollout.nominal_trial(the_scene)._replace(arm_tilt=tilt)
        commands = jax.jit(jax.vmap(lambda p: control.commands(the_scene, p, trial)))(params)
    return jax.tree.map(np.asarray, params), np.asarray(commands)


def by_numpy(the_scene, table, params):
    """Commands of one design, by Python's `eval` of the file's texts and `np.interp`."""
    names = {**vars(the_scene.phases), **vars(the_scene.arm), "release": the_scene.window[1]}
    names |= {f"arm_{axis}": params.arm[i] for i, axis in enumerate(POSE)}
    names |= {"pressure": params.pressure} | (params.control or {})
    groups = table.get("group", {})
    now = {axis: names[f"arm_{axis}"] for axis in POSE}
    now |= {"z": the_scene.arm.start_height, "pressure": np.zeros(the_scene.num_fingers)}
    times = []
    rows = []
    holds = []
    for frame in table["frame"]:
        now = dict(now)
        for key, value in frame.items():
            if key == "pressure":
                entries = value.items() if isinstance(value, dict) else [(None, value)]
                pressure = now["pressure"].copy()
                for group, text in entries:
                    where = slice(None) if group is None else groups[group]
                    values = np.broadcast_to(eval(str(text), {}, names), pressure.shape)
                    pressure[where] = values[where]
                now["pressure"] = pressure
            elif key in POSE:
                text = str(value)
                if key in POSE[3:]:  # numbers are degrees, but for factors
                    numbers = r"(?<![\w.])(\d+\.?\d*)(?![\d.]*\s*\*)"
                    text = re.sub(numbers, lambda m: f"np.deg2rad({m[1]})", text)
                now[key] = eval(text, {"np": np}, names)
        times.append(eval(str(frame["time"]), {}, names))
        rows.append([now[axis] for axis in POSE] + [*now["pressure"]])
        holds.append(frame.get("interpolation") == "held")
    time = np.arange(the_scene.num_steps) * the_scene.discretization.timestep
    commands = np.stack([np.interp(time, times, column) for column in np.transpose(rows)], 1)
    for i in np.flatnonzero(holds):
        commands[(time >= times[i]) & (time < times[i + 1])] = rows[i]
    x, y, z, roll, pitch, yaw = commands[:, :6].T
    return np.column_stack([x, y, z, roll + 0.03, yaw, -0.05 - pitch, commands[:, 6:]])


@pytest.mark.parametrize("name", [*CONTROLS, "page"])
def test_commands_are_those_of_the_file(name, tmp_path):
    """Every shipped control, and the example of the page."""
    path = CONTROLS.get(name, tmp_path / "page.toml")
    if name == "page":
        path.write_text(re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.DOTALL)[0])
    the_scene = load(path)
    params, commands = worlds(the_scene)
    for i in range(len(commands)):
        design = jax.tree.map(lambda v, i=i: v[i], params)
        expected = by_numpy(the_scene, tomllib.loads(path.read_text()), design)
        # Interpolated in another order of operations: 1e-12 of the largest number.
        np.testing.assert_allclose(commands[i], expected, rtol=1e-12, atol=1e-12 * 150e3)
        np.testing.assert_allclose(commands[i][:, :6], expected[:, :6], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", CONTROLS)
def test_a_control_is_written_as_it_was_read(name, tmp_path):
    original = load(name)
    write_scene(original, tmp_path)
    again = scene.load(tmp_path / "scene.toml")
    assert again == original and hash(again) == hash(original)


def test_numbers_of_a_control_are_data():
    """Another number in a file, or another bound: the same structure."""
    base = load("push_close")
    other = load(
        "push_close",
        **{"control.frame.2.time": "approach + 0.5", "control.parameter.push.high": 30},
    )
    assert base != other and base.structure == other.structure
    assert base.structure != load("slide").structure
    assert base.control.frame[2].time.number == 0.4
    frames = [*base.control.frame]
    time = dataclasses.replace(frames[2].time, number=1.6)
    frames[2] = dataclasses.replace(frames[2], time=time)
    control = dataclasses.replace(base.control, frame=tuple(frames))
    told = refusal(scene.constants.check, dataclasses.replace(base, control=control))
    assert told == [("order", "scene.control.frame[3].time")]


FRAME = {"time": "approach"}
BAD = [
    (("order", "bad.toml.frame[0].time"), [{"time": 0.1}]),
    (("order", "control.frame[2].time"), [
        {"time": 0}, FRAME, {"time": "approach - 0.5", "z": 0.1}
    ]),
    (("range", "control.frame[1].pressure"), [{"time": 0}, FRAME | {"pressure": 90e3}]),
    (("unknown", "bad.toml.frame[1].z"), [
        {"time": 0}, FRAME | {"z": "arm_w"}
    ]),
    (("type", "bad.toml.frame[1].z"), [{"time": 0}, FRAME | {"z": "pressure"}]),
    (("syntax", "bad.toml.frame[1].z"), [{"time": 0}, FRAME | {"z": "arm_z zero_height"}]),
    (("syntax", "bad.toml.frame[1].pressure[0]"), [
        {"time": 0}, FRAME | {"pressure": [10**310, 0, 0, 0]}
    ]),
    (("syntax", "bad.toml.frame[1].z"), [
        {"time": 0}, FRAME | {"z": "arm_z * arm_x"}
    ]),
    (("syntax", "bad.toml.frame[1].z"), [
        {"time": 0}, FRAME | {"z": "1 / arm_z"}
    ]),
    (("syntax", "bad.toml.frame[1].z"), [{"time": 0}, FRAME | {"z": "2 * (arm_z)"}]),
    (("syntax", "bad.toml.frame[1].z"), [{"time": 0}, FRAME | {"z": "arm_z -"}]),
    (("syntax", "bad.toml.frame[1].pitch"), [
        {"time": 0}, FRAME | {"pitch": "30\N{DEGREE SIGN}"}
    ]),
    (("syntax", "bad.toml.frame[1].z"), [{"time": 0}, FRAME | {"z": "arm_z - 0,01"}]),
    (("syntax", "bad.toml.frame[1].pressure"), [
        {"time": 0}, FRAME | {"pressure": "150 kPa"}
    ]),
    (("syntax", "bad.toml.frame[1].pitch"), [{"time": 0}, FRAME | {"pitch": "arm_pitch + 10deg"}]),
    (("syntax", "bad.toml.frame[1].z"), [
        {"time": 0}, FRAME | {"z": "zero_height + 3 psi"}
    ]),
    (("syntax", "bad.toml.frame[1].z"), [
        {"time": 0}, FRAME | {"z": "zero_height + 95"}
    ]),
    (("syntax", "bad.toml.frame[1].z"), [
        {"time": 0}, FRAME | {"z": "1e3 * arm_z"}
    ]),
    (("syntax", "bad.toml.frame[1].time"), [{"time": 0}, {"time": 10**400}]),
    (("size", "bad.toml.frame[1].pressure"), [
        {"time": 0}, FRAME | {"pressure": [0, 0, 0]}
    ]),
    (("unknown", "bad.toml.frame[1].pressure.thumb"), [
        {"time": 0}, FRAME | {"pressure": {"thumb": 0}}
    ]),
]  # fmt: skip
WAIT = {"name": "wait", "unit": "s", "low": 0, "high": 1, "default": 0.5}


def write(folder, **content):
    path = folder / "bad.toml"
    head = {"name": "bad", "description": "", "parameter": [WAIT], "frame": [{"time": 0}]}
    path.write_text(tomli_w.dumps(head | content))
    return path


@pytest.mark.parametrize(("kind", "frames"), BAD)
def test_bad_frames_are_refused_with_their_key(kind, frames, tmp_path):
    told = refusal(load, write(tmp_path, frame=frames))
    assert {*told} == {kind} and len(told) <= 4  # one a finger


DOUBTS = {
    "control.frame[1].pressure: its number is 80 Pa, next to none; did you mean 80000? (kPa": [
        {"time": 0}, FRAME | {"pressure": 80}
    ],
    "control.frame[1].pressure: its number is 20 Pa, next to none; did you mean 20000? (kPa": [
        {"time": 0}, FRAME | {"pressure": {"few": "0.5 * pressure + 20"}}
    ],
    "control.frame[1].pressure: its number is 0.8 Pa, next to none: pressures are in Pa": [
        {"time": 0}, FRAME | {"pressure": 0.8}
    ],
    "control.frame[1].time = 20.0 is never reached: the grasp ends after 4.5 s": [
        {"time": 0}, {"time": 20, "pressure": 0}
    ],
    "control.frame[1].time = 'release + 60.0' is never reached: the grasp ends after 9 s": [
        {"time": 0}, {"time": "release + 60", "pressure": 0}
    ],
    "control.frame[1].time = '8.0 * wait + 2.0' is not reached in some designs": [
        {"time": 0}, {"time": "8 * wait + 2", "pressure": 0}
    ],
    "control: no key frame reads arm_x, arm_z, pressure: without a policy it has no effect": [
        {"time": 0, "x": 0.1, "z": 0.2}, FRAME | {"x": 0.2, "pressure": 50e3}
    ],
    "": [
        {"time": 0}, FRAME | {"z": "arm_z", "pressure": "0.5 * pressure + 2e3"},
        {"time": 4.5, "pressure": 0},
    ],
}  # fmt: skip


@pytest.mark.parametrize("message", DOUBTS)
def test_what_is_hardly_meant_is_told_and_simulated(message, tmp_path):
    path = write(tmp_path, frame=DOUBTS[message], group={"few": [0]})
    doubts = key_frames.doubts(load(path, **{"effects.ungrasp": False}), "control")
    doubts = [text for text in doubts if message in text or "no key frame reads" not in text]
    assert [text[: len(message)] for text in doubts] == ([message] if message else [])


def test_a_parameter_of_the_control_in_the_wrong_unit_is_told(tmp_path):
    squeeze = {"name": "squeeze", "unit": "Pa", "low": 0, "high": 80, "default": 40}
    frames = [{"time": 0}, FRAME | {"pressure": "squeeze"}]
    doubts, _ = key_frames.doubts(
        load(write(tmp_path, parameter=[squeeze], frame=frames)), "control"
    )
    assert "parameter squeeze: the largest pressure is 80 Pa, next to none" in doubts


@pytest.mark.parametrize("name", CONTROLS)
def test_nothing_is_told_of_what_ships(name):
    """With and without the phases that its frames name."""
    for off in ({}, {"effects.ungrasp": False}, {"effects.disturb": True}):
        assert not key_frames.doubts(load(name, **off), "control")


SPELLINGS = [
    "pressure * 0.5", "0.5*pressure", "0.5 pressure", "pressure / 2", "1 / 2 * pressure",
    "2 * pressure / 4", "+ .5 \N{MULTIPLICATION SIGN} pressure", "5e-1\N{MIDDLE DOT}pressure",
    "0.5\N{NO-BREAK SPACE}* pressure",
]  # fmt: skip


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_factor_may_stand_before_and_behind_a_name(spelling):
    half = sums.Sum("Pa", None, (sums.Term("pressure", 0.5),))
    assert sums.read(spelling, "Pa") == half
    for minus in ("-", "\N{MINUS SIGN}", "\N{EN DASH}", "\N{HYPHEN}"):
        parsed = sums.read(f"{spelling} {minus} 3e3 {minus} 2*push", "Pa")
        assert parsed == sums.Sum("Pa", -3e3, (*half.term, sums.Term("push", -2.0)))
        assert sums.read(sums.text(parsed), "Pa") == parsed


@pytest.mark.parametrize(
    "change, kind",
    [
        ({"name": "pressure"}, ("conflict", "bad.toml.parameter[0].name")),
        ({"per": "finger"}, ("unsupported", "bad.toml.parameter[0].per")),
    ],
)
def test_bad_parameters_and_groups_are_refused(change, kind, tmp_path):
    path = write(tmp_path, parameter=[WAIT | change], group={"all": [0, 4]})
    assert {*refusal(load, path)} == {kind, ("type", "bad.toml.group.all")}
