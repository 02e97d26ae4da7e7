"""The part of a report that shows the chosen design and how its trials ended."""

import jax
import numpy as np

from codesign_jax.judge import sentences, stress, verdict
from codesign_jax.judge.sentences import Judged
from codesign_jax.model import morphology
from codesign_jax.report import advice, markup
from codesign_jax.report.of_run import Run
from codesign_jax.runs import tables
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.statistics import wilson

ENDS = ("kept", "unmoved", "lift", "shaking", "not_released", "fault")
"""How a trial ends, with the causes of a loss, as style.css colours them."""


def endings(run: Run) -> str:
    """How the judging trials of the design ended, and what to try."""
    chosen = run.chosen
    judged = run.judged
    source = "the final test" if chosen.tested else "its last episode (there was no final test)"
    note = (
        f"Particle {chosen.particle}, chosen as the best by {source}, which flatters it: "
        f"{sentences.of_trials(run.scene, chosen.outcomes)}. "
    )
    if (retest := run.record.retest) is not None:
        note += f"Of its finalists: {retest.sentence(run.settings.search_accuracy)}. "
    again = ["evaluate", "--run", str(run.folder), "--accuracy", "reference"]
    return markup.section(
        "How the grasps ended",
        by_object(judged, _turns(run)),
        *trials(judged),
        *_advice(run),
        markup.paragraph(note + "More fresh trials: ", "note", again),
    )


def trials(judged: Judged) -> list[str]:
    """The judging trials in words, with the rule and warnings."""
    return [
        markup.paragraph(f"{judged.details}. Rule: {verdict.RULE}.", "note"),
        *(markup.paragraph(words, "warning") for words in sentences.warnings(judged)),
        *(markup.paragraph(words, "note") for words in sentences.solver(judged.outcomes)),
    ]


def _advice(run: Run) -> list[str]:
    command = run.provenance["started"]["command"]
    tips = advice.after_search(run.judged, run.settings, command, run.folder)
    return [markup.paragraph(f"To try {tip.what}: ", "advice", tip.command) for tip in tips]


def design(run: Run) -> str:
    """Warnings of the design, and its parameters within their ranges."""
    warnings = stress.of_design(run.scene, run.space.params(run.chosen.design))
    warnings += run.stress.warnings if run.stress else ()
    return markup.section(
        "Design",
        *(markup.paragraph(f"Warning: {words}.", "warning") for words in warnings),
        parameters(run.scene, run.space, run.chosen.design),
    )


def conditions(run: Run) -> str:
    """What the design keeps under other conditions."""
    if (result := run.stress) is None:
        return ""
    bars = []
    for kept in result.by_condition.values():
        total = result.trials * kept.size
        counts = {"kept": int(kept.sum()), "lost": total - int(kept.sum())}
        bars.append(markup.shares(counts, total))
    words = f"{result.trials} grasps each, at the run's accuracy."
    table = markup.table(
        ("condition", "", *result.head[1:]),
        [(name, bar, *rest) for (name, *rest), bar in zip(result.rows, bars, strict=True)],
        (2, 3),
    )
    return markup.section("Other conditions", table, markup.paragraph(words, "note"))


def fingers(run: Run) -> str:
    """What each finger is worth, and the command that judges the hand that lacks some."""
    if (result := run.worth) is None:
        return ""
    rows = []
    for hand, (name, *cells, word) in zip(result.hands, result.rows, strict=True):
        alone = len(hand) == 1
        label = markup.finger(hand[0], name) if alone else name
        rows.append((label, word, *cells))
    head = (result.head[0], result.head[-1], *result.head[1:-1])
    named = {k: f"finger {hand[0]}" for k, hand in enumerate(result.hands) if len(hand) == 1}
    command = []
    if result.least:
        command = ["evaluate", "--run", str(run.folder), "--accuracy", "reference", "--stress"]
        command += ["--without", *map(str, result.least)]
    text = result.sentence[:1].upper() + result.sentence[1:]
    text += ". To judge that hand: " if command else "."
    return markup.section(
        "What each finger is worth",
        markup.paragraph(text, "", command),
        markup.table(head, rows, (*range(2, len(head)),), named),
        markup.paragraph(
            "Kept grasps of the hand without it, and of the whole hand in the same trials. A click "
            "on a finger shows it in the grasp above.",
            "note",
        ),
    )


def _turns(run: Run) -> np.ndarray:
    """Indices of the judging trials in their batch, shape (trial,)."""
    count = run.judged.outcomes.cost.size
    return np.arange(count) % (count if run.reference is not None else run.settings.trials)


def by_object(judged: Judged, turns: np.ndarray) -> str:
    """How the judging trials ended with each object.

    Args:
      turns: Indices of the trials in their batch, which takes turns between the objects.
    """
    names = [shape.name for shape in judged.scene.objects.object]
    rows = []
    for k, name in enumerate(names):
        of_object = turns % len(names) == k
        if of_object.any():
            mine = jax.tree.map(
                lambda v, of_object=of_object: np.asarray(v)[of_object], judged.outcomes
            )
            counts = verdict.tally(mine)
            share = wilson(counts.kept, counts.total)
            span = f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
            ends = (*verdict.losses(judged.scene, mine), counts.not_released, counts.fault)
            bar = markup.shares(dict(zip(ENDS, (counts.kept, *ends), strict=True)), counts.total)
            kept = f"{counts.kept} of {counts.total}"
            rows.append((name, bar, kept, *ends, span))
    words = ("lost: never moved", "slipped in the lift", "thrown in the shaking")
    words += ("not released", "faults")
    colored = [
        markup.Html(f"<i class='swatch {kind}'></i>{markup.text(word)}")
        for kind, word in zip(ENDS[1:], words, strict=True)
    ]
    head = ("object", "", "kept", *colored, "95 % interval of all")
    return markup.table(head, rows, (*range(2, len(head)),))


def parameters(scene: Scene, space: DesignSpace, design: np.ndarray) -> str:
    """A design [SI units] within the ranges of its parameters."""
    values, low, high = (space.in_units(np.asarray(v)) for v in (design, space.low, space.high))
    per_finger, others = tables.by_finger(space)

    def scale(k: int) -> markup.Html:
        at = 100 * float((values[k] - low[k]) / (high[k] - low[k]))
        bar = f"<div class='scale'><i style='left:{min(max(at, 0), 100):.1f}%'></i></div>"
        span = f"{low[k]:.4g} to {high[k]:.4g} {space.units[k]}"
        return markup.Html(f"<span title='{markup.text(span)}'>{values[k]:.4g}{bar}</span>")

    def named(name: str, k: int) -> str:
        return f"{name} {space.units[k]}"

    air = morphology.air(scene.hand, space.params(design))
    note = f"Below each value its place in its range. Air in all unloaded chambers: {air:.1f} cm³."
    parts = [markup.paragraph(note, "note")]
    if per_finger:
        head = ("finger", *(named(name, at[0]) for name, at in per_finger.items()))
        count = len(next(iter(per_finger.values())))
        rows = [
            (markup.finger(f), *(scale(at[f]) for at in per_finger.values())) for f in range(count)
        ]
        fingers = {f: f"finger {f}" for f in range(count)}
        parts.append(markup.table(head, rows, (*range(1, len(head)),), fingers))
    if others:
        head = [named(space.names[k], k) for k in others]
        parts.append(markup.table(head, [[scale(k) for k in others]], (*range(len(head)),)))
    return "".join(parts)
