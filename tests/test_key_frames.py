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
from codesign_jax.runs.scene_files import write_scene
from codesign_jax.scene import library

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
        found = jax.jit(jax.vmap(lambda p: control.commands(the_scene, p, trial)))(params)
    return jax.tree.map(np.asarray, params), np.asarray(found)


def by_numpy(the_scene, table, params):
    """Commands of one design, by Python's `eval` of the file's texts and `np.interp`."""
    names = {**vars(the_scene.phases), **vars(the_scene.arm), "release": the_scene.window[1]}
    names |= {f"arm_{axis}": params.arm[i] for i, axis in enumerate(POSE)}
    names |= {"pressure": params.pressure} | (params.control or {})
    groups = table.get("group", {})
    now = {axis: names[f"arm_{axis}"] for axis in POSE}
    now |= {"z": the_scene.arm.start_height, "pressure": np.zeros(the_scene.num_fingers)}
    times, rows, held = [], [], []
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
        held.append(frame.get("interpolation") == "held")
    time = np.arange(the_scene.num_steps) * the_scene.discretization.timestep
    found = np.stack([np.interp(time, times, column) for column in np.transpose(rows)], 1)
    for i in np.flatnonzero(held):
        found[(time >= times[i]) & (time < times[i + 1])] = rows[i]
    x, y, z, roll, pitch, yaw = found[:, :6].T
    return np.column_stack([x, y, z, roll + 0.03, yaw, -0.05 - pitch, found[:, 6:]])


@pytest.mark.parametrize("name", [*CONTROLS, "page"])
def test_commands_are_those_of_the_file(name, tmp_path):
    """Every shipped control, and the example of the page."""
    path = CONTROLS.get(name, tmp_path / "page.toml")
    if name == "page":
        path.write_text(re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.DOTALL)[0])
    the_scene = load(path)
    params, found = worlds(the_scene)
    for i in range(len(found)):
        one = jax.tree.map(lambda v, i=i: v[i], params)
        expected = by_numpy(the_scene, tomllib.loads(path.read_text()), one)
        # Interpolated in another order of operations: 1e-12 of the largest number.
        np.testing.assert_allclose(found[i], expected, rtol=1e-12, atol=1e-12 * 150e3)
        np.testing.assert_allclose(found[i][:, :6], expected[:, :6], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", CONTROLS)
def test_a_control_is_written_as_it_was_read(name, tmp_path):
    original = load(name)
    write_scene(original, tmp_path)
    again = scene.load(tmp_path / "scene.toml")
    assert again == original and hash(again) == hash(original)


def test_numbers_of_a_control_are_data():
    """Another number in a file, or another bound: the same structure."""
    one = load("push_close")
    other = load(
        "push_close",
        **{"control.frame.2.time": "approach + 0.5", "control.parameter.push.high": 30},
    )
    assert one != other and one.structure == other.structure
    assert one.structure != load("slide").structure
    assert one.control.frame[2].time.number == 0.4
    frames = [*one.control.frame]
    time = dataclasses.replace(frames[2].time, number=1.6)
    frames[2] = dataclasses.replace(frames[2], time=time)
    control = dataclasses.replace(one.control, frame=tuple(frames))
    words = r"scene\.control\.frame\[3\]\.time .* 0\.8 s before"
    with pytest.raises(scene.InputError, match=words):
        scene.constants.check(dataclasses.replace(one, control=control))


FRAME = {"time": "approach"}
BAD = {
    "frame[0].time must be 0": [{"time": 0.1}],
    "control.frame[2].time = 'approach - 0.5' must come after that of frame[1]": [
        {"time": 0}, FRAME, {"time": "approach - 0.5", "z": 0.1}
    ],
    "above the limit of 80000 Pa of its wall": [{"time": 0}, FRAME | {"pressure": 90e3}],
    "frame[1].z names an unknown parameter 'arm_w'; did you mean 'arm_": [
        {"time": 0}, FRAME | {"z": "arm_w"}
    ],
    "frame[1].z: 'pressure' has the unit Pa, not m": [{"time": 0}, FRAME | {"z": "pressure"}],
    "frame[1].z = 'arm_z zero_height' is no sum": [{"time": 0}, FRAME | {"z": "arm_z zero_height"}],
    "frame[0].time = 1000": [{"time": 10**400}],
    "is too large": [{"time": 0}, FRAME | {"pressure": [10**310, 0, 0, 0]}],
    "frame[1].pressure has 3 entries, the hand 4 fingers": [
        {"time": 0}, FRAME | {"pressure": [0, 0, 0]}
    ],
    "frame[1].pressure.thumb is not a group": [{"time": 0}, FRAME | {"pressure": {"thumb": 0}}],
}  # fmt: skip
WAIT = {"name": "wait", "unit": "s", "low": 0, "high": 1, "default": 0.5}


def write(folder, **content):
    path = folder / "bad.toml"
    head = {"name": "bad", "description": "", "parameter": [WAIT], "frame": [{"time": 0}]}
    path.write_text(tomli_w.dumps(head | content))
    return path


@pytest.mark.parametrize("message", BAD)
def test_bad_frames_are_refused_with_their_key(message, tmp_path):
    with pytest.raises(scene.InputError) as error:
        load(write(tmp_path, frame=BAD[message]))
    assert message in str(error.value) and len(error.value.problems) <= 4  # one a finger


@pytest.mark.parametrize(
    "change, message",
    [
        (
            {"name": "pressure"},
            "parameter[0].name = 'pressure' must be a lower-case word not taken",
        ),
        ({"per": "finger"}, "parameter[0].per = 'finger' is for pressures, not for s"),
    ],
)
def test_bad_parameters_and_groups_are_refused(change, message, tmp_path):
    path = write(tmp_path, parameter=[WAIT | change], group={"all": [0, 4]})
    with pytest.raises(scene.InputError) as error:
        load(path)
    assert message in str(error.value)
    assert "group.all = [0, 4] must be an array of fingers, 0 to 3" in str(error.value)
