"""Key frames: files against NumPy's interpolation of what they say, and files that are refused."""

import csv
import re
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w

from codesign_jax import cli, control, parameters, rollout, scene
from codesign_jax.runs.scene_files import write_scene
from codesign_jax.scene import key_frames, library
from tests.helpers.toy_engine import TINY

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


def test_parameters_of_a_control_are_free_in_every_preset():
    hand = load("push_close").hand
    for preset, count in (("2d", 3), ("23d", 24)):
        space = parameters.design_space(hand, preset)
        at = space.names.index("push")
        assert space.num_parameters == count and not space.is_morphology[at]
        assert space.bounds[0][at] == 0.0 and space.bounds[1][at] == pytest.approx(0.04)
    assert float(space.params(space.default()).control["push"]) == pytest.approx(0.01)


def test_numbers_of_a_control_are_data():
    """Another number in a file, or another bound: the same structure."""
    one = load("push_close")
    other = load(
        "push_close",
        **{"control.frame.2.time": "approach + 0.5", "control.parameter.push.high": 30},
    )
    assert one != other and one.structure == other.structure
    assert one.structure != load("slide").structure
    numbers = one.constants()
    assert numbers.control.frame[2].time.number == 0.4
    with pytest.raises(
        scene.InputError, match=r"constants\.control\.frame\[3\]\.time .* 0\.8 s before"
    ):
        scene.constants.check(one, _with_time(numbers, 1.6))


def _with_time(numbers, value):
    frames = [*numbers.control.frame]
    frames[2] = frames[2]._replace(time=frames[2].time._replace(number=value))
    return numbers._replace(control=numbers.control._replace(frame=tuple(frames)))


def test_commands_follow_a_time_that_is_a_parameter():
    """On the way to p in the time d after t0 the pressure is p (t - t0) / d."""
    the_scene = load("two_stage")
    space = parameters.design_space(the_scene.hand, "2d")
    trial = rollout.nominal_trial(the_scene)

    @jax.jit
    @jax.value_and_grad
    def pressure(delay):  # of the first finger, at 2.25 s
        params = space.params(jnp.stack([0.08, 0.095, delay]))
        return control.commands(the_scene, params, trial)[225, 6]

    share = (2.25 - the_scene.phases.approach) / 0.7
    expected = 120e3 * share, -120e3 * share / 0.7
    np.testing.assert_allclose(pressure(0.7), expected, rtol=1e-5)  # float32


FRAME = {"time": "approach"}
BAD = {
    "frame[0].time must be 0": [{"time": 0.1}],
    "control.frame[2].time = 'approach - 0.5' must come after that of frame[1]": [
        {"time": 0}, FRAME, {"time": "approach - 0.5", "z": 0.1}
    ],
    "frame[2].time = 'approach + 0.5' must come after that of frame[1], 'approach + wait'": [
        {"time": 0}, {"time": "approach + wait"}, {"time": "approach + 0.5", "z": 0.1}
    ],
    "frame[1].pressure = '1.2 * pressure' of finger 0 may be": [
        {"time": 0}, FRAME | {"pressure": "1.2 * pressure"}
    ],
    "above the limit of 80000 Pa of its wall": [{"time": 0}, FRAME | {"pressure": 90e3}],
    "may be -1000 Pa, below zero": [{"time": 0}, FRAME | {"pressure": "pressure - 1000"}],
    "frame[1].z names an unknown parameter 'arm_w'; did you mean 'arm_": [
        {"time": 0}, FRAME | {"z": "arm_w"}
    ],
    "frame[1].z: 'pressure' has the unit Pa, not m": [{"time": 0}, FRAME | {"z": "pressure"}],
    "frame[1].z = 'arm_z zero_height' is no sum": [{"time": 0}, FRAME | {"z": "arm_z zero_height"}],
    "frame[1].z = '2 * 3' is no sum": [{"time": 0}, FRAME | {"z": "2 * 3"}],
    "frame[1].z = 'arm_z + arm_z' has 'arm_z' twice": [{"time": 0}, FRAME | {"z": "arm_z + arm_z"}],
    "frame[1].z = True must be a number, or a sum": [{"time": 0}, FRAME | {"z": True}],
    "frame[1].z = 30.0 is outside [-2, 2] m; did you mean 0.03?": [{"time": 0}, FRAME | {"z": 30}],
    "frame[1].speed is not a known key": [{"time": 0}, FRAME | {"speed": 1}],
    "frame[1].time is missing": [{"time": 0}, {"z": 0.1}],
    "frame[1].pressure has 3 entries, the hand 4 fingers": [
        {"time": 0}, FRAME | {"pressure": [0, 0, 0]}
    ],
    "frame[1].pressure.thumb is not a group": [{"time": 0}, FRAME | {"pressure": {"thumb": 0}}],
    "frame[1].interpolation must be 'linear' or 'held'": [
        {"time": 0}, FRAME | {"interpolation": "cubic"}
    ],
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
        ({"low": 2}, "parameter[0]: low 2 must be below high 1"),
        ({"default": 3}, "parameter[0].default = 3.0 is outside [0, 1] s"),
        ({"per": "finger"}, "parameter[0].per = 'finger' is for pressures, not for s"),
    ],
)
def test_bad_parameters_and_groups_are_refused(change, message, tmp_path):
    path = write(tmp_path, parameter=[WAIT | change], group={"all": [0, 4]})
    with pytest.raises(scene.InputError) as error:
        load(path)
    assert message in str(error.value)
    assert "group.all = [0, 4] must be an array of fingers, 0 to 3" in str(error.value)


def test_params_without_the_controls_parameters_are_refused():
    the_scene = load("slide")
    space = parameters.design_space(the_scene.hand, "2d")
    params = parameters.params_of(space, space.default()[None])
    trial = jax.tree.map(lambda v: v[None], rollout.nominal_trial(the_scene))
    with pytest.raises(scene.InputError, match="control has none; .* 'slide' needs slide"):
        rollout.simulate(the_scene, None, params._replace(control=None), trial)  # type: ignore[arg-type]


def test_sums_are_read():
    kind = key_frames.Metres
    assert key_frames.read_sum(0.1, kind) == kind(0.1)
    found = key_frames.read_sum("-2e-1 + .5 arm_z - arm_x + 0.3", kind)
    assert found.number == pytest.approx(0.1)
    assert [(t.name, t.factor) for t in found.term] == [("arm_z", 0.5), ("arm_x", -1.0)]


SUNK = """
name = "sunk"
description = "Lower by a number that a search moves"
parameter = [{ name = "sink", unit = "mm", low = 0, high = 20, default = 5 }]
frame = [
    { time = 0, z = "start_height", pressure = 0 },
    { time = "approach", z = "zero_height + arm_z - sink" },
    { time = "inflate", pressure = "pressure" },
    { time = "lift", z = "start_height" },
    { time = "release" },
    { time = "release + deflate_time", pressure = 0 },
]
"""


def test_optimize_searches_a_parameter_of_the_control(tmp_path):
    """Beside those of the design space, within its bounds; the run keeps the control."""
    (tmp_path / "sunk.toml").write_text(SUNK)
    sizes = ["--particles", "4", "--trials", "2", "--episodes", "2", "--test-trials", "2"]
    how = ["--optimizer", "screened-es", "--engine", "mujoco", "--reference-trials", "0"]
    run = ["--scene", str(TINY), "--set", f"control={tmp_path / 'sunk.toml'}"]
    assert cli.main(["optimize", *run, *sizes, *how, "--out", str(tmp_path / "run")]) == 0
    with (tmp_path / "run" / "tests.csv").open() as file:
        sinks = [float(row["sink_mm"]) for row in csv.DictReader(file)]
    assert len({*sinks}) > 1 and min(sinks) >= 0 and max(sinks) <= 20
    kept = tomllib.loads((tmp_path / "run" / "control.toml").read_text())
    assert kept["parameter"][0]["name"] == "sink"
