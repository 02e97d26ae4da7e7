"""The report of a run: one HTML file that needs no network, see `write`."""

import datetime
import json
import shlex
from pathlib import Path

import jax
import numpy as np

from codesign_jax import codesign, files, types
from codesign_jax.judge import sentences, verdict
from codesign_jax.judge.sentences import Judged
from codesign_jax.report import charts, chosen, landscape, markup, viewer
from codesign_jax.report.of_run import Run
from codesign_jax.report.replay import Replay
from codesign_jax.runs import SCENE_ACCURACY, SCENE_COST
from codesign_jax.runs.selection import Grasp
from codesign_jax.scene import Scene, accuracy_name
from codesign_jax.scene.scene_files import NAMES, SEARCH
from codesign_jax.types import HARMLESS, MEANINGS


def write(run: Run, grasp: tuple[Grasp, Replay] | None, path: Path) -> Path:
    """Writes the report of a run."""
    sections = [
        *(markup.paragraph(f"Warning: {note}.", "warning") for note in run.notes),
        _grasp(run, grasp),
        chosen.endings(run),
        chosen.fingers(run),
        chosen.conditions(run),
        chosen.design(run),
        markup.section(
            "Search",
            markup.paragraph(_cost_note(run)),
            charts.html(charts.cost_evolution(run.history.cost), "cost"),
            markup.paragraph(_solved(run), "note"),
        ),
        _landscape(run),
        _parameters(run),
        _failures(run),
        _settings(run),
        _provenance(run),
    ]
    return save(f"Co-design run {run.folder.resolve().name}", run.judged, sections, path)


def save(title: str, judged: Judged, sections: list[str], path: Path) -> Path:
    """Writes a page whose head has the verdict."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes")
    head = f"<h1>{markup.text(title)}</h1>\n{_verdict(judged)}"
    foot = markup.paragraph(f"codesign-jax, report of {now}", "note")
    files.make_folder_of(path)
    with files.atomically(path) as part:
        body = "\n".join([head, *sections, foot])
        part.write_text(viewer.page(title, body, viewer.web("report.js")), encoding="utf-8")
    return path


def _verdict(judged: Judged) -> str:
    """The verdict in its colour: its word, the share that is kept, and the sentence."""
    counts = verdict.tally(judged.outcomes)
    word = judged.verdict.word
    kind = {"good": "good", verdict.OPEN: "open"}.get(word, "bad")
    if counts.fault == counts.total:
        word = "no verdict"
        kind = "bad"
    share = f"kept {counts.kept} of {counts.total}"
    return (
        f"<div class='verdict {kind}'><p><strong>{markup.text(word)}</strong> {share}</p>"
        f"{markup.paragraph(f'Verdict: {judged.headline}')}</div>"
    )


def _settings(run: Run) -> str:
    scene = run.scene
    s = run.settings
    record = run.record
    done = f"{record.done} of {s.episodes} episodes"
    sizes = f"{s.particles} particles × {s.trials} trials × {done}"
    rows = [
        *surroundings(scene),
        ("design space", f"{s.preset}: {run.space.num_parameters} free parameters"),
        ("strategy", s.schedule),
        ("optimizer", s.optimizer),
        ("cost", "the scene's" if s.cost == SCENE_COST else f"{s.cost}, of the user's own"),
        ("engine", f"{s.engine}, {_accuracies(run)}"),
        ("grasps", f"{record.done * s.particles * s.trials:,} ({sizes})"),
        ("seed", s.seed),
        ("converged", _converged(run)),
    ]
    return markup.section("Settings", markup.table((), rows))


def _accuracies(run: Run) -> str:
    """The time step, or those of search and final test."""
    usual, searched = run.scene.discretization, run.search_scene.discretization
    name = accuracy_name(run.scene)
    words = f"time step {1000 * usual.timestep:g} ms"
    if run.settings.search_accuracy == SCENE_ACCURACY:
        return words
    return (
        f"search at accuracy {run.settings.search_accuracy} (time step "
        f"{1000 * searched.timestep:g} ms, {searched.links} links), final test at "
        f"{f'accuracy {name} ({words})' if name else words}"
    )


def surroundings(scene: Scene) -> list[tuple[str, str]]:
    """What is simulated, in rows of a table."""
    objects = ", ".join(f"{o.name} ({o.type}, {1000 * o.mass:.0f} g)" for o in scene.objects.object)
    fingers = f"{scene.num_fingers} fingers of {scene.discretization.links} links"
    return [
        ("scene", f"{scene.name}: {scene.description}"),
        ("hand", f"{scene.hand.name}, {fingers}; surface: {scene.effects.surface}"),
        ("objects", objects),
    ]


def _converged(run: Run) -> str:
    if run.settings.cost != SCENE_COST:
        return "not said of a cost of the user's own"
    episode = codesign.convergence_episode(run.history.cost.mean(1))
    limit = codesign.CONVERGED_COST
    if episode is None:
        return f"no: the mean cost of the last episode is not below {limit:g}"
    grasps = episode * run.settings.particles * run.settings.trials
    return f"from episode {episode + 1} on, after {grasps:,} grasps (mean cost below {limit:g})"


def _solved(run: Run) -> str:
    if run.record.test is None:
        return "The final particles were not tested."
    test = run.record.test
    first = np.unique(np.asarray(run.record.state.particles), axis=0, return_index=True)[1]
    good = verdict.good(jax.tree.map(lambda v: np.asarray(v)[first], test))
    trials = f"{test.cost.shape[1]} trials of the final test"
    return f"Of {good.size} final particles {good.sum()} are good in {trials}; copies count once."


def _grasp(run: Run, grasp: tuple[Grasp, Replay] | None) -> str:
    if grasp is None:
        return ""
    planned, shown = grasp
    episode, particle, trial = planned.place
    name = run.scene.objects.object[int(planned.trial.shape)].name
    before, again = (verdict.ending(o) for o in (planned.outcome, shown.outcome))
    note = (
        f"The chosen design with the object {name}: trial {trial} of particle {particle} in "
        f"episode {episode}, simulated again. In the run{_at(run)}: {before}; here: {again}."
    )
    parts = in_motion(run.scene, shown)
    if before != again:
        text = (
            "The two differ: contact is chaotic, and a batch of another size or another machine "
            "rounds differently."
        )
        parts = [*parts, markup.paragraph(text, "warning")]
    return markup.section("Best grasp", *parts, markup.paragraph(note, "note"))


def _at(run: Run) -> str:
    name = run.settings.search_accuracy
    return "" if name == SCENE_ACCURACY else f", at accuracy {name}"


def in_motion(scene: Scene, shown: Replay) -> list[str]:
    """A grasp in 3D, and its forces where the engine tells them."""
    parts = [viewer.fragment(scene, shown)]
    if shown.trace is not None and (forces := shown.trace.forces) is not None:
        text = (
            "Normal forces of the fingers on the object, and the palm's force; a click goes to "
            f"that time. Largest depths in one another: {sentences.depths(forces)}."
        )
        parts += [charts.html(charts.grip(forces, scene), "grip"), markup.paragraph(text, "note")]
    return parts


def _cost_note(run: Run) -> str:
    return (
        "A dot is a particle: the mean cost of its trials, 0 if it kept the object in all, "
        f"{run.scene.cost.maximum:g} if it lost it at once in all. The threshold of convergence is "
        "the paper's. Drag across a chart to zoom, double-click to see all of it."
    )


def _parameters(run: Run) -> str:
    note = (
        "Distribution of the particles over the episodes; an axis spans the parameter's range. "
        "A band that stays wide says that selection did not narrow the parameter."
    )
    small = charts.parameters(run.history, run.space, run.chosen.design)
    shown = markup.paragraph(note), charts.grid(small, "parameters")
    return markup.folded("Parameters over the episodes", *shown)


def _landscape(run: Run) -> str:
    path = run.folder / landscape.FILE
    space = run.space
    grid = landscape.load(path) if path.exists() else None
    words = "A dot is a particle of any episode, coloured by its cost. "
    command = []
    if grid is None:
        if space.num_parameters != 2:
            return ""
        words = words + "The whole landscape: "
        command = ["landscape", "--run", str(run.folder)]
        figure = charts.designs(run.history, space, run.chosen.design, None)
    else:
        grey = f"the mean cost over {int(grid.trials)} trials a point, white where all are kept."
        if tuple(grid.names) == space.names:
            words += f"In grey {grey}"
            figure = charts.designs(run.history, space, run.chosen.design, grid)
        else:
            same = np.allclose(grid.design, run.chosen.design)
            around = "the chosen design" if same else "another design, which landscape.npz has"
            others = f"The other parameters are those of {around}."
            if grid.search:
                others = "At each point a search chose the other parameters."
            words = f"In grey {grey} {others}"
            figure = charts.landscape(grid)
    section = markup.paragraph(words, "", command), charts.html(figure, "landscape")
    return markup.section("Landscape", *section)


def _failures(run: Run) -> str:
    status = np.asarray(run.history.outcomes.status)
    failed = int(types.failed(status).sum())
    total = status.size
    rule = (
        "are left out of a particle's mean"
        if run.scene.cost.failure == "exclude"
        else "count with the maximum"
    )
    note = f"{failed:,} of {total:,} trials failed ({100 * failed / total:.2f} %); they {rule}."
    bits = [bit for bit in MEANINGS if bit not in HARMLESS]
    counts = {bit: int(((status & bit) != 0).sum()) for bit in bits}
    if warned := verdict.warning_counts(status):
        note += f" Warnings, which fail no trial: {warned}."
    rows = [
        (b.name, f"{n:,}", f"{100 * n / total:.2f} %", MEANINGS[b]) for b, n in counts.items() if n
    ]
    if not rows:
        return markup.section("Failures of the simulation", markup.paragraph(note))
    table = markup.table(("status", "trials", "share", "meaning"), rows, (1, 2))
    figure = charts.html(charts.failures(status), "failures")
    return markup.section("Failures of the simulation", markup.paragraph(note), table, figure)


def _provenance(run: Run) -> str:
    p = run.provenance
    e = run.provenance["environment"]
    git = p.get("git", {})
    commit = git.get("commit") or "not a checkout"
    rows = [("commit", commit + (" with changes" if git.get("modified") else ""))]
    rows += [(name, e[name]) for name in ("python", "platform", "machine", "device")]
    rows += [(name, version) for name, version in e["versions"].items()]
    steps = [("started", p["started"]), *(("resumed", step) for step in p.get("resumed", []))]
    for word, step in steps:
        rows.append((f"{word} {step['time']}", shlex.join(["codesign", *step["command"][1:]])))
    texts = [(run.folder / name) for name in (*NAMES, SEARCH)]
    files_shown = {path.name: path.read_text(encoding="utf-8") for path in texts if path.exists()}
    files_shown["provenance.json"] = json.dumps(p, indent=2)
    details = [
        markup.folded(name, f"<pre>{markup.text(text)}</pre>") for name, text in files_shown.items()
    ]
    return markup.section("Provenance", markup.table((), rows), *details)
