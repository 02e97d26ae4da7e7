"""`codesign check`: its counts are those of the grasps simulated again, and refusals."""

import re
from functools import partial

import jax
import numpy as np
import pytest
from scipy import stats

from codesign_jax import rollout, sampling, scene
from codesign_jax.commands import reference
from codesign_jax.engines import make_engine
from codesign_jax.scene import parameters
from tests.helpers.command_runs import command, own_workplace  # noqa: F401
from tests.helpers.toy_engine import TINY

SUBJECT = ("check", "--scene", TINY, "--engine", "mujoco", "--grasps", 4)
FINER = "fine"


@pytest.fixture(autouse=True)
def less_fine(monkeypatch):
    """MuJoCo C takes half a minute at `reference`: five times the steps, twice the links."""
    monkeypatch.setattr(reference, "ACCURACY", FINER)


def told(capsys, *arguments):
    """Numbers of the lines that follow the design's."""
    assert command(*SUBJECT, *arguments) == 0
    output = capsys.readouterr().out
    rates = [
        (float(a), int(b)) for a, b in re.findall(r"([\d.e+]+) grasps/s \((\d+) grasps", output)
    ]
    [counts] = re.findall(r"kept: (\d+) of (\d+) .* fine (\d+); .* in (\d+): .* %", output)
    [share] = re.findall(r"in \d+: (\S+) % \(95 % interval (\S+) to (\S+) %\)", output)
    [searched] = re.findall(r"(\d+) grasps\): about (\d+):(\d+)", output)
    return rates, [int(n) for n in counts], [float(v) for v in share], searched, output


def test_its_counts_are_those_of_the_grasps_simulated_again(capsys):
    """At both accuracies: the design's first trials, simulated apart; the interval by SciPy."""
    rates, counts, share, searched, _ = told(capsys, "--design", "length=44")
    kept = []
    for accuracy in (None, FINER):
        the_scene = scene.load(TINY, accuracy=accuracy)
        space = parameters.design_space(the_scene.hand, "2d")
        design = space.default()
        design[space.names.index("length")] = 44e-3
        key = jax.random.fold_in(jax.random.key(0), 1)
        drawn = sampling.draw(the_scene, space, key, first=0, n=4, num_trials=1)
        trials = jax.tree.map(lambda v: v[: counts[1], 0], drawn.trials)
        params = jax.jit(jax.vmap(space.params))(np.tile(design, (counts[1], 1)))
        simulate = partial(rollout.simulate, the_scene, make_engine("mujoco", the_scene))
        kept.append(np.asarray(jax.jit(simulate)(params, trials)[0].cost) < 0.01)
    assert counts == [kept[0].sum(), kept[0].size, kept[1].sum(), (kept[0] != kept[1]).sum()]
    assert rates[0][1] == 4 and rates[1][1] == counts[1]
    interval = stats.binomtest(counts[3], counts[1]).proportion_ci(method="wilson")
    found = [counts[3] / counts[1], interval.low, interval.high]
    np.testing.assert_allclose(share, np.multiply(found, 100), rtol=0.05, atol=1e-9)  # two digits
    grasps, minutes, seconds = map(int, searched)
    # Beside what compiling takes; the rate is told with three digits.
    assert 60 * minutes + seconds >= 0.99 * grasps / rates[0][0] - 1


@pytest.mark.parametrize(
    "flags, expected",
    [
        (("--accuracy", FINER), "accuracy fine is what others are compared with"),
        (("--grasps", 0), "--grasps = 0 is outside"),
        (("--seconds", 0), "--seconds = 0.0 is outside"),
        (("--engine", "mojoco"), "did you mean 'mujoco'?"),
        (("--design", "lenght=44"), "did you mean 'length'?"),
    ],
)
def test_bad_input_is_refused(flags, expected, capsys):
    assert command(*SUBJECT, *flags) == 2
    assert expected in capsys.readouterr().err


def test_a_scene_in_which_every_grasp_fails_is_told_and_ends_with_an_error(capsys):
    assert command(*SUBJECT, "--design", "length=44", "--set", "limits.speed=1") == 1
    assert "failed: " in capsys.readouterr().out
