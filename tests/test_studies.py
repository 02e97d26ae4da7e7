"""Studies: constants, rates, searches, accuracy, and the paper's experiments, by known answers."""

import dataclasses
import itertools
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.stats

from codesign_jax import cli, codesign, rollout, runs, scene
from codesign_jax.commands import run_settings
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import world_model
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import draws, parameters, silicones
from codesign_jax.types import Outcome
from scripts import benchmark, calibration, reality, uncertainty
from scripts.accuracy import budget, decisions, report
from scripts.agree import __main__ as agree
from scripts.agree import judgement, sides
from scripts.calibration import OPEN
from scripts.experiments import fresh, join, results, simulate
from scripts.experiments import report as experiments_report
from scripts.experiments.simulate import PAPER, TOTAL_GRASPS
from scripts.search import __main__ as search
from scripts.search import tables as search_tables
from scripts.search import turbo
from scripts.shared import lock_step, output, statistics, work
from tests.helpers import toy_engine
from tests.helpers.toy_engine import tiny


def test_sets_fill_their_ranges_and_every_beginning_does():
    units = calibration.space_filling(64, seed=3)
    np.testing.assert_array_equal(units[:16], calibration.space_filling(16, seed=3))
    # A Sobol sequence has one of its first 16 points in each sixteenth of every axis.
    for column in units[:16].T:
        assert sorted(np.floor(16 * column)) == list(range(16))
    constants = calibration.values(units)
    for name, o in OPEN.items():
        assert o.low <= constants[name].min() and constants[name].max() <= o.high
    middle = calibration.values(np.full((1, len(OPEN)), 0.5))
    assert middle["mass"] == pytest.approx(np.sqrt(20 * 300)) and middle["tilt"] == 60.0
    assert (constants["pair_gap"] >= constants["width"] + 2.0).all()


def wells(ridge=2.6, floor=2.6):
    """Two wells of 12 and 6 cells on a plain; the row between them has the ridge's cost."""
    cost = np.full((12, 12), floor)
    cost[1:4, 2:6] = 0.0
    cost[7:9, 3:6] = 0.2
    cost[4:7, 3] = ridge
    return cost


def test_a_saddle_is_where_two_wells_part():
    assert calibration.saddle(wells()) == 2.5
    # Apart at 0.875, the last rung of the ladder below the ridge.
    assert calibration.saddle(wells(0.9)) == 0.875 and calibration.saddle(wells(0.4)) == 0.0
    corner = np.full((12, 12), 3.0)
    corner[2:4, 2:4] = corner[4:6, 4:6] = 0.0  # they meet at a corner only
    assert calibration.saddle(corner) == 0.0


def linear_hand(modulus):
    """The default hand with a modulus [kPa] under the linear law."""
    law = {"hand.material.law": "linear", "hand.material.shear_modulus": 1e3 * modulus}
    return scene.load("paper", overrides=law).hand


def test_a_second_wave_is_near_the_best_of_the_first(tmp_path):
    units = calibration.space_filling(40, seed=1)
    distances = np.abs(units[:, :3] - 0.5)  # the best are in the middle of three ranges
    near = calibration.near_best(units, distances, 30, seed=2)
    np.testing.assert_array_equal(near[:8], calibration.near_best(units, distances, 8, seed=2))
    best = units[np.argsort(distances.max(-1))[: calibration.BEST]]
    assert 0 <= near.min() and near.max() <= 1
    for k, mine in enumerate(near):
        # Reflected at the ends of a range a set is no farther away.
        assert np.abs(mine - best[k % len(best)]).max() <= calibration.NEAR
    # A file of scores is read by its constants' names; one of fewer is refused.
    path = tmp_path / "scores.npz"
    names = [*OPEN]
    more = np.insert(units, 4, 0.5, axis=1)
    arrays = dict(units=more, distances=distances, names=[*names[:4], "shear_modulus", *names[4:]])
    output.write_arrays(path, arrays)
    np.testing.assert_array_equal(calibration.load_scores(path)[0], units)
    output.write_arrays(path, dict(units=units[:, 1:], distances=distances, names=names[1:]))
    with pytest.raises(scene.InputError, match="has no constant tilt"):
        calibration.load_scores(path)
    # So are costs of other sets.
    wave = tmp_path / "wave.npz"
    output.write_arrays(wave, dict(units=units, costs=np.zeros((7, 2, 2, 3))))
    assert len(calibration.load_costs(wave, units)) == 7
    assert len(calibration.load_costs(wave, np.concatenate([units[:9], near]))) == 7
    with pytest.raises(scene.InputError, match="has other sets"):
        calibration.load_costs(wave, near)
    lines = calibration.summary(units, {"middle": 9 * distances[:, 0], "first": distances[:, 1]})
    assert lines[0] == f"{(9 * distances[:, 0] <= 3).sum()} of 40 sets are not ruled out"
    assert [line.split()[0] for line in lines[4:-1]] == names


def test_statements_rule_out_what_they_should():
    """Flat landscapes on which nothing, or everything, succeeds; two wells are two regions."""
    paper = scene.load("paper")
    flat = [np.full((12, 12), c) for c in (0.0, 2.5)]
    costs = np.repeat(np.array([*flat, wells()])[..., None], 6, -1)
    constants = calibration.values(np.stack([calibration.own_set(paper)] * 3))
    np.testing.assert_allclose(constants["cost_maximum"], paper.cost.maximum, rtol=1e-9)
    scores = calibration.score(costs, constants, paper)
    # p M_p h / EI is 1.707 at 25 mm of height, 2 mm of wall, 80 kPa and 35 kPa, and goes by 1/G.
    soft = linear_hand(35.0)
    [strain, *same] = calibration.free_strain(constants, soft, neo_hookean=False)
    assert strain == pytest.approx(1.707, abs=1e-3) and same == [strain] * 2
    # A neo-Hookean wall of the same modulus is up to four times softer at large strain.
    softer = calibration.free_strain(constants, soft, neo_hookean=True)
    assert softer[0] > 1.5 * strain
    own_strain = calibration.free_strain(
        constants, paper.hand, neo_hookean=bool(paper.effects.neo_hookean)
    )
    np.testing.assert_allclose(scores["free strain"], np.maximum(own_strain - 1.5, 0) / 0.06)
    good, bad, two = (({n: d[i] for n, d in scores.items()}) for i in range(3))
    assert good["solutions"] == 0 and good["poor seeds"] > calibration.CUTOFF
    assert good["420 simulations"] > calibration.CUTOFF, "after the first episode"
    assert bad["solutions"] == pytest.approx(2.0) and bad["single is poor"] > calibration.CUTOFF
    assert two["two regions"] == two["solutions"] == two["poor seeds"] == 0
    assert good["two regions"] == bad["two regions"] == pytest.approx(1 / 0.3)


def test_a_set_remains_by_all_statements_or_without_the_last(tmp_path):
    """One set beyond the last statement only, one beyond another, one beyond none."""
    path = tmp_path / "scores.npz"
    units = calibration.space_filling(3, seed=5)
    distances = [[0.0, 3.1], [3.1, 0.0], [3.0, 3.0]]
    output.write_arrays(path, dict(units=units, distances=distances, names=[*OPEN]))
    np.testing.assert_array_equal(calibration.remaining_sets(path), units[[2]])
    np.testing.assert_array_equal(calibration.remaining_sets(path, strain=False), units[[0, 2]])


@pytest.mark.parametrize("table", (calibration.laws_table, calibration.constants_table))
def test_the_page_has_the_tables_of_its_scores(table):
    scenes = [scene.load("paper")] if table is calibration.constants_table else []
    assert table(*scenes) in calibration.PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("ties", (False, True))
def test_rank_correlation_equals_its_definition(ties):
    rng = np.random.default_rng(1)
    a = rng.normal(size=300)
    b = rng.normal(0.3, 1.0, size=300)
    a, b = (np.round(a), np.round(b)) if ties else (a, b)
    x, y = (scipy.stats.rankdata(v) for v in (a, a + b))
    assert statistics.spearman(a, a + b) == pytest.approx(np.corrcoef(x, y)[0, 1], abs=1e-12)


@pytest.mark.parametrize("page", benchmark.PAGES)
def test_tables_of_the_pages_are_those_of_the_data(page):
    text = (benchmark.ROOT / page).read_text(encoding="utf-8")
    files = benchmark.read()
    for mark in benchmark.PAGES[page]:
        [shown] = re.findall(f"<!-- {mark}:begin -->\n\n(.*?)\n\n<!-- {mark}:end -->", text, re.S)
        assert shown == benchmark.TABLES[mark](files)


def test_measured_silicones_are_those_of_the_page():
    text = (reality.DOCS / "measurements.md").read_text(encoding="utf-8")
    for mark, rows in (("laws", reality.law_rows()), ("silicones", reality.silicone_rows())):
        assert f"<!-- {mark}:begin -->\n\n{output.markdown(rows)}\n\n<!-- {mark}:end -->" in text
    # Of a material that is neo-Hookean the law is exact, and the other one has the fixed ratio.
    modulus, errors = reality.fitted_law(lambda e: 30 * reality.neo_hookean(e), *NEO)
    assert modulus == pytest.approx(30) and np.abs(errors).max() < 1e-4  # of the grid of strains
    other, _ = reality.fitted_law(lambda e: 30 * reality.neo_hookean(e), *LINEAR)
    assert modulus / other == pytest.approx(silicones.EQUAL_BEND, rel=1e-3)
    modulus, _ = reality.fitted_law(reality.plane_strain(), NEO[0], NEO[1][:-1])
    assert 1e3 * modulus == pytest.approx(silicones.get("ecoflex_00_30").shear_modulus, rel=2e-3)
    names = [
        name.removesuffix(" Medium") for name in (s.name for s in silicones.SILICONES.values())
    ]
    tension = reality.tension()
    for name, s in zip(names, silicones.SILICONES.values(), strict=True):
        modulus, _ = reality.fitted_law(tension[name], *NEO)
        assert 1e3 * modulus == pytest.approx(s.crosshead_modulus, rel=5e-3)  # three digits


NEO, LINEAR = ((law, reality.STRAINS) for law in (reality.neo_hookean, reality.linear))


def test_a_ring_down_is_read_from_its_peaks():
    """Of a decaying cosine, in steps of a twentieth of its period."""
    time = np.arange(1, 261) * 0.01
    drop = 5.0 * (1 - np.exp(-1.5 * time) * np.cos(2 * np.pi * time / 0.2))
    ring = reality.Ring.of(time, drop)
    # Parabolas through a cosine's three points, and what still swings at the end.
    np.testing.assert_allclose(ring, [5.0, 0.2, 0.3], rtol=2e-3)
    assert np.isnan(reality.Ring.of(time, 1 - np.exp(-time / 0.1)).decrement)


def test_a_trust_region_grows_shrinks_and_starts_anew_by_the_rules_of_turbo():
    """Eriksson et al. 2019, section 2: sides of 0.8, at most 1.6, anew below 2^-7."""
    region = turbo.Region()
    sides = []
    for cost in (3.0, 2.0, 1.0, 0.9, 0.8, 0.7, 0.6):
        region = region.after(np.array([cost, 3.0]), count=0, patience=4)
        sides.append(region.length)
    assert sides == [0.8, 0.8, 1.6, 1.6, 1.6, 1.6, 1.6]
    for batch in range(4 * 8 - 1):
        region = region.after(np.array([0.6]), count=batch, patience=4)
    assert region.length == 1.6 / 2**7 and region.best == 0.6
    assert region.after(np.array([0.6]), count=31, patience=4) == turbo.Region(first=32)


def test_the_middle_of_distributions_is_theirs_without_a_width():
    """Draws of both tables are simulated by one program."""
    table = draws.read("unmeasured")
    wide, narrow = uncertainty.worlds_of(table).values()
    assert wide.structure == narrow.structure
    factors = draws.deviations(narrow.drawn, jax.random.key(0), 4)
    middles = [float(entry.deviation(0.0)) for entry in table.constant]
    np.testing.assert_allclose(factors, np.tile(middles, (4, 1)), rtol=1e-5)
    assert np.ptp(draws.deviations(wide.drawn, jax.random.key(0), 4), axis=0).min() > 0.01


def test_searches_at_two_accuracies_are_compared_by_seed():
    """Pairs that all differ by two points have an interval without width; other rows are left."""
    default = {"optimizer": "screened-es", "hand": None}

    def row(kept, *changes):
        return default | {"kept": [kept], "grasps": [60], "changes": [*changes, "--first=7"]}

    plain = row([0.94, 0.96, 0.90], "--judged=reference")
    coarse = row([0.96, 0.98, 0.92], "--searched=fast", "--judged=reference")
    again = default | {"changes": coarse["changes"]}
    again["retest"] = {"finalists": 9, "lost": 1, "chosen_otherwise": 2}
    other = coarse | {"optimizer": "random", "kept": [[0.5]]}
    rows = [coarse, again, plain, other, row([0.1, 0.2, 0.3])]
    text = search_tables.accuracies_table(rows)
    first, second = (line.split(" | ") for line in text.splitlines()[2:])
    assert first[1] == "`standard`" and first[4:6] == ["93.3", "0.33 (0.06 to 0.79)"]
    assert second[1] == "`fast`" and second[6:] == ["+2.0 (+2.0 to +2.0)", "1 of 9", "2 |"]
    assert search_tables.accuracies_table([row([0.1])]) == ""


def test_a_search_stands_in_the_table_of_what_it_shares_with_others():
    """Accuracies and time are no changes of what is searched; what all rows share is left out."""

    def row(optimizer, *changes, **files):
        made = {"optimizer": optimizer, "changes": [*changes], "kept": [[1.0, 0.5]]}
        made |= {"preset": "23d", "scene": "paper", "grasps": [60]}
        return made | {"provenance": {"commit": "abcdef0123"}} | files

    coarse = ("--searched=fast", "--first=7")
    judged = row("screened-es", *coarse, "--judged=reference")
    timed = [row("turbo:trials=3", "equal time"), row("screened-es", *coarse), judged]
    hands = [
        row("screened-es", *coarse, objects="household"),
        row("screened-es", *coarse, scene="build"),
    ]
    grasps = [row("random"), row("screened-es")]
    left = [row("screened-es", "--judged=reference"), row("screened-es", "hand.x=1", *coarse)]
    texts = search_tables.tables([*timed, *hands, *grasps, *left])
    shown = {mark: [line[2:].split(" | ") for line in t.splitlines()] for mark, t in texts.items()}
    outcome = ["2", "60", "0.750", "0.525", "0.50 (0.09 to 0.91)", "abcdef0 |"]
    assert shown["equal-time"][0][:4] == ["optimiser", "episodes at", "judged at", "seeds"]
    assert shown["equal-time"][2:] == [
        ["`screened-es`", "`fast`", "`reference`", *outcome],
        ["`screened-es`", "`fast`", "`standard`", *outcome],
        ["`turbo:trials=3`", "`standard`", "`standard`", *outcome],
    ]
    assert shown["other-hands"][2:] == [
        ["`build4`", "three", *outcome],
        ["`pneuflex4`", "household", *outcome],
    ]
    assert shown["equal-grasps"][2:] == [["`screened-es`", *outcome], ["`random`", *outcome]]
    assert texts.keys() == {"equal-time", "other-hands", "equal-grasps"}


def test_a_page_of_rates_has_the_last_file_of_each_platform():
    def file(platform, date):
        return {"runs": [{"platform": platform, "date": date}]}

    old = file("gpu", "2026-01")
    new = file("gpu", "2026-02")
    cpu = file("cpu", "2025-12")
    assert benchmark.newest([new, old, cpu]) == [cpu, new]


def test_pairs_of_designs_are_compared_by_seed():
    kept = {
        "under": {"drawn": [0.9, 0.8, 1.0], "middle": [0.9, 0.9, 0.9]},
        "at": {"drawn": [0.8, 0.7, 0.9], "middle": [0.9, 0.9, 0.9]},
    }
    rows, differences = uncertainty.compare(kept)
    np.testing.assert_allclose(differences, 10)
    assert rows[1] == ["under", "90.0", "80", "90.0"]
    assert rows[3] == ["difference, 3 pairs", "+10.0 (+10.0 to +10.0)", "", "+0.0 (+0.0 to +0.0)"]


@pytest.mark.slow  # 19 s
def test_winners_of_a_search_are_judged_at_other_masses(tmp_path):
    """What they keep at a mass is what MuJoCo C says of them in the same trials."""
    sizes = "--preset 2d --optimizers screened-es:particles=6,trials=2,tests=2 --seeds 3 --tests 5"
    arguments = [*sizes.split(), "--marks", "1", "--budget", "50", "--scene", str(toy_engine.TINY)]
    arguments += ["--out", str(tmp_path), "--commit", "abcdef0"]
    assert search.main([*arguments, "--set", "objects.noise.mass_range=10"]) == 0
    [path] = tmp_path.glob("*.json")
    # At equal accuracies no finalist is lost, and none is chosen otherwise.
    assert search.main([*arguments, "--set", "objects.noise.mass_range=10", "--retest"]) == 0
    [again] = (json.loads(p.read_text()) for p in tmp_path.glob("*-retest.json"))
    assert again["retest"] == {"finalists": 9, "lost": 0, "chosen_otherwise": 0}
    masses = ["--masses", "0.05", "2"]
    assert search.main([*arguments, "--designs", str(path.with_suffix(".npz")), *masses]) == 0
    [judged] = (json.loads(p.read_text()) for p in tmp_path.glob("*-masses.json"))
    row = json.loads(path.read_text())
    designs = work.winners(path.with_suffix(".npz"))
    assert row["changes"] == ["objects.noise.mass_range=10"] and len(row["kept"][-1]) == 3
    heavy_scene = scene.load(toy_engine.TINY, overrides={"objects.object.0.mass": 2.0})
    space = parameters.design_space(heavy_scene.hand, "2d")
    engine = make_engine("mujoco", heavy_scene)
    for seed, design in enumerate(designs):
        key = codesign.stream_key(jax.random.key(seed), lock_step.STREAM_JUDGE, 0)
        hand = jax.tree.map(lambda v: v[None], space.params(design))
        outcome = rollout.evaluate(
            heavy_scene, engine, hand, rollout.sample_trials(heavy_scene, key, 5)
        )
        assert judged["masses"]["2"][seed] == np.mean(outcome.cost < codesign.SUCCESS_COST)
    light, heavy = (np.mean(judged["masses"][m]) for m in ("0.05", "2"))
    assert heavy != light
    table = search_tables.masses_table([judged])
    assert "2000 g: kept on average | seeds that keep 95 % | commit |\n" in table


# --- accuracy: presets, the study's variants and tips, its tables of verdicts ---------------------


EXPERIMENTS = Path(__file__).parents[1] / "docs" / "data" / "experiments"


def test_presets_replace_the_scene_s_values_and_overrides_replace_theirs():
    assert scene.load("paper", accuracy="standard") == scene.load("paper")
    fine = scene.load("paper_spheres", accuracy="reference")
    assert fine.discretization == scene.Discretization(0.001, 20, 1, integrator="newmark")
    fast = scene.load("paper_spheres", accuracy="fast", overrides={"discretization": {"links": 7}})
    assert (fast.discretization.links, fast.discretization.timestep) == (7, 0.02)
    for name, tolerance in {
        "fast": 1e-3,
        "standard": 1e-3,
        "fine": 1e-3,
        "reference": 1e-6,
    }.items():
        loaded = scene.load("paper", accuracy=name)
        assert StructuredEngine(loaded).limits.tolerance == tolerance


PRESETS = ("fast", "standard", "fine", "reference")
"""The built-in accuracies, the cheapest first."""


def test_presets_are_ordered_in_steps_and_links():
    assert sorted(PRESETS) == sorted(scene.library.available("accuracy"))
    scenes = [scene.load("paper", accuracy=name) for name in PRESETS]
    sizes = [s.num_steps * s.discretization.links for s in scenes]
    assert sizes == sorted(set(sizes))


@pytest.mark.slow  # the quick test above has the sizes; here they are simulated
def test_presets_are_ordered_in_counted_work_and_in_the_error_of_the_finger_tip():
    """Work: Newton iterations of a grasp times links. Error: against MuJoCo C, see `budget.motion`.

    Each preset costs at least a third more than the one before, and errs at most half as much; on
    two hands and 0.9 s in the air.  `fine` has twice the steps of `standard`, but three quarters of
    the iterations in each: half more, by a percent more or less as programs round.
    """
    work_of = []
    errors = []
    exact = budget.motion((2e-4, 30, "newmark"), "mujoco", 2, 0.9)
    for name in PRESETS:
        the_scene = scene.load("paper", accuracy=name)
        engine = StructuredEngine(the_scene)
        space = parameters.design_space(the_scene.hand)
        params = jax.vmap(space.params)(jnp.asarray(work.winners()[:2], jnp.float32))
        trials = rollout.sample_trials(the_scene, jax.random.key(4), 2)
        fields, ctrl = rollout.prepare(the_scene, params, trials, engine)
        _, series = jax.jit(engine.states)(fields, ctrl)
        work_of.append(float(series["iterations"].sum()) * the_scene.discretization.links)
        d = the_scene.discretization
        setting = (d.timestep, d.links, d.integrator)
        errors.append(budget.error(budget.motion(setting, hands=2, seconds=0.9), exact))
    assert all(3 * b > 4 * a for a, b in itertools.pairwise(work_of)), work_of
    assert all(2 * b < a for a, b in itertools.pairwise(errors)), errors


def test_the_command_line_takes_a_preset(capsys):
    resolved, _ = run_settings.resolve(
        cli.Optimize(accuracy="fast", engine="mujoco", overrides=(("solver.iterations=7",),))
    )
    assert resolved.discretization == scene.Discretization(0.02, 6, 1, integrator="newmark")
    assert resolved.solver.iterations == 7
    assert cli.main(["evaluate", "--accuracy", "fastest"]) == 2
    assert "'fastest' unknown; did you mean 'fast'" in capsys.readouterr().err


ONE_ACCURACY: list[dict[str, Any]] = [
    {"preset": "2d"},
    {"accuracy": "standard"},
    {"accuracy": "fine"},
    {"search_accuracy": "scene"},
    {"optimizer": "cma-es"},
    {"test_trials": 0},
    {"scene": "shelf"},
    {"scene": "paper_spheres"},
    {"scene": "paper_spheres", "engine": "mujoco"},
    {"overrides": (("discretization.links=5",),)},
    {"overrides": (("newton.decrement=1e-6",),)},
    {"overrides": (("arm.shake_frequency=2.6",),)},
]
"""Flags with which search and final test have the scene's accuracy."""


def test_a_default_search_is_coarse_and_has_the_episodes_that_its_time_allows(tmp_path):
    def resolved(preset="23d", **flags):
        return run_settings.resolve(cli.Optimize(preset=preset, out=tmp_path / "run", **flags))

    the_scene, settings = resolved()
    assert (settings.search_accuracy, settings.episodes) == ("fast", 62)
    plan = runs.prepare(the_scene, settings)
    assert plan.task.scene == scene.load("paper", accuracy="fast")
    assert plan.scene == plan.test_task.scene == scene.load("paper")
    assert plan.grasps == 4794
    for flags in ONE_ACCURACY:
        the_scene, settings = resolved(**flags)
        plan = runs.prepare(the_scene, settings)
        assert plan.task is plan.test_task and plan.scene == the_scene, flags
        assert settings.search_accuracy == "scene", flags
        episodes = {"optimizer": 128, "preset": 22}
        assert settings.episodes == next((episodes[n] for n in flags if n in episodes), 30), flags
    assert resolved(accuracy="fine", search_accuracy="standard")[1].search_accuracy == "standard"


def test_mujoco_converges_with_the_scene_s_own_limits():
    """A line search that ends early looks like convergence: 20 iterations were too few.

    Of 480 states in contact the largest error is 1.6e-4 with the scene's limits; with 20
    iterations of the line search a tenth of them errs by 0.04 and more.
    """
    plain = {"links": 4, "spheres_per_link": 1}, {"surface": "spheres", "finger_finger": False}
    overrides = dict(zip(("discretization", "effects"), plain, strict=True))
    base = scene.load("paper", overrides=overrides)
    exact = dataclasses.replace(base, solver=scene.Solver(300, 100, 1e-15))
    few = dataclasses.replace(base, solver=dataclasses.replace(base.solver, ls_iterations=20))
    with jax.enable_x64(True):
        worlds = jax.tree.map(np.asarray, work.make_worlds(exact, 2))
        fields, ctrl = jax.tree.map(np.asarray, work.inputs(exact, worlds))
    errors = ([], [])
    first, last = (round(t / 0.01) for t in (exact.phases.approach, exact.phases.disturb))
    for w in range(2):
        of_world = jax.tree.map(lambda x, w=w: x[w], fields)
        truth, *others = (world_model(s, of_world) for s in (exact, base, few))
        d = mujoco.MjData(truth)
        datas = [mujoco.MjData(m) for m in others]
        d.qpos[:] = of_world.start
        for k in range(last):
            d.ctrl[:] = ctrl[w, k]
            if k >= first and k % 30 == 0:
                mujoco.mj_forward(truth, d)
                for m, data, series in zip(others, datas, errors, strict=True):
                    data.qpos[:] = d.qpos
                    data.qvel[:] = d.qvel
                    data.ctrl[:] = d.ctrl
                    mujoco.mj_forward(m, data)
                    away = np.linalg.norm(data.qacc - d.qacc)
                    series.append(away / max(np.linalg.norm(d.qacc), 100.0))
            mujoco.mj_step(truth, d)
    assert max(errors[0]) < 1e-3 and max(errors[1]) > 1e-2


def test_every_variant_is_a_scene_and_every_row_has_its_variants(tmp_path):
    scenes = {name: variant.scene() for name, variant in budget.VARIANTS.items()}
    fine = scenes["truth"].discretization
    assert (fine.timestep, fine.links, fine.hull_rings) == (0.002, 20, 4)
    tolerances = [scenes[name].newton.decrement for name in ("standard", report.BASE, "truth")]
    assert tolerances == [1e-3, 1e-6, 1e-6] and scenes["4 iterations"].newton.iterations == 4
    named = {n for c in report.CHANGES for n in (c.of, c.to)}
    named |= {*report.PRESETS, *report.CANDIDATES, *budget.TIMED}
    named |= {row.variant for row in decisions.ROWS} | {*decisions.CANDIDATES, decisions.EXACT}
    assert named <= set(budget.VARIANTS)
    assert len({budget.path_of(tmp_path, name) for name in budget.VARIANTS}) == len(scenes)
    json.dumps(budget.merge(tmp_path))


def test_a_gpu_leaves_out_what_cpus_alone_simulate(monkeypatch, capsys):
    """A GPU's "1e-6, on CPUs" would compare the GPU with itself."""
    alone = ["1e-6, on CPUs", "spheres, MuJoCo C"]
    assert budget.of_platform(["standard", *alone]) == ["standard", *alone]
    monkeypatch.setattr(budget.jax, "devices", lambda: [SimpleNamespace(platform="gpu")])
    assert budget.of_platform(["standard", *alone]) == ["standard"]
    assert [f"{name}: only with JAX_PLATFORMS=cpu" for name in alone] == (
        capsys.readouterr().out.splitlines()
    )


def test_the_page_on_searches_has_the_tables_of_its_data():
    rows = [json.loads(p.read_text()) for p in (EXPERIMENTS.parent / "search").glob("*.json")]
    page = (EXPERIMENTS.parents[1] / "notes/search.md").read_text()
    for mark, text in search_tables.tables(rows).items():
        shown = page.split(f"<!-- {mark}:begin -->")[1].split(f"<!-- {mark}:end -->")[0]
        assert {*shown.strip().splitlines()} == {*text.splitlines()}, mark


def test_the_page_has_the_tables_of_its_data(monkeypatch):
    for module in (report, decisions):  # intervals are left out of the comparison
        monkeypatch.setattr(module, "RESAMPLES", 2)
    recommended, hard = (
        report.read(EXPERIMENTS.parent, name) for name in (report.RECOMMENDED, report.HARD)
    )
    page = (EXPERIMENTS.parents[1] / "accuracy.md").read_text()
    tables = report.tables(recommended, hard)
    tables["decisions"] = decisions.table(decisions.losses_of(recommended, hard))
    searches = (EXPERIMENTS.parent / "search").glob("*.json")
    tables["search"] = search_tables.accuracies_table([json.loads(p.read_text()) for p in searches])
    for mark, text in tables.items():
        shown = page.split(f"<!-- {mark}:begin -->")[1].split(f"<!-- {mark}:end -->")[0]
        assert _without_intervals(shown.strip()) == _without_intervals(text), mark


def test_a_choice_between_two_hands_gains_half_of_their_difference(monkeypatch):
    """Hands that keep all, half and none of any trials: pairs differ by 50, 50 and 100 points."""
    kept = np.zeros((3, 8), bool)
    kept[0] = True
    kept[1, ::2] = True
    truth = decisions.halves(kept)
    assert truth.shape == (3, 4, 2)
    assert decisions.gain(truth, truth) == pytest.approx((0.25 + 0.25 + 0.5) / 3)
    assert decisions.ranks(truth, truth, np.arange(3)) == pytest.approx(1)
    monkeypatch.setattr(decisions, "RESAMPLES", 20)
    wrong = decisions.compared(truth[::-1], truth)
    assert wrong["flipped"].value == pytest.approx(2 / 3) and wrong["kept"].value == 0
    assert wrong["rank"].value == pytest.approx(-1)
    assert wrong["regret"].value == pytest.approx(2 / 3)
    assert decisions.compared(truth, truth)["regret"] == (0, 0, 0)
    # A setting that cannot tell the hands apart is a toss of a coin.
    assert decisions.gain(np.ones_like(truth), truth) == 0
    # What chooses in one half of the trials is valued by the other half alone.
    lucky = decisions.halves(np.array([[1, 1, 0, 0], [0, 0, 1, 1]], bool))
    assert decisions.gain(lucky, lucky) == pytest.approx(-0.5)


def test_two_way_means_are_those_of_resampled_tables():
    """The matrix products and the resampled tables, 10,000 of each; the seed's noise is 2 %."""
    table = np.random.default_rng(0).random((67, 24)) + np.linspace(0, 1, 24)
    [quick] = statistics.two_way_means(table)
    [slow] = statistics.two_way(lambda t: [float(t.mean())], table, resamples=4000)
    assert quick.value == pytest.approx(slow.value)
    assert quick.high - quick.low == pytest.approx(slow.high - slow.low, rel=0.05)


def test_hard_designs_are_near_winners_and_within_the_limits():
    space = parameters.design_space(scene.load("paper").hand, "23d")
    winners = work.winners()[:4]
    designs = decisions.neighbours(space, winners)
    assert designs.shape == (4, 23)
    np.testing.assert_allclose(jax.vmap(space.project)(designs), designs, rtol=1e-6)
    low, high = space.box
    away = (designs - winners) / (high - low)
    assert 0.04 < away.std() < decisions.SPREAD


def _without_intervals(text):
    """A few resamples may be equal, so that a value has no brackets."""
    return re.sub(r" \[[^\]]*\]| \([^)]* to [^)]*\)", "", text)


# --- the paper's experiments: counts, statistics, pages -------------------------------------------


ROOT = Path(__file__).parents[1]


def test_counts_are_the_papers():
    assert {name: p.grasps for name, p in PAPER.items()} == simulate.PAPER_GRASPS
    assert simulate.PAPER_GRASPS == {"2d": 1_008_000, "23d": 4_536_000, "landscape": 129_600}
    assert TOTAL_GRASPS == 5_673_600
    assert (PAPER["2d"].worlds, PAPER["23d"].worlds) == (14_400, 32_400)


def test_smaller_sizes_have_the_paper_s_experiments():
    grasps = {n: sum(p.grasps for p in plans.values()) for n, (plans, _) in simulate.SIZES.items()}
    assert grasps == {"paper": TOTAL_GRASPS, "small": 59_856, "tiny": 156}
    assert all(plans.keys() == PAPER.keys() for plans, _ in simulate.SIZES.values())


def test_means_by_either_rule():
    scene, *_ = tiny()
    cost = np.array([[0.0, 1.0, 3.0], [3.0, 3.0, 3.0]], np.float32)
    status = np.array([[0, 0, 1], [1, 2, 64]], np.uint8)
    means = simulate.both_means(scene, cost, status)
    np.testing.assert_allclose(means["exclude"], [0.5, 3.0])
    np.testing.assert_allclose(means["worst"], [4 / 3, 3.0], rtol=1e-6)
    trials = Outcome(cost, status.astype(np.int32), cost, status)
    np.testing.assert_allclose(means["exclude"], codesign.particle_cost(scene, trials))
    bits = dict(zip(simulate.BITS, simulate.failures(status, (0, 1)), strict=True))
    assert [bits[b] for b in (1, 2, 64)] == [2, 1, 1] and sum(bits.values()) == 4


def test_quantiles_and_medians_with_runs_that_never_converged():
    values = np.array([1.0, np.inf, 3.0, 2.0, np.inf, np.inf])
    assert statistics.quantile(values, 0.25) == 2.0
    assert statistics.quantile(values, 0.5) == np.inf
    finite = np.random.default_rng(0).normal(size=(3, 31))
    for q in (0.025, 0.25, 0.5, 0.75):
        expected = np.quantile(finite, q, axis=-1, method="averaged_inverted_cdf")
        np.testing.assert_allclose(statistics.quantile(finite, q), expected)
    interval = statistics.median(finite[0])
    assert interval.low < interval.value == np.median(finite[0]) < interval.high


def test_paired_tests():
    a = np.arange(30) < 20
    b = np.arange(30) < 10
    assert statistics.mcnemar(a, b) == pytest.approx(2 * 0.5**10)
    assert statistics.mcnemar(a, a) == 1.0
    slow = np.full(30, np.inf)
    fast = np.arange(30.0)
    assert statistics.wilcoxon(slow, fast, 64) < 1e-3 < statistics.wilcoxon(fast, fast, 64)
    assert statistics.trend(np.arange(4.0)[:, None] + np.zeros((4, 30))) < 1e-3
    assert statistics.trend(np.zeros((4, 30))) == 1.0


def test_both_readings_of_converged():
    """Below 1 in the second episode, above in the third, and below from the fourth on."""
    means = np.array([[[2.0, 0.5, 1.5, 0.9, 0.2], [2.0] * 5]])
    study = results.Study({}, {}, {"mean_exclude": means})
    np.testing.assert_array_equal(study.first_below(), [[2.0, np.inf]])
    np.testing.assert_array_equal(study.convergence(), [[4.0, np.inf]])


def test_the_results_page_has_the_tables_of_its_data():
    data = ROOT / "docs" / "data" / "experiments"
    text = experiments_report.tables(results.read(data))
    assert text in (ROOT / "docs" / "notes" / "results.md").read_text(encoding="utf-8")


def part(study, begin, end):
    """The runs of a committed experiment from one to before another, as a study of their own."""
    arrays = {}
    for name, array in study.data.items():
        chosen = (slice(begin, end),) if name in join.BY_RUN else (slice(None), slice(begin, end))
        arrays[name] = array if name in join.COMMON else array[chosen]
    plan = study.plan | {"runs": end - begin}
    settings = study.notes["settings"] | {"plan": plan, "seed": begin}
    share = (end - begin) / study.plan["runs"]
    notes = study.notes | {"settings": settings, "grasps": share * study.notes["grasps"]}
    return results.Study(plan, notes, arrays)


def test_parts_of_an_experiment_are_joined_to_the_whole():
    whole = results.load_study(EXPERIMENTS, "2d")
    assert whole is not None
    arrays, notes = join.join([part(whole, 0, 12), part(whole, 12, 25), part(whole, 25, 30)])
    assert arrays.keys() == whole.data.keys()
    for name, array in whole.data.items():
        np.testing.assert_array_equal(arrays[name], array, err_msg=name)
    assert notes["settings"] == whole.notes["settings"]
    assert notes["grasps"] == whole.notes["grasps"]
    assert [p["settings"]["seed"] for p in notes["parts"][-2:]] == [12, 25]


def test_parts_that_make_no_whole_are_refused():
    whole = results.load_study(EXPERIMENTS, "2d")
    assert whole is not None
    first, second = part(whole, 0, 15), part(whole, 15, 30)
    for parts in ([second, first], [first, first], [first, part(whole, 16, 30)]):
        with pytest.raises(ValueError, match="a part begins with seed"):
            join.join(parts)
    larger = dataclasses.replace(second, plan=second.plan | {"particles": 60})
    settings = second.notes["settings"] | {"failure": "worst"}
    stricter = dataclasses.replace(second, notes=second.notes | {"settings": settings})
    for other in (larger, stricter):
        with pytest.raises(ValueError, match="is no part of"):
            join.join([first, other])


def test_fresh_trials_of_parts_are_joined_and_those_of_other_experiments_stay():
    loaded = results.load(EXPERIMENTS, "fresh")
    assert loaded is not None
    whole, notes = loaded

    def runs(begin, end):
        cut = {k: v for k, v in whole.items() if k.startswith("23d|") and k.count("|") == 2}
        return whole | {k: v[:, begin:end] for k, v in cut.items()}, notes

    parts = [runs(0, 20), runs(20, 26), runs(26, 30)]
    arrays, joined = join.join_fresh("23d", parts)
    assert arrays.keys() == whole.keys()
    for name, array in whole.items():
        np.testing.assert_array_equal(arrays[name], array, err_msg=name)
    assert joined["runs"] == 3 * notes["runs"]
    del parts[1][0]["23d|reference|cost"], parts[1][0]["23d|reference|status"]
    assert not any("23d|reference" in name for name in join.join_fresh("23d", parts)[0])


# --- an older version beside this one -------------------------------------------------------------

VERDICTS = np.random.default_rng(3)
KEPT = VERDICTS.random((40, 30)) < 0.8


def flipped(share, seed):
    """The verdicts with so many of them flipped, the same ones for a seed."""
    return KEPT ^ (np.random.default_rng(seed).random(KEPT.shape) < share)


@pytest.mark.parametrize(
    ("changed", "chance", "passed"),
    [(0.0, 0.0, True), (0.01, 0.01, True), (0.04, 0.01, False), (0.02, 0.0, False)],
)
def test_a_change_without_physics_flips_no_more_than_a_micrometre(changed, chance, passed):
    row = judgement.same("hard", KEPT, flipped(changed, 1), flipped(chance, 2))
    assert row.passed == passed


def test_equal_versions_pass_nearly_always():
    """Both flip one verdict in a hundred by chance; an interval of 95 % is above in one of 40."""
    rows = [judgement.same("", KEPT, flipped(0.01, s), flipped(0.01, 99 + s)) for s in range(30)]
    assert sum(row.passed for row in rows) >= 27  # fewer with a probability below 1 %


def test_flips_of_a_changed_physics_are_those_that_were_expected():
    new = flipped(0.03, 1)
    for low, high, passed in ((0.02, 0.04, True), (0.0, 0.01, False), (0.06, 0.1, False)):
        expected = judgement.Expected(low, high)
        assert judgement.physics("hard", KEPT, new, KEPT, expected).passed == passed


def test_a_rate_fails_only_if_its_interval_lies_below_the_bound():
    noise = np.exp(0.02 * VERDICTS.normal(size=8))
    for factor, passed in ((1.0, True), (1.03, True), (1.1, False), (0.8, True)):
        old = (2.0 + 0.1 * np.arange(8)).tolist()  # the machine gets slower: pairs cancel it
        assert judgement.rate(old, (factor * noise * old).tolist()).passed == passed


@pytest.mark.parametrize("words", [[], ["hard=1"], ["hard=2-1"], ["soft=1"], ["hard=few"]])
def test_expected_flips_are_stated_for_every_group(words):
    with pytest.raises(ValueError):
        agree.expectations(words)


def test_a_side_is_a_commit_or_a_folder_and_tells_what_failed(tmp_path):
    with pytest.raises(ValueError, match="no commit"):
        sides.checkout("no-such-commit", tmp_path)
    with pytest.raises(ValueError, match="no package"):
        sides.checkout(str(tmp_path), tmp_path)
    with sides.running(ROOT) as side:
        assert Path(side.ask("device")["package"]).is_relative_to(ROOT)
        with pytest.raises(RuntimeError, match="KeyError"):
            side.ask("nothing")
        assert side.ask("device")["backend"] == jax.default_backend()


TINY_SIZE = agree.Size(designs=4, trials=6, call=24, pairs=2, worlds=2, slopes=2)
LAW = "codesign_jax/engines/structured/laws/contact.py"
SPRING = "jnp.where(gap < 0, cone.spring, "


@pytest.mark.slow  # five minutes: two versions are compiled, and the derivative of one
@pytest.mark.parametrize("planted", [SPRING, SPRING.replace("cone", "0.5 * cone")])
def test_an_equal_version_agrees_and_a_wrong_law_does_not(planted, tmp_path, monkeypatch):
    """The wrong law corrects half of a contact's depth in a step."""
    for name in ("codesign_jax", "hands", "objects"):
        shutil.copytree(ROOT / name, tmp_path / name)
    law = (ROOT / LAW).read_text(encoding="utf-8")
    assert SPRING in law
    (tmp_path / LAW).write_text(law.replace(SPRING, planted), encoding="utf-8")
    monkeypatch.setattr(sides, "ROOT", tmp_path)
    monkeypatch.setattr(agree, "QUICK", TINY_SIZE)
    status = agree.main([str(ROOT), "--kind", "same", "--quick"])
    assert status == (planted != SPRING)


def test_an_interval_of_fresh_trials_has_what_one_trial_does_to_all_runs():
    """Every run loses one of 24 trials: resampled trials hold it as often as a binomial says."""
    good = np.ones((30, 24), bool)
    lost = good.copy()
    lost[:, 5] = False
    worst, best = scipy.stats.binom.ppf([0.975, 0.025], 24, 1 / 24) / -24
    words = f"{-100 / 24:+.1f} [{100 * worst:+.1f}, {100 * best + 0.0:+.1f}]"
    assert fresh._difference((lost, good), (good, good)).replace("-0.0", "+0.0") == words
    assert fresh._difference((lost, good), (lost, good)) == "+0.0 [+0.0, +0.0]"
