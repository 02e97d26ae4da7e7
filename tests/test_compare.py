"""Designs beside one another, at finer steps and under other conditions; verdicts on them."""

import csv
import dataclasses
import itertools
import re
import shutil
import tomllib
import zipfile
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest
import tyro
from scipy import integrate, optimize, stats

from codesign_jax import (
    cli,
    constants,
    model,
    preflight,
    rollout,
    runs,
    sampling,
    scene,
    statistics,
)
from codesign_jax.commands import check, common, compare, flags
from codesign_jax.engines import make_engine
from codesign_jax.judge import cases, fresh_trials, sentences, stress, verdict
from codesign_jax.judge.sentences import Judged
from codesign_jax.model import overlap
from codesign_jax.report import advice
from codesign_jax.runs import columns, selection
from codesign_jax.scene import beams, design_files, draws, parameters
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome, Status
from tests.helpers.command_runs import command, copied, finished_run, own_workplace  # noqa: F401
from tests.helpers.refusals import refusal_of_command
from tests.helpers.toy_engine import TINY

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
    table = tmp_path / "runs.csv"
    folders = ["particle-filter", "screened", "seeds"]
    assert command("compare", *folders, "--out", table) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "run scene hand objects optimizer preset engine seed converged judged by" in lines[1]
    assert any(line.startswith("seeds/seed-1 tiny pinch mesh") for line in lines)
    # Neither a test nor fresh trials: the search was stopped after five episodes.
    [stopped] = [line for line in lines if line.startswith("screened")]
    beginning, _, air = stopped.rpartition(" ")
    assert beginning.endswith("screened-es 23d structured 0 episode 6") and float(air) > 0
    rows = [*csv.DictReader(table.read_text().splitlines())]
    assert [row["seed"] for row in rows] == ["3", "0", "0", "1"]
    there = [(tmp_path / row["run"]).resolve() for row in rows]
    assert there[-1] == (place / "seeds" / "seed-1").resolve()
    assert command("compare", *folders, "--out", table) == 0  # it is such a table


def test_a_design_is_compared_in_two_settings_and_a_run_with_a_file(place, workplace, capsys):
    """Each side has its own values, which its name says, beside those of both."""
    run = place / "today"
    case = selection.case_of_run(run)
    settings = runs.read_run(run)[1]
    file = design_files.DesignFile(settings.preset, {}, scene=str(run / "scene.toml"))
    Path("mine.toml").write_text(common.design_text(case.space, file, case.design))
    sides = ["--set-a", "hand.material.shear_modulus=5e4", "--set-b", "gravity=3"]
    options = flags.Compare(
        folders=(Path("mine.toml"),),
        set_a=(("hand.material.shear_modulus=5e4",),),
        set_b=(("gravity=3",),),
        overrides=(("contact.friction_ratio=20",),),
    )
    pair = compare._pair(options, [*options.folders])
    names = ["mine.toml with hand.material.shear_modulus=5e4", "mine.toml with gravity=3"]
    assert [*pair] == names
    soft, light = pair.values()
    assert (soft.scene.hand.material.shear_modulus, light.scene.gravity) == (5e4, 3)
    assert soft.scene.gravity == case.scene.gravity
    assert soft.scene.contact.friction_ratio == light.scene.contact.friction_ratio == 20
    np.testing.assert_array_equal(np.float32(soft.design), np.float32(case.design))
    assert command("compare", "mine.toml", run, "--trials", "3") == 0
    output = capsys.readouterr().out
    assert f"0 by mine.toml alone, 0 by {run} alone" in output
    assert output.count(f"{case.air:.1f} cm³") == 2
    assert command("compare", "mine.toml", *sides, "--set", "gravity=1000") == 2


def test_two_designs_meet_the_same_trials(place, capsys):
    """Counts add up, and a design beside itself differs in no trial."""
    runs = [place / "particle-filter", place / "today"]
    assert command("compare", *runs, "--trials", "12") == 0
    output = capsys.readouterr().out
    assert output.count("of 12 fresh grasps") == 2 and "of the same 12 trials" in output
    assert "95 % interval by Newcombe; McNemar's exact test" in output
    copy = Path(shutil.copytree(place / "today", place / "copy"))
    assert command("compare", place / "today", copy, "--trials", "3") == 0
    assert f"0 by {place / 'today'} alone, 0 by {copy} alone" in capsys.readouterr().out


REFUSED = [
    ([], [], ("missing", "compare")),
    (["none"], [], ("damaged", "none")),
    (["today"], ["--trials", "3"], ("conflict", "--trials")),
    (["today", "screened"], ["--trials", "3"], ("conflict", "the two runs")),
    (["today"], ["--out", "a.txt"], ("file", "--out a.txt")),
    (["today", "screened"], ["--trials", "0"], ("range", "--trials")),
    (["a.toml"], [], ("conflict", "compare")),
    (["a.toml"] * 3, [], ("conflict", "compare")),
    (["a.toml", "today"], [], ("file", "a.toml")),
    (["seeds", "today"], ["--set-b", "gravity=3"], ("conflict", "--set-a and --set-b")),
    (["today"], ["--set-b", "gravity=1000"], ("range", "gravity")),
    (["today"], ["--set-a", "objects.object.0.mass=0.2"], ("conflict", "the two runs")),
    (["a.toml"] * 2, ["--out", "a.csv"], ("conflict", "--out")),
    (["a.toml"] * 2, ["--policy", "a:B", "c:D"], ("conflict", "--policy")),
]
"""Runs or files, flags, and kind and key of the problem."""


@pytest.mark.parametrize(("names", "flags", "expected"), REFUSED)
def test_what_cannot_be_compared_is_refused(names, flags, expected, place, monkeypatch):
    monkeypatch.chdir(place)
    assert refusal_of_command("compare", *names, *flags) == [expected]


def test_the_interval_of_a_difference_covers_as_often_as_it_says():
    """By the exact probabilities of all tables of 20 trials, for shares of good and bad designs."""
    total = 20
    covered = []
    tables = [
        (a, b, c)
        for a in range(total + 1)
        for b in range(total + 1 - a)
        for c in range(total + 1 - a - b)
    ]
    intervals = np.array([statistics.paired(*table, total) for table in tables])
    counts = np.array([(a, b, c, total - a - b - c) for a, b, c in tables])
    for shares in ((0.9, 0.05, 0.03, 0.02), (0.6, 0.3, 0.05, 0.05), (0.3, 0.2, 0.2, 0.3)):
        weights = stats.multinomial(total, shares).pmf(counts)
        inside = (intervals[:, 1] <= shares[1] - shares[2]) & (
            shares[1] - shares[2] <= intervals[:, 2]
        )
        covered.append(weights[inside].sum())
    # Newcombe's own evaluation has a mean of 0.95 and no less than 0.92 at such sizes.
    assert min(covered) > 0.92 and np.mean(covered) < 0.995


def test_where_a_policy_leaves_the_key_frames():
    """Until a grasp is decided: what is commanded later is nobody's."""
    tiny = scene.load(TINY)
    steps = 8
    h = tiny.discretization.timestep
    planned = np.zeros((5, steps, 8))
    ctrl = planned.copy()
    ctrl[1, 3:, 6] = -2e4  # a pressure, from the fourth step on
    ctrl[2, 5, 0] = 0.003  # the arm
    ctrl[2, 6, 4] = 0.1
    ctrl[3, 6:, 7] = 5e4  # after the object was lost
    ctrl[4, 2, 7] = 1e-3  # rounding
    outcomes = trials_of(np.zeros(5), np.zeros(5))
    outcomes.lost_time[3] = 6 * h
    left = cases.departure(tiny, outcomes, ctrl, planned)
    np.testing.assert_allclose(left.time, [np.inf, 3 * h, 5 * h, np.inf, np.inf])
    np.testing.assert_allclose(left.lower, [0, -2e4, 0, 0, 0])
    np.testing.assert_allclose(left.place, [0, 0, 0.003, 0, 0])
    np.testing.assert_allclose(left.turn, [0, 0, 0.1, 0, 0])
    sentence = str(jax.tree.map(np.asarray, left))
    assert sentence.startswith(
        "left the key frames in 2 of 5 grasps, first after 0.08 s (median); "
    )
    assert sentence.endswith("pressures by -20 to +1e-06 kPa, the arm by up to 3 mm and 5.73°")
    none = cases.departure(tiny, outcomes, planned, planned)
    assert str(none) == "commanded nothing but the key frames in 5 grasps"


@pytest.mark.parametrize(("first", "second", "total"), [(30, 12, 400), (5, 2, 24), (0, 3, 60)])
def test_how_many_trials_would_show_a_difference(first, second, total):
    """With so many at the same shares the interval is about to leave out 0."""
    output = " ".join(compare.difference(*outcomes_of(first, second, total), names=["a", "b"]))
    if "no difference" not in output:
        return
    needed = int(re.search(r"about ([\d,]+) trials", output)[1].replace(",", ""))
    scale = needed / total
    pair = [round(scale * n) for n in (first, second)]
    interval = statistics.paired(round(scale * total) - sum(pair), *pair, round(scale * total))
    # Newcombe's interval is wider than the normal one at few trials, by less than its half.
    assert abs(interval.value) > 0.5 * (interval.high - interval.low) / 2


def outcomes_of(first, second, total):
    """Which trials two designs kept, of which so many one alone did."""
    kept, other = np.ones((2, total), bool)
    other[:first] = False
    kept[first : first + second] = False
    return kept, other


# --- `codesign check`: its counts are those of the grasps simulated again, and refusals -----------


SUBJECT = ("check", "--scene", TINY, "--engine", "mujoco", "--grasps", 4)
FINER = "fine"


@pytest.fixture(autouse=True)
def less_fine(monkeypatch):
    """MuJoCo C takes half a minute at `reference`: five times the steps, twice the links."""
    monkeypatch.setattr(fresh_trials, "ACCURACY", FINER)


def read_numbers(capsys, *arguments):
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


@pytest.mark.slow  # 14 s
def test_its_counts_are_those_of_the_grasps_simulated_again(capsys):
    """At both accuracies: the design's first trials, simulated apart; the interval by SciPy."""
    rates, counts, share, searched, _ = read_numbers(capsys, "--design", "length=44")
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
    expected = [counts[3] / counts[1], interval.low, interval.high]
    # The table has two digits.
    np.testing.assert_allclose(share, np.multiply(expected, 100), rtol=0.05, atol=1e-9)
    grasps, minutes, seconds = map(int, searched)
    # Beside what compiling takes; the rate is told with three digits.
    assert 60 * minutes + seconds >= 0.99 * grasps / rates[0][0] - 1


def test_the_interval_over_designs_and_trials_covers_the_share():
    """Of the share of flips where designs differ, as 95 % of intervals should.

    A flip's probability is beta distributed over designs, with a mean of 8 % and a correlation of
    0.25 within a design.  Wilson's interval takes all trials as independent.  2,000 draws leave
    0.5 points; the skew of few designs takes two.
    """
    rng = np.random.default_rng(0)
    share = 0.08
    size = (2000, 40)
    probability = rng.beta(share * 3, (1 - share) * 3, size)
    flips = rng.binomial(12, probability)
    both = [statistics.clustered(f, np.full(size[1], 12)) for f in flips]
    alone = [statistics.wilson(int(f.sum()), 12 * size[1]) for f in flips]
    covered, too_few = (np.mean([i.low <= share <= i.high for i in v]) for v in (both, alone))
    assert 0.93 < covered < 0.97 and too_few < 0.75
    # Independent trials, and those of one design: SciPy's interval.
    for kept, total in (([3], [12]), ([0, 0, 0], [4, 4, 4]), ([2, 2], [2, 2])):
        expected = stats.binomtest(sum(kept), sum(total)).proportion_ci(method="wilson")
        assert statistics.clustered(kept, total)[1:] == pytest.approx(expected, abs=1e-12)
    single = statistics.clustered(rng.permutation(np.arange(400) < 30), np.ones(400))
    expected = stats.binomtest(30, 400).proportion_ci(method="wilson")
    # Student's quantile of 399 degrees of freedom is 0.3 % above the normal one.
    assert single[1:] == pytest.approx(expected, rel=5e-3)


def test_check_ends_with_an_error_where_every_grasp_fails(monkeypatch):
    """Its simulations are stand-ins."""
    outcomes = trials_of(np.zeros(4), np.full(4, Status.SPEED))
    batch = jax.tree.map(lambda v: v.reshape(2, 2), outcomes)

    def simulate(case, *arguments):
        measured = check.Measured(case.scene, batch, 1.0, 0.0)
        return "designs", [measured, measured]

    monkeypatch.setattr(check, "simulate", simulate)
    assert command(*SUBJECT) == 1


def test_the_table_of_presets_has_flips_and_regret_of_known_grasps(capsys):
    """Two designs in four grasps each: one keeps all, the other none, and `fast` swaps them.

    A choice between them gains half of their difference, and loses as much if they are swapped.
    """
    case = common.find_case(flags.Check(scene=str(TINY), engine="mujoco"))
    rows = np.array([0, 1, 0, 1])

    def measured(name, kept, seconds):
        lost_time = np.where(np.repeat(kept, 2).reshape(4, 2), np.inf, 0.5)
        zeros = np.zeros((4, 2), int)
        the_scene = scene.with_accuracy(case.scene, name)
        outcomes = Outcome(zeros, zeros, lost_time, zeros - 1)
        return check.Measured(the_scene, outcomes, seconds, 0.0, name, rows)

    levels = [
        measured("standard", rows == 0, 4.0),
        measured("fast", rows == 1, 2.0),
        measured("reference", rows == 0, 40.0),
    ]
    settings = runs.make_settings("2d", "concurrent", "morphology", "mujoco", 0)
    assert check.tell(case, settings, "two", levels, Console(), table=True) == 0
    output = capsys.readouterr().out
    lines = [line.split() for line in output.splitlines() if line.strip()]
    cells = {words[0]: words for words in lines}
    assert cells["fast"][1:4] == ["20", "6", "250"]  # ms, links, ms a grasp
    assert cells["fast"][6:9] == ["8", "of", "8"] and cells["fast"][-1] == "+100.0"
    assert cells["standard"][6:9] == ["0", "of", "8"] and cells["standard"][-1] == "+0.0"
    assert cells["reference"][-1] == "–"


# --- `codesign evaluate`: rows and verdict of a design, of its own or of a run --------------------


ROOT = Path(__file__).parents[1]


def test_what_is_not_given_is_said_to_be_a_default(capsys, monkeypatch):
    """One value for all fingers where the space has one for each."""
    monkeypatch.setattr(preflight, "refusals", lambda *rest: [])  # which compiles
    tiny = ["--scene", TINY, "--dry-run"]
    assert command("evaluate", *tiny, "--design", "length=100") == 0
    assert "not given, so the hand file's defaults: arm_z\n" in capsys.readouterr().out
    assert command("evaluate", *tiny) == 0
    assert "the hand file's default design; --design NAME=VALUE changes" in capsys.readouterr().out
    every = ["--preset", "23d", "--design", "length=95", "arm_z=30"]
    assert command("evaluate", "--dry-run", *every) == 0
    shown = capsys.readouterr().out
    rows = [line.split() for line in shown.splitlines()]
    assert ["finger", "length", "height", "wall", "pressure"] in rows
    assert ["mm", "mm", "mm", "kPa"] in rows and ["3", "95", "20", "5", "120"] in rows
    assert ["45", "0", "0", "15", "30", "-20", "0"] in rows, "spread, then the arm's"
    assert max(map(len, shown.splitlines()[:9])) < 80
    assert "defaults: height, wall, spread, arm_roll" in shown
    twice = ["--preset", "23d", "--design", "length=95", "length[1]=90"]
    problems = refusal_of_command("evaluate", "--dry-run", *twice)
    assert problems == [("conflict", "--design 'length[1]'")]


def test_a_design_is_opened_from_its_file(workplace, capsys, monkeypatch):
    """As it was written, in what it names, and with what the command line changes."""
    monkeypatch.setattr(preflight, "refusals", lambda *rest: [])  # which compiles
    sliding = scene.load("paper", overrides={"control": "slide"})
    space = parameters.design_space(sliding.hand, "23d")
    design = np.asarray(space.sample(jax.random.key(3), 1)[0])
    file = design_files.DesignFile("23d", {}, objects="plate", control="slide")
    text = common.design_text(space, file, design)
    (workplace / "mine.toml").write_text(text)
    assert tomllib.loads(text)["preset"] == "23d"
    opened = common.find_design(space, ["mine.toml"])
    # Written with the fewest digits that mean the same number.
    np.testing.assert_array_equal(np.float32(opened), np.float32(design))
    flags = common.Subject(objects="paper", design=(("mine.toml",),))
    named = common.load_scene(flags)
    assert (named.control.name, named.objects.name) == ("slide", "paper"), "a flag holds"
    read = parameters.read_design("mine.toml", overrides={"gravity": 3.7})
    np.testing.assert_array_equal(read.design, opened)
    assert (read.scene.control.name, read.scene.objects.name) == ("slide", "plate")
    assert (read.space.names, read.scene.gravity) == (space.names, 3.7)
    assert command("evaluate", "--dry-run", "--design", "mine.toml", "length[1]=90") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    lengths = [f"{v:.4g}" for v in 1e3 * design[:4]]
    assert ["1", "90"] == rows[4][:2] and [row[1] for row in rows[5:7]] == lengths[2:]
    assert not any("defaults:" in row for row in rows)
    (workplace / "wrong.toml").write_text(
        "design.lenght = 95\ndesign.arm_z = [1, 2]\npreset = '2d'"
    )
    problems = refusal_of_command("evaluate", "--dry-run", "--design", "wrong.toml")
    names = ["lenght", "arm_z[0]", "arm_z[1]"]
    assert problems == [("unknown", f"wrong.toml '{name}'") for name in names]


def test_a_table_of_trials_has_noise_and_endings(finished, tmp_path, capsys):
    """Of any final particle: the noise is that of the seed, and endings add up to the verdict."""
    rows = [line.split(",") for line in (finished / "tests.csv").read_text().splitlines()[1:]]
    table = tmp_path / "new" / "trials.csv"
    seed = 4
    arguments = ["evaluate", finished, "--particle", "1", "--trials", "3", "--seed", seed]
    assert command(*arguments, "--out", table) == 0
    output = capsys.readouterr().out
    assert f"particle 1 of {finished}" in output and f"length={float(rows[1][-2]):.4g} mm" in output
    written = [*csv.DictReader(table.read_text().splitlines())]
    assert [*written[0]] == [*columns.MORE[columns.REFERENCE].columns]
    drawn = rollout.sample_trials(runs.read_run(finished)[0], jax.random.key(seed), 3)
    for row, x, mass in zip(written, drawn.position[:, 0], drawn.mass, strict=True):
        assert float(row["noise_x_m"]) == pytest.approx(float(x), rel=1e-6)
        assert float(row["noise_mass_factor"]) == pytest.approx(float(mass), rel=1e-6)
    kept = sum(row["verdict"] == "kept" for row in written)
    assert f"all: kept {kept} of 3, " in output
    for wrong, problem in (
        ([finished, "--particle", "99"], ("range", "--particle")),
        (["--particle", "0"], ("missing", "--particle")),
        (["--out", "trials.txt"], ("file", "--out trials.txt")),
    ):
        assert refusal_of_command("evaluate", *wrong) == [problem]


@pytest.mark.parametrize(
    ("kept", "total", "word", "more"),
    [
        (24, 24, "not enough trials", 32),
        (56, 56, "good", 0),
        (97, 100, "good", 0),
        (96, 100, "not enough trials", 24),
        (143, 150, "not enough trials", 7),
        (0, 4, "not enough trials", 1),
        (0, 5, "not good", 0),
        (18, 24, "not good", 0),
        (6, 6, "not enough trials", 50),
        (142, 150, "not enough trials", 61),
        # Close to the share at which the two likelihoods are equal.
        (128, 138, "not enough trials", 10_001),
    ],
)
def test_one_rule_judges_designs(kept, total, word, more):
    """By binomial likelihoods of SciPy; the interval is SciPy's."""
    judgement = verdict.judge(kept, total)
    assert (judgement.word, judgement.more) == (word, more)
    low, high = stats.binomtest(kept, total).proportion_ci(0.95, method="wilson")
    assert (judgement.share.low, judgement.share.high) == pytest.approx((low, high))
    ratio = np.subtract(*stats.binom.logpmf(kept, total, [verdict.WANTED, verdict.POOR]))
    assert verdict.evidence(kept, total) == pytest.approx(ratio)
    decided = {"good": ratio, "not good": -ratio}.get(word, -abs(ratio))
    assert (decided >= np.log(1 / verdict.ERROR)) == (not more)


def test_verdicts_are_monotone_and_what_decides_decides():
    """One more grasp that is kept never makes a verdict worse, a lost one never better."""
    rank = {"not good": 0, "not enough trials": 1, "good": 2}

    def of(kept, total):
        return rank[verdict.word(kept, total)]

    for total in (1, 5, 20, 22, 24, 49, 150, 300):
        for kept in range(total + 1):
            assert of(kept, total + 1) <= of(kept, total) <= of(kept + 1, total + 1)
            more = verdict.judge(kept, total).more if total < 25 else 0
            if 0 < more <= 10_000:
                share = kept / total
                ratios = [verdict.evidence(share * n, n) for n in (total + more - 1, total + more)]
                assert abs(ratios[0]) < np.log(20) + 1e-6 and abs(ratios[1]) > np.log(20) - 1e-6


class Characteristic(NamedTuple):
    """Behaviour of `verdict.sequential` for a design with a given true share of kept grasps."""

    good: float  # probabilities of the three ends
    not_good: float
    undecided: float
    grasps: float  # expected number of grasps


def operating_characteristic(share, batch=verdict.BATCH, most=verdict.MOST):
    """Operating characteristic and average sample number of the test, exactly.

    The distribution of the number of losses is followed from batch to batch.

    Args:
      share: Share of its grasps that the design keeps.
      batch: Grasps between two looks.
      most: Most grasps.
    """
    undecided = np.ones(1)
    ends = np.zeros(2)
    expected = 0.0
    total = 0
    while total < most:
        count = min(batch, most - total)
        total += count
        losses = stats.binom.pmf(np.arange(count + 1), count, 1 - share)
        undecided = np.convolve(undecided, losses)
        ratio = verdict.evidence(total - np.arange(undecided.size), total)
        decided = ratio >= verdict._DECISIVE - 1e-9, ratio <= -verdict._DECISIVE + 1e-9
        now = np.array([undecided[region].sum() for region in decided])
        ends += now
        expected += total * now.sum()
        undecided = np.where(decided[0] | decided[1], 0.0, undecided)
    undecided_share = float(undecided.sum())
    return Characteristic(
        float(ends[0]), float(ends[1]), undecided_share, float(expected + total * undecided_share)
    )


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9, 0.925, 0.95, 0.97, 0.99, 1.0])
def test_the_characteristic_of_the_test_is_exact(share):
    """By the closed form of a design that loses nothing, and by all sequences of a short test."""
    for batch, most in ((1, 600), (20, 600), (20, 90)):
        characteristic = operating_characteristic(share, batch, most)
        assert sum(characteristic[:3]) == pytest.approx(1)
        # The errors that are promised, at any number of looks.
        assert share > verdict.POOR or characteristic.good <= verdict.ERROR
        assert share < verdict.WANTED or characteristic.not_good <= verdict.ERROR
        assert characteristic.grasps <= most
    if share == 1.0:
        alone = np.log(1 / verdict.ERROR) / np.log(verdict.WANTED / verdict.POOR)
        assert operating_characteristic(share, 1).grasps == np.ceil(alone) == 56
        assert operating_characteristic(share).grasps == 60
    batch = 2
    most = 12
    looks = range(batch, most + 1, batch)
    words = {(kept, n): verdict.judge(kept, n).word for n in looks for kept in range(n + 1)}
    ends = dict.fromkeys(("good", "not good", "not enough trials"), 0.0)
    grasps = 0.0
    for sequence in itertools.product((1, 0), repeat=most):
        chance = share ** sum(sequence) * (1 - share) ** (most - sum(sequence))
        for total in looks:
            word = words[sum(sequence[:total]), total]
            if word != "not enough trials" or total == most:
                ends[word] += chance
                grasps += chance * total
                break
    characteristic = operating_characteristic(share, batch, most)
    assert [*characteristic] == pytest.approx([*ends.values(), grasps], abs=1e-12)


def test_the_page_has_the_numbers_of_the_test():
    """Expected grasps and chances, of a row for each share."""
    page = (ROOT / "docs" / "verdict.md").read_text(encoding="utf-8")
    table = page.split("| true share |")[1].split("\n\n")[0].splitlines()[2:]
    shares = []
    for row in table:
        share, *numbers = [float(cell.strip(" %<")) for cell in row.strip("|").split("|")]
        good, bad, undecided, grasps = operating_characteristic(share / 100)
        expected = [grasps, 100 * good, 100 * bad, 100 * undecided]
        np.testing.assert_allclose(numbers, expected, atol=0.051)  # a digit behind the point
        shares.append(share)
    assert {90, 95, 97, 99, 100} <= {*shares}
    assert verdict.USUAL == round(operating_characteristic(0.99).grasps)


@pytest.mark.parametrize(
    ("outcomes", "most", "known", "expected"),
    [
        ([0] * 60, 600, 0, 60),  # none lost
        ([3] * 60, 600, 0, 20),  # all lost
        ([0] * 60, 600, 24, 64),  # those of a stored test count; batches keep their size
        ([0] * 60, 50, 0, 50),  # the last batch is cut
        ([0] * 60, 600, 60, 60),  # nothing to simulate
        ([0] * 60, 24, 30, 30),  # fewer are asked for than there are
        ([3] + [0] * 99, 600, 0, 80),
    ],
)
def test_trials_go_on_until_they_decide(outcomes, most, known, expected):
    """Batches follow one another, of one size; what is known is not simulated again."""
    cost = np.array(outcomes + [0] * 20, float)
    every = trials_of(cost, np.zeros(len(cost)), lost=np.flatnonzero(cost))
    calls = []

    def simulate(first, count):
        calls.append((first, count))
        return jax.tree.map(lambda v: v[first : first + count], every)

    previous = jax.tree.map(lambda v: v[:known], every) if known else None
    batches = [*verdict.sequential(simulate, most, previous)]
    assert [first for first, _ in calls] == [*range(known, expected, min(20, most))]
    assert len({count for _, count in calls}) <= 1
    end = batches[-1] if batches else previous
    np.testing.assert_array_equal(end.cost, every.cost[:expected])


def test_a_verdict_is_a_sentence():
    """A share below a limit is not rounded to it."""
    sentence = verdict.judge(97, 100).sentence()
    assert sentence == "keeps 97 % of 100 fresh grasps (92 to 99 %): good"
    sentence = verdict.judge(128, 138).sentence()
    assert sentence.startswith("keeps 93 % of 138") and "more than 10,000 more at" in sentence
    assert "keeps 99.6 % of 250 grasps of its" in verdict.judge(249, 250).sentence("grasps of its")
    tiny = scene.load(TINY)
    kept = Judged(tiny, trials_of([0.0] * 3, [0] * 3), "fine")
    assert str(kept).endswith(
        "(44 to 100 %): not enough trials, 53 more at this share would decide"
    )
    text = "kept 3 of 3, 0 lost, 0 not released; mean cost 0.0000; accuracy fine, steps of 20 ms, "
    assert kept.details.startswith(text)
    broken = str(Judged(tiny, trials_of([3.0] * 3, [Status.NONFINITE] * 3)))
    assert broken == "no verdict: every trial failed (NONFINITE 3)"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({}, "objects of 50 g, friction 0.7"),
        ({"objects.object.sphere.mass": 0.3}, "objects of 50 to 300 g, friction 0.7"),
        ({"objects.noise.mass_range": 10.0}, "objects of 50 to 500 g, friction 0.7"),
        ({"objects.object.sphere.friction": 0.4}, "objects of 50 g, friction 0.4 to 0.7"),
        ({"effects.friction": "none"}, "objects of 50 g, no friction"),
    ],
)
def test_a_verdict_names_what_it_holds_for(overrides, words):
    rubbing = {f"objects.object.{shape.name}.friction": 0.7 for shape in PAPER.objects.object}
    rubbing_scene = scene.load("paper", overrides=rubbing | overrides)
    judged = Judged(rubbing_scene, trials_of([0.0] * 60, [0] * 60))
    text = f"keeps 100 % of 60 fresh grasps of {words} (94 to 100 %): good; "
    assert str(judged) == f"{text}other conditions not tried"


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        # Wilson's closed form begins at 0.646 for 11 of 12 and at 1 / (1 + z²/12) = 0.757 for 12.
        ((12, 12, 11, 12, 11), "holds under all 3 other conditions (each at least 65 %)"),
        # The design as it is, here 0, is none of them.
        ((0, 12, 12, 12, 12), "holds under all 3 other conditions (each at least 76 %)"),
        ((12, 5, 12, 12, 12), "not with objects of 500 g (42 %)"),
        ((12, 12, 7, 12, 12), "not with friction 0.4 on the hand (58 %)"),
        ((12, 12, 12, 12, 1), "not with draws (54 %)"),
        ((12, 10, 10, 0, 0), "not with objects of 500 g (83 %), friction 0.4 on the hand (83 %), "),
    ],
)
def test_a_second_word_names_conditions_under_which_it_does_not_hold(kept, words):
    """Draws of other constants are one condition."""
    names = (stress.AS_IT_IS, "objects of 500 g", "friction 0.4 on the hand", "draws", "draws")
    result = stress.Stress(names, np.array(kept), 12, ())
    assert result.limits.startswith(words)
    judged = Judged(PAPER, trials_of([0.0] * 60, [0] * 60), stress=result)
    assert str(judged).endswith(f": good; {result.limits}")


@pytest.mark.parametrize(
    ("rule", "mean", "mean_in_words"),
    [
        ("exclude", "0.5000", "mean cost 0.5000 without the 1 that failed"),
        ("worst", "1.3333", "mean cost 1.3333 with 3 for each of the 1 that failed"),
    ],
)
def test_verdicts_count_all_trials_and_means_follow_the_rule(rule, mean, mean_in_words):
    """Costs 0, 1 and a failed trial: 1/2 without it, (0 + 1 + 3) / 3 with it as the worst."""
    tiny = scene.load(TINY, overrides={"cost.failure": rule})
    outcomes = trials_of([0.0, 1.0, 3.0], [0, Status.SOLVER_CAP, Status.STUCK], lost=[1])
    judged = Judged(tiny, outcomes)
    row = sentences.of_trials(tiny, outcomes)
    ends = "kept 1 of 3, 1 lost (1 thrown in the shaking), 1 not released"
    assert row == f"{ends}; {mean_in_words}; warnings: SOLVER_CAP 1"
    assert str(judged).startswith("keeps 33 % of 3 fresh") and row in judged.details
    [warning] = sentences.warnings(judged)
    assert warning.startswith("warning: 1 of 3 trials failed (STUCK 1); STUCK: the hand did not")
    assert ("--set cost.failure=worst" in warning) == (rule == "exclude")
    alone = sentences.of_trials(tiny, trials_of([3.0], [Status.STUCK]))
    assert alone.endswith("no mean cost" if rule == "exclude" else "1 that failed")


def trials_of(cost, status, lost=()):
    """Outcomes of trials; the indices in `lost` lost their objects at 1 s."""
    times = np.where(np.isin(np.arange(len(cost)), list(lost)), 1.0, np.inf)
    return Outcome(np.array(cost), np.array(status, int), times, np.full(len(cost), -1))


LIFTED = scene.load(TINY).phase_ends["lift"]


@pytest.mark.parametrize(
    ("status", "times", "counts"),
    [
        ([0, 0], [np.inf, np.inf], (0, 0, 0)),
        ([Status.UNMOVED, 0, 0], [LIFTED - 0.1, LIFTED - 0.1, LIFTED + 0.1], (1, 1, 1)),
        ([Status.UNMOVED | Status.SOLVER_CAP, 0], [LIFTED + 0.1, np.inf], (1, 0, 0)),
        ([Status.STUCK, Status.SPEED, 0], [np.inf, np.inf, LIFTED], (0, 0, 1)),
    ],
)
def test_every_lost_trial_has_a_cause(status, times, counts):
    n = len(status)
    outcomes = Outcome(np.zeros(n), np.array(status, int), np.array(times), np.full(n, -1))
    causes = verdict.losses(scene.load(TINY), outcomes)
    assert causes == counts and sum(causes) == verdict.tally(outcomes).lost
    texts = str(causes).split(", ") if any(counts) else []
    assert len(texts) == sum(n > 0 for n in counts)


ANEW = ["--seed 4 --out runs/a-seed4", "--episodes 60"]
SEARCH = ["codesign", "optimize", "--preset", "23d", "--seed=3", "--out", "runs/a", "--fresh"]


@pytest.mark.parametrize(
    ("kept", "total", "words", "commands"),
    [
        (60, 60, SEARCH, []),
        (57, 60, SEARCH, ["--reference-trials 600"]),  # undecided
        (128, 138, SEARCH, [*ANEW, "--hand pneuflex4_wide"]),  # undecided for long
        (10, 60, SEARCH, [*ANEW, "--hand pneuflex4_wide"]),
        (10, 60, ["codesign", "optimize", "--seeds", "0-3"], ["--episodes 60", "pneuflex4_wide"]),
        (10, 60, ["demo.py", "--fresh"], [*ANEW, "--hand pneuflex4_wide"]),
    ],
)
def test_what_is_not_good_is_followed_by_commands_to_try(kept, total, words, commands):
    """Each is a command of this run with other flags, which the parser of flags takes."""
    settings = runs.make_settings("23d", "concurrent", "morphology", "structured", 3, episodes=30)
    judged = Judged(PAPER, trials_of([0.0] * total, [0] * total, lost=range(total - kept)))
    tips = advice.after_search(judged, settings, words, Path("runs/a"))
    assert len(tips) == len(commands)
    for tip, text in zip(tips, commands, strict=True):
        assert text in " ".join(tip.command)
        options = tyro.cli(cli.COMMANDS, args=tip.command)
        assert options.fresh is False and options.seeds == ("0-3" if "--seeds" in words else None)


def test_a_design_that_keeps_little_of_its_own_test_is_not_tested_further():
    """Nothing to judge at `reference`: the test that chose it flatters it."""
    every = [(0, 48, True), (0, 3, False), (16, 48, True), (24, 48, False), (48, 48, False)]
    for kept, total, hopeless in every:
        trials = trials_of([0.0] * total, [0] * total, lost=range(total - kept))
        assert fresh_trials.hopeless(trials) == hopeless, (kept, total)


@pytest.mark.parametrize(
    ("overrides", "warning"),
    [
        ({}, None),
        ({"objects.object.cylinder.size": [0.03, 0.08]}, "--set arm.start_height=0.37"),
        ({"objects.object.cylinder.size": [0.03, 0.08], "arm.start_height": 0.37}, None),
        ({"objects.object.cuboid.size": [0.03, 0.03, 0.1]}, "object 'cuboid' is 200 mm high"),
        (
            {
                "hand.material": {
                    "law": "neo_hookean",
                    "shear_modulus": 1.07e6,  # Smooth-Sil 950, see docs/measurements.md
                    "density": 1240.0,
                    "damping_time": 0.003,
                }
            },
            "too little to close",
        ),
    ],
)
def test_what_a_scene_makes_impossible_is_told_before(overrides, warning):
    """Fingers that begin inside a tall object, and those that hardly bend."""
    the_scene = scene.load("paper", overrides=overrides)
    longest = parameters.design_space(the_scene.hand, "full")
    params = longest.params(np.where(longest.is_morphology, longest.high, longest.default()))
    designs = jax.tree.map(lambda v: np.asarray(v)[None], params)
    texts = preflight.warnings(the_scene, designs, ["it"])
    assert [warning in text for text in texts] == ([True] if warning else []), texts


# --- a design under other conditions, and what is amiss with the design itself --------------------


PAPER = scene.load("paper")
SPACE = parameters.design_space(PAPER.hand, "full")
HAND = jax.tree.map(np.asarray, SPACE.params(SPACE.default()))


def test_conditions_are_numbers_within_the_files_ranges():
    """Masses are four and ten times as large, at most 500 g; what is not named stays."""
    variants = [*stress.variants(PAPER)]
    names = [name for name, _ in variants]
    assert names[:3] == ["objects of 200 g", "objects of 500 g", "friction 0.4 on the hand"]
    assert len(names) == 3 + stress.DRAWS and len({*names[3:]}) == 1
    for _, other in variants:
        constants.check(other)
        assert other.phases == PAPER.phases and other.hand.palm == PAPER.hand.palm
    assert [o.mass for o in variants[1][1].objects.object] == [0.5] * 3
    ratio = [c.contact.normal_stiffness / PAPER.contact.normal_stiffness for _, c in variants[3:]]
    table = {entry.key: entry for entry in stress.unknown(PAPER).constant}
    stiffness = table["contact.normal_stiffness"]
    assert len({*ratio}) == len(ratio)
    assert stiffness.low <= min(ratio) and max(ratio) <= stiffness.high
    # The modulus within what was measured of the silicone, and not what the scene draws itself.
    modulus = table["hand.material.shear_modulus"]
    assert (modulus.low, modulus.high) == (1.0, pytest.approx(101 / 88))
    drawn = dataclasses.replace(PAPER, drawn=draws.Constants(constant=(stiffness,)))
    left = {entry.key for entry in stress.unknown(drawn).constant}
    assert table.keys() - left == {"contact.normal_stiffness"}
    masses = {f"objects.object.{o.name}.mass": 0.18 for o in PAPER.objects.object}
    heavy = scene.load("paper", overrides=masses | {"objects.object.sphere.mass": 0.7})
    [(name, numbers), (after, _), *_] = stress.variants(heavy)
    assert (name, after) == ("objects of 500 to 700 g", "friction 0.4 on the hand")
    assert [o.mass for o in numbers.objects.object] == [0.5, 0.5, 0.7]


def placed():
    """A state: fingers a metre apart, links in a row, all turned alike and without pressure."""
    lay = model.layout(PAPER)
    place = np.zeros((1, len(lay.centre_weights), 3))
    for f, bodies in enumerate(lay.bodies):
        segment = HAND.length[f] / lay.links
        place[0, bodies] = np.c_[segment * np.arange(lay.links), np.full((lay.links, 2), f + 1.0)]
    turn = np.broadcast_to(np.eye(3), (*place.shape[:2], 3, 3))
    return lay, place, turn, np.ones((*place.shape[:2], 2))


def test_overlaps_are_depths_of_sections():
    """A bottom face that is d below another section's top is d deep, in itself and in others."""
    lay, place, turn, size = placed()
    alone = overlap.overlaps(PAPER, HAND, place, turn, size)
    assert not alone.fingers.any() and not alone.palm.any()
    depth = 0.004
    height = float(HAND.height[0])
    place[0, lay.bodies[1]] = place[0, lay.bodies[0]] + [0, 0, height - depth]
    depths = overlap.overlaps(PAPER, HAND, place, turn, size).fingers[0]
    # To first order: the rounded outline is 1 % nearer beside the middle.
    assert depths[1, 0] == pytest.approx(depth, rel=0.02) == depths[0, 1]
    depths[1, 0] = depths[0, 1] = 0
    assert not depths.any()
    lay, place, turn, size = placed()
    place[0, lay.bodies[2][7]] = place[0, lay.bodies[2][1]] + [0, 0, height - depth]
    place[0, lay.bodies[3][5]] = [0, 0, PAPER.hand.palm.thickness - depth]
    overlaps = overlap.overlaps(PAPER, HAND, place, turn, size)
    assert overlaps.fingers[0, 2, 2] == pytest.approx(depth, rel=0.02)
    assert overlaps.palm[0] == pytest.approx([0, 0, 0, depth])
    words = stress.of_overlaps(PAPER, HAND, [overlaps])
    assert words[0] == "finger 2 stands 4 mm deep in itself"
    assert words[1] == "finger 3 stands 4 mm deep in the palm" and len(words) == 2
    without = scene.load("paper", overrides={"effects.finger_itself": False})
    words = stress.of_overlaps(without, HAND, [overlaps])
    assert words[0].endswith("deep in itself: the simulation has no such contact")


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
    height = 0.02
    wall = 0.004
    width = 0.024
    modulus = 35e3
    strain = 1.3
    properties = {"width": width, "shear_modulus": modulus, "neo_hookean": neo_hookean}
    pressure = beams.strain_pressure(strain, np.array(height), np.array(wall), **properties)

    def stress_at(e):
        return modulus * (1 + e - (1 + e) ** -3) if neo_hookean else 4 * modulus * e

    def moment(curvature):
        def block(breadth, low, high):
            return breadth * integrate.quad(lambda y: stress_at(curvature * y) * y, low, high)[0]

        return block(width, 0, height) - block(width - 2 * wall, wall, height - wall)

    chamber = (width - 2 * wall) * (height - 2 * wall) * height / 2
    curvature = optimize.brentq(lambda k: moment(k) - pressure * chamber, 1.0, 500.0)
    assert curvature * height == pytest.approx(strain, rel=1e-6)
