"""The part of a report that shows the chosen design and how its trials ended."""

import numpy as np

from codesign_jax import codesign, cost, types
from codesign_jax.report import markup
from codesign_jax.report.of_run import Run
from codesign_jax.report.statistics import wilson
from codesign_jax.types import Outcome


def design(run: Run) -> str:
    """The design's parameters within their ranges, and its success in all and by object."""
    chosen, trials = run.chosen, run.chosen.trials
    kept, counted = _kept(run, trials)
    source = "the final test" if chosen.tested else "its last episode (there was no final test)"
    success = f"In {source} it kept the object in {_share(int(kept.sum()), int(counted.sum()))}."
    note = (
        f"Particle {chosen.particle}, mean cost {chosen.cost:.4f} over {counted.sum()} of "
        f"{counted.size} trials of {source}. It was chosen as the best by these very trials, which "
        "flatters it. "
    )
    again = ["evaluate", "--run", str(run.folder), "--trials", "150", "--accuracy", "reference"]
    parts = [
        markup.paragraph(success, "key"),
        markup.paragraph(_reference(run), "key"),
        markup.paragraph(note + "New trials at the reference accuracy: ", "note", again),
        _by_object(run, kept, counted),
        _parameters(run),
    ]
    return markup.section("Chosen design", *parts)


def _kept(run: Run, trials: Outcome) -> tuple[np.ndarray, np.ndarray]:
    """Which trials kept the object, and which count by the scene's rule for failed ones."""
    counted = np.asarray(cost.counts(run.scene, np.asarray(trials.status)))
    return (np.asarray(trials.cost) < codesign.SUCCESS_COST) & counted, counted


def _reference(run: Run) -> str:
    """How the design did in the fresh trials at the end of the run; empty without them."""
    if run.reference is None:
        return ""
    kept, counted = _kept(run, run.reference)
    left = counted.size - int(counted.sum())
    failed = f" ({left} more failed)" if left else ""
    return (
        "In fresh trials at the reference accuracy, which had no part in the choice, it kept the "
        f"object in {_share(int(kept.sum()), int(counted.sum()))}{failed}."
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


def _by_object(run: Run, kept: np.ndarray, counted: np.ndarray) -> str:
    """Success for each object; every batch of trials takes turns between the objects."""
    failed = types.failed(np.asarray(run.chosen.trials.status))
    names = [shape.name for shape in run.scene.objects.object]
    index = np.arange(counted.size) % run.settings.trials % len(names)
    rows = []
    for k, name in enumerate(names):
        own = index == k
        if own.any():
            share = _share(int(kept[own].sum()), int(counted[own].sum()))
            rows.append((name, share, int(failed[own].sum())))
    return markup.table(("object", "kept", "failed trials"), rows, (2,))


def _parameters(run: Run) -> str:
    """The design's parameters, a row each."""
    space = run.space
    values, low, high = (
        space.in_units(np.asarray(v)) for v in (run.chosen.design, space.low, space.high)
    )
    rows = []
    for k, name in enumerate(space.names):
        at = 100 * float((values[k] - low[k]) / (high[k] - low[k]))
        bar = markup.Html(
            f"<div class='scale'><i style='left:{min(max(at, 0), 100):.1f}%'></i></div>"
        )
        domain = "morphology" if space.is_morphology[k] else "control"
        number = (f"{v:.4g}" for v in (values[k], low[k], high[k]))
        rows.append((name, *number, space.units[k], domain, bar))
    head = ("parameter", "value", "lowest", "highest", "unit", "domain", "within its range")
    return markup.table(head, rows, (1, 2, 3))
