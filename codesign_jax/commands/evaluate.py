"""`codesign evaluate`."""

import shlex
from itertools import chain

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import files, preflight, rollout, runs, terminal, tolerances, types
from codesign_jax.commands import common, forces
from codesign_jax.commands.common import find_case
from codesign_jax.commands.flags import Evaluate
from codesign_jax.engines import Engine
from codesign_jax.engines.base import recording
from codesign_jax.judge import fresh_trials, sentences, stress, verdict
from codesign_jax.judge.cases import Case
from codesign_jax.judge.stress import Stress
from codesign_jax.report import advice
from codesign_jax.runs import reference, selection, tables
from codesign_jax.runs.manifest import read_provenance
from codesign_jax.runs.progress import Busy, Meter
from codesign_jax.scene.schema import InputError
from codesign_jax.terminal import Console


def main(options: Evaluate) -> int:
    common.use_compilation_cache()
    case = _of_particle(find_case(options), options)
    _check(options, case.engine)
    engine = case.make_engine()
    terminal.wait("checking how the hand begins")
    notes = preflight.notes(case.scene, case.space, {"the design": case.design})
    console = Console()
    if options.run_folder:
        subject = (
            "best final design" if options.particle is None else f"particle {options.particle}"
        )
        console.print(f"{subject} of {options.run_folder}")
    console.print(*runs.describe(case.space, case.design).split("\n"), sep="\n")
    console.print(f"air in all unloaded chambers: {case.air:.1f} cm³")
    if not options.run_folder:
        words = [*chain.from_iterable(options.design)]
        if note := common.by_default(case.space, words):
            console.print(note)
    for note in [*_untried(case, options), *notes]:
        console.print(note)
    if options.dry_run:
        for note in common.policy_notes(engine, case.space.params(case.design)):
            console.print(note)
        console.print(_size(case, options))
        return 0
    outcomes = simulate(case, options, console)
    _explain_starts(case, outcomes, options, console)
    other = other_conditions(case, options, console) if options.stress else None
    tell_verdict(case, outcomes, other, options, console)
    if options.tolerances != common.OFF:
        common.cast_hands(case, options, options.trials or tolerances.TRIALS, console)
    if options.render or options.forces or options.pull:
        of_objects(case, engine, options, console)
    return int(types.failed(outcomes.status).all())  # no trial says anything of the design


def _size(case: Case, options: Evaluate) -> str:
    """The number of grasps, in words."""
    if options.trials is None:
        text = f"grasps: until the verdict is decided, at most {verdict.MOST}"
    else:
        text = f"grasps: {options.trials}"
    more = 0
    if options.stress:
        more += _of_each(options) * stress.sets(case.scene)
    if options.tolerances != common.OFF:
        more += (options.hands + 1) * (options.trials or tolerances.TRIALS)
    return f"{text}, {more} more" if more else text


def _of_each(options: Evaluate) -> int:
    """Grasps under each of the other conditions."""
    return reference.STRESS_TRIALS if options.trials is None else options.trials


def _of_particle(case: Case, options: Evaluate) -> Case:
    if options.particle is None:
        return case
    if options.run_folder is None:
        raise InputError.of(
            "missing", "--particle is one of a run: give its folder, or leave it out"
        )
    record = selection.read_record(options.run_folder)
    particles = np.asarray(record.state.particles)
    common.refuse(common.number_problems(("--particle", options.particle, 0, len(particles) - 1)))
    return case._replace(design=particles[options.particle])


def _check(options: Evaluate, engine: str) -> None:
    problems = common.number_problems(
        ("--trials", options.trials, 1, 100_000), ("--seed", options.seed, 0, 2**31 - 1)
    )
    problems += common.number_problems(("--hands", options.hands, 8, 100_000))
    if options.tolerances != common.OFF:
        tolerances.read(options.tolerances)
    problems += common.picture_problems("--render", options.render)
    problems += common.place_problems("--out", options.out, ".csv")
    problems += common.place_problems("--forces", options.forces, ".csv")
    if options.pull:
        forces.direction(options.pull)
    common.refuse(problems + common.engine_problems(engine, options.overrides))


def simulate(case: Case, options: Evaluate, console: Console) -> types.Outcome:
    """Simulates the trials and prints how they ended, by object and in all; outcomes (trial,)."""
    key = jax.random.key(options.seed)
    trials = options.trials
    if trials is None:
        later = _of_each(options) * stress.sets(case.scene) if options.stress else 0
        with Meter("trials", verdict.USUAL, console, later=later) as meter:
            outcomes = fresh_trials.decide(
                case, key, verdict.MOST, keep=lambda o: reference.show(meter, o, verdict.MOST)
            )
    else:
        with Busy(console, f"compiling, then simulating {common.counted(trials, 'grasp')}"):
            outcomes = case.simulate(trials, key)
    names = [shape.name for shape in case.scene.objects.object]
    for k, name in enumerate(names[: outcomes.cost.size]):
        object_outcomes = jax.tree.map(lambda v, k=k: v[k :: len(names)], outcomes)
        console.print(f"{name:>12}: {sentences.of_trials(case.scene, object_outcomes)}")
    judged = sentences.Judged(case.scene, outcomes, options.accuracy)
    for line in [f"{'all':>12}: {judged.details}", *sentences.solver(outcomes)]:
        console.print(line)
    if case.policy:
        with Busy(console, "asking what the policy commanded"):
            report = case.observe(verdict.BATCH if trials is None else trials, key)[1]
        console.print(f"policy {case.policy} {report}")
    if options.out:
        drawn = rollout.sample_trials(case.scene, key, outcomes.cost.size)
        files.make_folder_of(options.out)
        tables.write_grasps(options.out, case.scene, jax.tree.map(np.asarray, drawn), outcomes)
        console.print(f"table: {options.out}")
    return outcomes


def _explain_starts(
    case: Case, outcomes: types.Outcome, options: Evaluate, console: Console
) -> None:
    """Names the bodies of the first trial that could not start, if there is any."""
    inside = np.flatnonzero(np.asarray(outcomes.status) & types.Status.INVALID_START)
    if inside.size:
        number = int(inside[0])
        drawn = rollout.sample_trials(case.scene, jax.random.key(options.seed), number + 1)
        trial = jax.tree.map(lambda v: np.asarray(v)[number], drawn)
        for text in preflight.why_invalid(case.scene, case.space.params(case.design), trial):
            console.print(f"warning: trial {number}: {text}")


def other_conditions(case: Case, options: Evaluate, console: Console) -> Stress:
    """Simulates the design under other conditions and prints what it keeps."""
    count = _of_each(options)
    with Meter("other conditions", count * stress.sets(case.scene), console) as meter:
        key = jax.random.key(options.seed)
        stress_result = stress.simulate(case, count, key, meter.advance)
    reference.tell_stress(case, stress_result, console)
    return stress_result


def tell_verdict(
    case: Case,
    outcomes: types.Outcome,
    other: Stress | None,
    options: Evaluate,
    console: Console,
) -> None:
    """Prints the verdict of the trials, and what speaks against it."""
    judged = sentences.Judged(case.scene, outcomes, options.accuracy, stress=other)
    for line in [*sentences.warnings(judged), f"verdict: {judged}"]:
        console.print(line)
    for what, command in _advice(judged, options):
        console.print(f"to try {what}: {shlex.join(['codesign', *command])}")


def _advice(judged: sentences.Judged, options: Evaluate) -> list[advice.Advice]:
    """What to try where the design is not good, or its trials do not decide."""
    verdict_now = judged.verdict
    if verdict_now.word == verdict.OPEN:
        trials = {"--trials": str(verdict_now.total + verdict_now.more)}
        return [advice.Advice("more trials", advice.changed(options.words, trials))]
    if verdict_now.word == "good":
        return []
    if options.run_folder is None:
        words = ["studio", "--design", *chain.from_iterable(options.design)]
        for name in ("preset", "scene", "hand", "objects"):
            if value := getattr(options, name):
                words += [f"--{name}", value]
        return [advice.Advice("designs around it, by the page's button Improve", words)]
    settings = runs.read_run(options.run_folder)[1]
    command = read_provenance(options.run_folder)["started"]["command"]
    return advice.after_search(judged, settings, command, options.run_folder)


def _untried(case: Case, options: Evaluate) -> list[str]:
    names = [shape.name for shape in case.scene.objects.object]
    untried = [] if options.trials is None else names[options.trials :]
    if not untried:
        return []
    return [
        f"warning: --trials {options.trials} tries {options.trials} of {len(names)} objects, and "
        f"not {', '.join(untried)}; --trials {len(names)} tries each once"
    ]


def of_objects(case: Case, engine: Engine, options: Evaluate, console: Console) -> None:
    """Forces, pull test and drawing of the first trial of each object."""
    from codesign_jax.report import animation

    scene = case.scene
    count = len(case.scene.objects.object)
    if options.trials is not None:
        count = min(options.trials, count)
    trials = rollout.sample_trials(scene, jax.random.key(options.seed), count)
    params = case.space.params(jnp.asarray(case.design, jnp.float32))
    grasps = []
    if options.forces:
        with Busy(console, "compiling, then recording forces"):
            grasps = animation.replay(scene, recording(engine), params, trials)
        forces.tell(scene, grasps, console)
        forces.write(options.forces, scene, grasps)
        console.print(f"table: {options.forces}")
    if options.pull:
        with Busy(console, "compiling, then pulling"):
            along = forces.direction(options.pull)
            pulls = forces.pull(scene, engine, params, trials, along)
        for shape, force in zip(np.asarray(trials.shape), pulls, strict=True):
            name = scene.objects.object[int(shape)].name
            console.print(f"{name:>12}: {forces.in_words(force)}")
    if options.render:
        if not grasps:
            with Busy(console, "compiling, then simulating what is drawn"):
                grasps = animation.replay(scene, engine, params, trials)
        with Busy(console, "drawing"):
            animation.write(scene, grasps, options.render)
        console.print(f"picture: {options.render}")
