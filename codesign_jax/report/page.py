"""The report of a run: one HTML file that needs no network, see `write`."""

import datetime
import html
import json
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codesign_jax import codesign, files, types
from codesign_jax.report import charts, landscape, viewer
from codesign_jax.report.animation import Replay
from codesign_jax.report.statistics import wilson
from codesign_jax.runs import Settings, choice, tables
from codesign_jax.runs.choice import Chosen, Grasp
from codesign_jax.runs.record import History, Record
from codesign_jax.runs.scene_files import NAMES
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.types import Status

MEANINGS = {
    Status.NONFINITE: "a number of the state was not finite",
    Status.SPEED: "a velocity beyond the scene's limit",
    Status.PENETRATION: "the object fell through the table",
    Status.SOLVER_CAP: "a warning only: the contact solver stopped at its cap of iterations",
    Status.CONTACT_OVERFLOW: "more contacts than the engine has room for",
    Status.INVALID_START: "bodies deep inside one another before the first step",
    Status.STUCK: "the released object neither left the hand nor rests on the table",
}
"""What the bits of `Status` mean, for readers of a report."""


class Run(NamedTuple):
    """A run to report on.

    Attributes:
      folder: Its folder.
      scene: Its scene.
      settings: Its settings.
      record: Its episodes, at least one.
      chosen: The design it found.
      provenance: Content of its provenance.json.
    """

    folder: Path
    scene: Scene
    settings: Settings
    record: Record
    chosen: Chosen
    provenance: dict[str, Any]

    @property
    def space(self) -> DesignSpace:
        """The design space."""
        return design_space(self.scene.hand, self.settings.preset)

    @property
    def history(self) -> History:
        """Reports of the finished episodes."""
        h, done = self.record.history, self.record.done
        trials = types.Outcome(*(v[:done] for v in h.trials))
        return History(h.population[:done], trials, *(v[:done] for v in h[2:]))


def write(run: Run, grasp: tuple[Grasp, Replay] | None, path: Path) -> Path:
    """Writes the report of a run.

    Args:
      run: The run.
      grasp: The grasp to show and what happened when it was simulated again, or None.
      path: The file; its folder is made.

    Returns:
      The path.
    """
    sections = [
        _summary(run),
        _design(run),
        _grasp(run, grasp),
        _section(
            "Cost",
            _paragraph(_cost_note(run)),
            charts.html(charts.cost_evolution(run.history), "cost"),
        ),
        _parameters(run),
        _landscape(run),
        _failures(run),
        _provenance(run),
    ]
    title = f"Co-design run {run.folder.resolve().name}"
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="minutes")
    head = f"<h1>{_text(title)}</h1>\n<p class='note'>codesign-jax, report of {now}</p>\n"
    with files.atomically(path) as part:
        body = head + "\n".join(sections)
        part.write_text(viewer.page(title, body, charts.library()), encoding="utf-8")
    return path


def _text(value: object) -> str:
    return html.escape(str(value))


def _paragraph(text: str, kind: str = "", command: Sequence[str] = ()) -> str:
    """A paragraph that may end with a command of `codesign`."""
    code = f"<code>{_text(shlex.join(['codesign', *command]))}</code>" if command else ""
    return f"<p class='{kind}'>{_text(text)}{code}</p>" if text else ""


def _section(title: str, *parts: str) -> str:
    return f"<h2>{_text(title)}</h2>\n" + "\n".join(parts)


def _table(
    head: Sequence[str], rows: Iterable[Sequence[object]], numbers: Sequence[int] = ()
) -> str:
    """An HTML table; cells that are `_Html` stay as they are, columns in numbers stand right."""

    def cell(tag: str, k: int, value: object) -> str:
        kind = " class='number'" if k in numbers else ""
        text = value if isinstance(value, _Html) else _text(value)
        return f"<{tag}{kind}>{text}</{tag}>"

    def line(tag: str, values: Sequence[object]) -> str:
        return "<tr>" + "".join(cell(tag, k, v) for k, v in enumerate(values)) + "</tr>"

    top = line("th", head) if head else ""
    return "<table>" + top + "".join(line("td", row) for row in rows) + "</table>"


class _Html(str):
    """Text that is HTML already."""


def _summary(run: Run) -> str:
    scene, s, record = run.scene, run.settings, run.record
    objects = ", ".join(f"{o.name} ({o.type}, {1000 * o.mass:.0f} g)" for o in scene.objects.object)
    fingers = f"{scene.num_fingers} fingers of {scene.discretization.links} links"
    done = f"{record.done} of {s.episodes} episodes"
    sizes = f"{s.particles} particles × {s.trials} trials × {done}"
    rows = [
        ("scene", f"{scene.name}: {scene.description}"),
        ("hand", f"{scene.hand.name}, {fingers}; surface: {scene.effects.surface}"),
        ("objects", objects),
        ("design space", f"{s.preset}: {run.space.num_parameters} free parameters"),
        ("strategy", s.schedule),
        ("optimizer", s.optimizer),
        ("engine", f"{s.engine}, time step {1000 * scene.discretization.timestep:g} ms"),
        ("grasps", f"{record.done * s.particles * s.trials:,} ({sizes})"),
        ("seed", s.seed),
        ("converged", _converged(run)),
        ("final particles", _solved(run)),
    ]
    return _section("Summary", _table((), rows))


def _converged(run: Run) -> str:
    episode = codesign.convergence_episode(run.history.cost.mean(1))
    limit = codesign.CONVERGED_COST
    if episode is None:
        return f"no: the mean cost of the last episode is not below {limit:g}"
    grasps = episode * run.settings.particles * run.settings.trials
    return f"from episode {episode + 1} on, after {grasps:,} grasps (mean cost below {limit:g})"


def _solved(run: Run) -> str:
    if run.record.test is None:
        return "not tested"
    test = codesign.summarize_test(run.scene, run.record.test)
    success = np.asarray(test.success)
    return (
        f"{success.sum()} of {success.size} have a mean cost below {codesign.SUCCESS_COST} in "
        f"{test.trials.cost.shape[1]} trials"
    )


def _share(kept: int, total: int) -> str:
    """A share of successes with its interval, in words."""
    if not total:
        return "no trial that counts"
    share = wilson(kept, total)
    return (
        f"{kept} of {total}: {100 * share.value:.0f} %, 95 % interval "
        f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
    )


def _design(run: Run) -> str:
    chosen, space = run.chosen, run.space
    values, low, high = (
        space.in_units(np.asarray(v)) for v in (chosen.design, space.low, space.high)
    )
    rows = []
    for k, name in enumerate(space.names):
        at = 100 * float((values[k] - low[k]) / (high[k] - low[k]))
        bar = _Html(f"<div class='scale'><i style='left:{min(max(at, 0), 100):.1f}%'></i></div>")
        domain = "morphology" if space.is_morphology[k] else "control"
        number = (f"{v:.4g}" for v in (values[k], low[k], high[k]))
        rows.append((name, *number, space.units[k], domain, bar))
    head = ("parameter", "value", "lowest", "highest", "unit", "domain", "within its range")
    kept = (np.asarray(chosen.trials.cost) < codesign.SUCCESS_COST) & ~types.failed(
        np.asarray(chosen.trials.status)
    )
    counted = ~types.failed(np.asarray(chosen.trials.status))
    source = "the final test" if chosen.tested else "its last episode; there was no final test"
    success = f"Kept the object in {_share(int(kept.sum()), int(counted.sum()))}"
    note = (
        f"Particle {chosen.particle}, mean cost {chosen.cost:.4f} in {counted.size} trials of "
        f"{source}. It was chosen as the best by these very trials, which flatters it. New trials "
        "at the reference accuracy: "
    )
    again = ["evaluate", "--run", str(run.folder), "--trials", "150", "--accuracy", "reference"]
    parts = [_paragraph(success, "key"), _paragraph(note, "note", again)]
    parts += [_by_object(run, kept, counted), _table(head, rows, (1, 2, 3))]
    return _section("Chosen design", *parts)


def _by_object(run: Run, kept: np.ndarray, counted: np.ndarray) -> str:
    """Success for each object; every batch of trials takes turns between the objects."""
    names = [shape.name for shape in run.scene.objects.object]
    index = np.arange(counted.size) % run.settings.trials % len(names)
    rows = []
    for k, name in enumerate(names):
        own = index == k
        if own.any():
            share = _share(int(kept[own].sum()), int(counted[own].sum()))
            rows.append((name, share, int((~counted[own]).sum())))
    return _table(("object", "kept", "failed trials"), rows, (2,))


def _grasp(run: Run, grasp: tuple[Grasp, Replay] | None) -> str:
    if grasp is None:
        return ""
    planned, shown = grasp
    episode, particle, trial = planned.place
    name = run.scene.objects.object[int(planned.trial.shape)].name
    before, again = (choice.verdict(o) for o in (planned.outcome, shown.outcome))
    note = (
        f"The chosen design with the object {name}: trial {trial} of particle {particle} in "
        f"episode {episode}, simulated again. In the run: {before}; here: {again}."
    )
    parts = [viewer.fragment(run.scene, shown)]
    if before != again:
        text = (
            "The two differ: contact is chaotic, and a batch of another size or another machine "
            "rounds differently."
        )
        parts = [_paragraph(text, "warning"), *parts]
    return _section("Best grasp", _paragraph(note), *parts)


def _cost_note(run: Run) -> str:
    return (
        "A dot is a particle: the mean cost of its trials, 0 if it kept the object in all, "
        f"{run.scene.cost.maximum:g} if it lost it at once in all. The dashed line is the paper's "
        "threshold of convergence."
    )


def _parameters(run: Run) -> str:
    note = (
        "Distribution of the particles over the episodes; an axis spans the parameter's range. "
        "A band that stays wide says that selection did not narrow the parameter."
    )
    figure = charts.parameters(run.history, run.space, run.chosen.design)
    return _section("Parameters", _paragraph(note), charts.html(figure, "parameters"))


def _landscape(run: Run) -> str:
    """The particles of a run with two parameters, and the landscape where there is one."""
    path, space = run.folder / landscape.FILE, run.space
    found = landscape.load(path) if path.exists() else None
    words, command = "A dot is a particle of any episode, coloured by its cost. ", []
    if found is None:
        if space.num_parameters != 2:
            return ""
        words, command = words + "The whole landscape: ", ["landscape", "--run", str(run.folder)]
        figure = charts.designs(run.history, space, run.chosen.design, None)
    else:
        grey = f"the mean cost over {int(found.trials)} trials a point, white where all are kept."
        if tuple(found.names) == space.names:
            words += f"In grey {grey}"
            figure = charts.designs(run.history, space, run.chosen.design, found)
        else:
            own = np.allclose(found.design, run.chosen.design)
            around = "the chosen design" if own else tables.describe(space, found.design)
            words = f"In grey {grey} The other parameters are those of {around}."
            figure = charts.landscape_figure(found)
    section = _paragraph(words, "", command), charts.html(figure, "landscape")
    return _section("Landscape", *section)


def _failures(run: Run) -> str:
    status = run.history.trials.status
    failed, total = int(types.failed(status).sum()), status.size
    rule = (
        "are left out of a particle's mean"
        if run.scene.cost.failure == "exclude"
        else "count with the maximum"
    )
    note = f"{failed:,} of {total:,} trials failed ({100 * failed / total:.2f} %); they {rule}."
    counts = {bit: int(((status & bit) != 0).sum()) for bit in MEANINGS}
    rows = [
        (b.name, f"{n:,}", f"{100 * n / total:.2f} %", MEANINGS[b]) for b, n in counts.items() if n
    ]
    if not rows:
        return _section("Failures by cause", _paragraph(note))
    table = _table(("status", "trials", "share", "meaning"), rows, (1, 2))
    figure = charts.html(charts.failures(status), "failures")
    return _section("Failures by cause", _paragraph(note), table, figure)


def _provenance(run: Run) -> str:
    p, e = run.provenance, run.provenance["environment"]
    git = p.get("git", {})
    commit = git.get("commit") or "not a checkout"
    rows = [("commit", commit + (" with changes" if git.get("modified") else ""))]
    rows += [(name, e[name]) for name in ("python", "platform", "machine", "device")]
    rows += [(name, version) for name, version in e["versions"].items()]
    steps = [("started", p["started"]), *(("resumed", step) for step in p.get("resumed", []))]
    for word, step in steps:
        rows.append((f"{word} {step['time']}", shlex.join(["codesign", *step["command"][1:]])))
    texts = [(run.folder / name) for name in NAMES]
    found = {path.name: path.read_text(encoding="utf-8") for path in texts if path.exists()}
    found["provenance.json"] = json.dumps(p, indent=2)
    details = [
        f"<details><summary>{_text(name)}</summary><pre>{_text(text)}</pre></details>"
        for name, text in found.items()
    ]
    return _section("Provenance", _table((), rows), *details)
