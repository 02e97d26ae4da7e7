"""`codesign compare`: runs side by side, and two designs in the same trials."""

import csv
import re
import shutil
import zipfile
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import stats

from codesign_jax import rollout, sampling, scene
from codesign_jax.commands import reference
from codesign_jax.engines import make_engine
from codesign_jax.report import statistics
from codesign_jax.scene import parameters
from tests.helpers.command_runs import command, own_workplace  # noqa: F401
from tests.helpers.tiny_run import copied
from tests.helpers.toy_engine import TINY

pytestmark = pytest.mark.filterwarnings("ignore:.*contacts of today have no such numbers")
DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Runs of an earlier commit, and one of today's code with the same object."""
    folder = tmp_path_factory.mktemp("runs")
    for path in DATA.glob("run*.zip"):
        zipfile.ZipFile(path).extractall(folder)
    copied(folder / "today")
    return folder


def test_runs_of_folders_are_rows(place, tmp_path, monkeypatch, capsys):
    """One a run, with what the runs differ in; folders of runs are those in them."""
    monkeypatch.chdir(place)
    table, folders = tmp_path / "runs.csv", ["particle-filter", "screened", "seeds"]
    assert command("compare", *folders, "--out", table) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "run scene hand objects optimizer preset engine seed converged judged by" in lines[1]
    assert any(line.startswith("seeds/seed-1 tiny pinch mesh") for line in lines)
    # Neither a test nor fresh trials: the search was stopped after five episodes.
    [stopped] = [line for line in lines if line.startswith("screened")]
    assert stopped.endswith("screened-es 23d structured 0 episode 6")
    with table.open(newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [row["seed"] for row in rows] == ["3", "0", "0", "1"]
    there = [(tmp_path / row["run"]).resolve() for row in rows]
    assert there[-1] == (place / "seeds" / "seed-1").resolve()
    assert command("compare", *folders, "--out", table) == 0  # it is such a table


def test_two_designs_meet_the_same_trials(place, capsys):
    """Counts add up, and a design beside itself differs in no trial."""
    runs = [place / "particle-filter", place / "today"]
    assert command("compare", *runs, "--trials", "12") == 0
    said = capsys.readouterr().out
    assert said.count("of 12 fresh grasps") == 2 and "of the same 12 trials" in said
    assert "95 % interval by Newcombe; McNemar's exact test" in said
    copy = Path(shutil.copytree(place / "today", place / "copy"))
    assert command("compare", place / "today", copy, "--trials", "3") == 0
    assert f"0 by {place / 'today'} alone, 0 by {copy} alone" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("names", "flags", "expected"),
    [
        ([], [], "compare needs at least one run folder"),
        (["none"], [], "none is not a run folder: there is no such folder"),
        (["today"], ["--trials", "3"], "--trials compares two designs; the folders have 1 runs"),
        (["today", "screened"], ["--trials", "3"], "other objects or noise: --objects says which"),
        (["today"], ["--out", "a.txt"], "--out a.txt must end in .csv"),
        (["today", "screened"], ["--trials", "0"], "--trials = 0 is outside"),
    ],
)
def test_what_cannot_be_compared_is_refused(names, flags, expected, place, capsys):
    assert command("compare", *(place / name for name in names), *flags) == 2
    assert expected in capsys.readouterr().err


def test_the_interval_of_a_difference_covers_as_often_as_it_says():
    """By the exact probabilities of all tables of 20 trials, for shares of good and bad designs."""
    total, covered = 20, []
    tables = [
        (a, b, c)
        for a in range(total + 1)
        for b in range(total + 1 - a)
        for c in range(total + 1 - a - b)
    ]
    found = np.array([statistics.paired(*table, total) for table in tables])
    counts = np.array([(a, b, c, total - a - b - c) for a, b, c in tables])
    for shares in ((0.9, 0.05, 0.03, 0.02), (0.6, 0.3, 0.05, 0.05), (0.3, 0.2, 0.2, 0.3)):
        weights = stats.multinomial(total, shares).pmf(counts)
        inside = (found[:, 1] <= shares[1] - shares[2]) & (shares[1] - shares[2] <= found[:, 2])
        covered.append(weights[inside].sum())
    # Newcombe's own evaluation has a mean of 0.95 and no less than 0.92 at such sizes.
    assert min(covered) > 0.92 and np.mean(covered) < 0.995


# --- `codesign check`: its counts are those of the grasps simulated again, and refusals -----------


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


def test_a_scene_in_which_every_grasp_fails_is_told_and_ends_with_an_error(capsys):
    assert command(*SUBJECT, "--design", "length=44", "--set", "limits.speed=1") == 1
    assert "failed: " in capsys.readouterr().out
