"""`codesign evaluate`: rows and verdict of a design, of its own or of a run."""

import csv
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import stats

from codesign_jax import rollout, runs, scene
from codesign_jax.commands import common
from codesign_jax.report import verdicts
from codesign_jax.report.verdicts import Judged
from codesign_jax.runs import columns
from codesign_jax.scene import parameters
from codesign_jax.types import Outcome, Status
from tests.helpers.command_runs import command, finished_run, own_workplace  # noqa: F401
from tests.helpers.toy_engine import TINY

ROOT = Path(__file__).parents[1]


def test_what_is_not_given_is_said_to_be_a_default(capsys):
    """One value for all fingers where the space has one for each."""
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
    assert command("evaluate", "--dry-run", *twice) == 2
    assert "'length[1]' is given more than once: 95, 90" in capsys.readouterr().err


def test_a_design_is_opened_from_its_file(workplace, capsys):
    """As it was written, in its own design space, and with what the command line changes."""
    space = parameters.design_space(scene.load("paper").hand, "23d")
    design = np.asarray(space.sample(jax.random.key(3), 1)[0])
    text = common.design_text(space, "23d", design)
    (workplace / "mine.toml").write_text(text)
    assert tomllib.loads(text)["preset"] == "23d"
    opened = common.find_design(space, ["mine.toml"])
    np.testing.assert_allclose(opened, design, rtol=1e-8)  # nine digits
    assert command("evaluate", "--dry-run", "--design", "mine.toml", "length[1]=90") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    lengths = [f"{v:.4g}" for v in 1e3 * design[:4]]
    assert ["1", "90"] == rows[4][:2] and [row[1] for row in rows[5:7]] == lengths[2:]
    assert not any("defaults:" in row for row in rows)
    (workplace / "wrong.toml").write_text(
        "design.lenght = 95\ndesign.arm_z = [1, 2]\npreset = '2d'"
    )
    assert command("evaluate", "--dry-run", "--design", "wrong.toml") == 2
    told = capsys.readouterr().err
    assert "wrong.toml 'lenght' is not a parameter; did you mean 'length'?" in told
    assert "wrong.toml 'arm_z[0]' is not a parameter" in told


def test_a_table_of_trials_has_noise_and_endings(finished, tmp_path, capsys):
    """Of any final particle: the noise is that of the seed, and endings add up to the verdict."""
    rows = [line.split(",") for line in (finished / "tests.csv").read_text().splitlines()[1:]]
    table, seed = tmp_path / "new" / "trials.csv", 4
    asked = ["evaluate", finished, "--particle", "1", "--trials", "3", "--seed", seed]
    assert command(*asked, "--out", table) == 0
    output = capsys.readouterr().out
    assert f"particle 1 of {finished}" in output and f"length={float(rows[1][-2]):.4g} mm" in output
    with table.open(newline="") as file:
        found = [*csv.DictReader(file)]
    assert [*found[0]] == [*columns.MORE[columns.REFERENCE].columns]
    drawn = rollout.sample_trials(runs.read_run(finished)[0], jax.random.key(seed), 3)
    for row, x, mass in zip(found, drawn.position[:, 0], drawn.mass, strict=True):
        assert float(row["noise_x_m"]) == pytest.approx(float(x), rel=1e-6)
        assert float(row["noise_mass_factor"]) == pytest.approx(float(mass), rel=1e-6)
    kept = sum(row["verdict"] == "kept" for row in found)
    assert f"all: kept {kept} of 3, " in output
    for wrong, words in (
        ([finished, "--particle", "99"], "--particle = 99 is outside"),
        (["--particle", "0"], "--particle is one of a run"),
        (["--out", "trials.txt"], "--out trials.txt must end in .csv"),
    ):
        assert command("evaluate", *wrong) == 2
        assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kept", "total", "word", "more"),
    [
        (24, 24, "good", 0),
        (143, 150, "good", 0),
        (18, 24, "not good", 0),
        (137, 150, "not good", 0),
        (6, 6, "not enough trials", 16),
        (29, 30, "not enough trials", 6),
        (27, 30, "not enough trials", 43),
        (142, 150, "not enough trials", 16_273),
    ],
)
def test_one_rule_judges_designs(kept, total, word, more):
    found = verdicts.judge(kept, total)
    assert (found.word, found.more) == (word, more)
    low, high = stats.binomtest(kept, total).proportion_ci(0.95, method="wilson")
    assert (found.share.low, found.share.high) == pytest.approx((low, high))


def test_verdicts_are_those_of_intervals_and_monotone():
    """By SciPy's interval; one more grasp that is kept never makes a verdict worse, a lost one
    never better, so that it may be looked at as trials go on."""
    rank = {"not good": 0, "not enough trials": 1, "good": 2}

    def of(kept, total):
        return rank[verdicts.judge(kept, total).word]

    for total in (1, 5, 20, 22, 24, 49, 150, 300):
        for kept in range(total + 1):
            low, high = stats.binomtest(kept, total).proportion_ci(0.95, method="wilson")
            good, bad = kept >= 0.95 * total and low > 0.85, kept < 0.95 * total and high < 0.95
            assert of(kept, total) == 1 + good - bad
            assert of(kept, total + 1) <= of(kept, total) <= of(kept + 1, total + 1)


def test_a_verdict_is_a_sentence():
    """A share below a limit is not rounded to it. The front page states the rule word by word."""
    front_page = " ".join((ROOT / "README.md").read_text().split()).lower()
    assert verdicts.RULE.lower() in front_page
    said = verdicts.judge(143, 150).sentence()
    assert said == "keeps 95 % of 150 fresh grasps (91 to 98 %): good"
    said = verdicts.judge(142, 150).sentence()
    assert said.startswith("keeps 94.6 % of 150") and "more than 10,000 more at" in said
    assert "keeps 99.6 % of 250 grasps of its" in verdicts.judge(249, 250).sentence("grasps of its")
    tiny = scene.load(TINY)
    kept = Judged(tiny, trials_of([0.0] * 3, [0] * 3), "fine")
    assert str(kept).endswith(
        "(44 to 100 %): not enough trials, 19 more at this share would decide"
    )
    how = "kept 3 of 3, 0 lost, 0 stuck; mean cost 0.0000; accuracy fine, steps of 20 ms, 3 links"
    assert kept.details.startswith(how)
    broken = str(Judged(tiny, trials_of([3.0] * 3, [Status.NONFINITE] * 3)))
    assert broken == "no verdict: every trial failed (NONFINITE 3)"


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
    found = trials_of([0.0, 1.0, 3.0], [0, Status.SOLVER_CAP, Status.STUCK], lost=[1])
    judged = Judged(tiny, found)
    row = verdicts.of_trials(tiny, found)
    assert row == f"kept 1 of 3, 1 lost, 1 stuck; {mean_in_words}; warnings: SOLVER_CAP 1"
    assert str(judged).startswith("keeps 33 % of 3 fresh") and row in judged.details
    [warning] = verdicts.warnings(judged)
    assert warning.startswith("warning: 1 of 3 trials failed (STUCK 1); STUCK: the hand did not")
    assert ("--set cost.failure=worst" in warning) == (rule == "exclude")
    alone = verdicts.of_trials(tiny, trials_of([3.0], [Status.STUCK]))
    assert alone.endswith("no mean cost" if rule == "exclude" else "1 that failed")


def trials_of(cost, status, lost=()):
    """Outcomes of trials; the indices in `lost` lost their objects at 1 s."""
    times = np.where(np.isin(np.arange(len(cost)), list(lost)), 1.0, np.inf)
    return Outcome(np.array(cost), np.array(status, int), times, np.full(len(cost), -1))
