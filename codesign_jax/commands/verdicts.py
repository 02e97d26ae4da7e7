"""What simulated trials say about a design, in words."""

import numpy as np

from codesign_jax import codesign, cost, runs
from codesign_jax.report import statistics
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, failed


def trials(count: int) -> str:
    """A number of trials in words."""
    return f"{count} trial" if count == 1 else f"{count} trials"


def verdict(scene: Scene, outcomes: Outcome) -> str:
    """Says how a design did, with how sure that is.

    Args:
      scene: The scene, with its rule for failed trials.
      outcomes: Outcomes of its trials, NumPy arrays of shape (trial,).
    """
    counted = cost.counts(scene, outcomes.status)
    if failed(outcomes.status).all():
        causes = runs.failure_counts(outcomes.status)
        return f"every trial failed ({causes}): none counts as kept or lost"
    limit, mean = codesign.SUCCESS_COST, float(cost.particle_cost(scene, outcomes))
    side = "below" if mean < limit else "not below"
    kept, total = int((outcomes.cost[counted] < limit).sum()), int(counted.sum())
    share = statistics.wilson(kept, total)
    return (
        f"mean cost {mean:.4f} over {trials(total)}{_failures(scene, outcomes.status)}, {side} the "
        f"limit of success, {limit}; {kept} of {total} trials kept the object: the design keeps it "
        f"in {100 * share.low:.0f} to {100 * share.high:.0f} % of grasps (95 % interval)"
    )


def of_object(scene: Scene, outcomes: Outcome) -> str:
    """Says how a design did with one object, shorter than `verdict`; arguments as of that."""
    counted = int(cost.counts(scene, outcomes.status).sum())
    warnings = runs.warning_counts(outcomes.status)
    lost = int(np.isfinite(outcomes.lost_time).sum())
    mean = float(cost.particle_cost(scene, outcomes))
    text = (
        f"mean cost {mean:.3f} over {trials(counted)}, {lost} lost" if counted else "no mean cost"
    )
    text += _failures(scene, outcomes.status)
    return text + (f"; warnings: {warnings}" if warnings else "")


def _failures(scene: Scene, status: np.ndarray) -> str:
    """How many trials failed, of what, and what they count; empty if none did."""
    count = int(failed(status).sum())
    if not count:
        return ""
    causes = runs.failure_counts(status)
    if scene.cost.failure == "exclude":
        return f" ({count} more failed, left out: {causes})"
    return f" ({count} of them failed, counted as {scene.cost.maximum:g}: {causes})"
