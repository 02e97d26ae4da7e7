"""Trace to cost and status (paper Sec. VI.1, Fig. 3).

>>> import jax.numpy as jnp
>>> from codesign_jax import Trace, cost, scene
>>> grasping = scene.load("paper")
>>> tuple(round(float(t), 3) for t in grasping.window)  # in which a lost object counts [s]
(3.5, 8.0)
>>> away = jnp.where(jnp.arange(900) * 0.01 < 5.0, 0.02, 0.5)  # m: lost after 5 s
>>> trace = Trace(away, jnp.full(900, 0.2), jnp.zeros(900), jnp.zeros((900, 0)))
>>> float(cost.outcome(grasping, trace).cost)  # 3 (8 - 5) / (8 - 3.5)
2.0
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.judge import verdict
from codesign_jax.model.layout import layout
from codesign_jax.reuse import quickly_compiled
from codesign_jax.scene import Scene
from codesign_jax.scene.tables import Cost
from codesign_jax.types import Forces, Outcome, Status, Trace, Trial, failed

MOVED = 1e-3
"""Distance on the table from which on an object was moved [m] (chosen): contacts of the hand give
way by less before they shift an object, and one that is not touched stays where it is."""
_ROUNDING = 1.001
"""A ball's centre rests just as high as its radius: in float32 it may be a little higher."""


def outcome(
    scene: Scene, trace: Trace, initial: jax.Array | int = 0, trial: Trial | None = None
) -> Outcome:
    """Returns cost and status of one trial from its trace.

    c = c_max (t_end - t_lost) / (t_end - t_0), where t_lost is the first time in [t_0, t_end) at
    which the object is `lost_distance` or more from the hand centre; 0 if it is kept.  A trial is
    decided once it is lost: what happens later neither fails it nor needs simulating.  A failed
    trial is not kept and shows c_max; `particle_cost` decides how it counts in a mean cost.

    Args:
      scene: The scene; its numbers may be traced.
      trace: Trace of one world, arrays of shape (time,).
      initial: Bits of `Status` that the world starts with, shape () int32.
      trial: The trial, by the size of whose object it is told whether a released one rests on the
        table; without it by the largest object of the set.
    """
    steps = trace.distance.shape[0]
    start, end = scene.window
    dtype = trace.distance.dtype
    lost_step = _first(verdict.lost(verdict.bounds(scene), trace.distance, np.arange(steps)))
    bits = verdict.failures(scene, trace)
    bits = bits.at[0].set(bits[0] | jnp.asarray(initial, jnp.int32))
    bad_step = _first(bits != 0)
    bad = bad_step < lost_step
    lost = (lost_step < steps) & ~bad
    lost_time = jnp.where(lost, lost_step * scene.discretization.timestep, jnp.inf).astype(dtype)
    cost = scene.cost.maximum * (end - jnp.where(lost, lost_time, end)) / (end - start)
    stuck = verdict.as_bit(_stuck(scene, trace, trial) & ~lost & ~bad, Status.STUCK)
    status = bad * bits[jnp.minimum(bad_step, steps - 1)] | stuck
    capped, residual = _solved(trace, jnp.minimum(bad_step, lost_step))
    # An engine that does not tell how much is left warns of any step at its limit.
    above = capped > 0 if trace.residual is None else residual > scene.newton.residual
    status |= verdict.as_bit(above, Status.SOLVER_CAP)
    status |= verdict.as_bit(lost & _unmoved(scene, trace, trial), Status.UNMOVED)
    cost = jnp.where(failed(status), scene.cost.maximum, cost).astype(dtype)
    return Outcome(cost, status, lost_time, jnp.where(bad, bad_step, -1), capped, residual)


def particle_cost(scene: Scene, outcomes: Outcome) -> jax.Array:
    """Mean cost over a particle's trials by the scene's rule for failed ones.

    "exclude" (the paper's) averages the trials that did not fail, the maximum if all did; "worst"
    scores each failed trial with the maximum.

    Args:
      outcomes: Arrays with the trial as the last axis.

    Returns:
      Costs without the trial axis.
    """
    return _mean(scene.cost, outcomes.cost, failed(outcomes.status))


@quickly_compiled
def _mean(rule: Cost, costs: jax.Array, bad: jax.Array) -> jax.Array:
    """`particle_cost`; one program, not one an operation."""
    if rule.failure == "worst":
        return jnp.where(bad, rule.maximum, costs).mean(-1)
    count = (~bad).sum(-1)
    mean = jnp.where(bad, 0.0, costs).sum(-1) / jnp.maximum(count, 1)
    return jnp.where(count > 0, mean, rule.maximum)


def shown(trace: Trace, record_qpos: bool, stop_when_lost: bool | None) -> Trace:
    """A trace for a cost of one's own: reading what was not simulated or recorded is refused.

    A world that stopped repeats the step at which it lost its object, which a cost of one's own
    would take for what happened.
    """
    if trace.forces is None:
        trace = trace._replace(forces=_NO_FORCES)
    if record_qpos:
        return trace
    return (_UNASKED if stop_when_lost is None else _WITHOUT_QPOS)(*trace)


@jax.tree_util.register_static
class _NoForces:
    """In the place of forces that were not recorded: to read them is an error in words."""

    def __getattr__(self, name: str) -> Any:
        if name in Forces._fields:
            raise ValueError(
                "a cost reads trace.forces, which are not recorded: give it the attribute "
                "record_forces = True, or pass record_forces=True beside cost="
            )
        raise AttributeError(name)


_NO_FORCES: Any = _NoForces()


def _refusing(name: str, problems: dict[str, str]) -> type:
    """A type of traces whose fields raise these errors; a tree of JAX as `Trace` is."""

    def refuse(problem: str) -> Callable:
        def read(*_: Any) -> None:
            raise ValueError(problem)

        return read

    fields = {field: property(refuse(problem)) for field, problem in problems.items()}
    # What unpacks or indexes the trace reads all of it.
    every = refuse(next(iter(problems.values())))

    def at(trace: Any, scene: Scene, phase: str | None = None) -> Trace:
        if "distance" in problems:
            raise ValueError(problems["distance"])
        return kind(*Trace(*tuple.__iter__(trace)).at(scene, phase))

    kind = type(name, (Trace,), fields | {"__iter__": every, "__getitem__": every, "at": at})
    return kind


_QPOS = "a cost reads trace.qpos, which is recorded with record_qpos=True: pass that beside cost="
_WITHOUT_QPOS = _refusing("TraceWithoutQpos", {"qpos": _QPOS})
_UNASKED = _refusing(
    "TraceUnasked",
    {
        field: f"a cost reads trace.{field}, but a world stops when it loses its object, and its "
        "last step repeats: pass stop_when_lost=False beside cost= to have all of the grasp, or "
        "stop_when_lost=True if the cost is to see it up to the loss only (faster)"
        for field in Trace._fields
    }
    | {"qpos": _QPOS},
)


def _first(condition: jax.Array) -> jax.Array:
    steps = condition.shape[0]
    return jnp.where(condition.any(), jnp.argmax(condition), steps).astype(jnp.int32)


def _solved(trace: Trace, decided: jax.Array) -> tuple[jax.Array, jax.Array]:
    """State of the solver in the steps before the trial was decided."""
    dtype = trace.distance.dtype
    untold = jnp.full((), jnp.nan, dtype)
    if trace.status is None:
        return untold, untold
    # The last entry's step leads to a state that nothing reads.
    steps = trace.status.shape[0]
    counts = np.arange(steps) < jnp.minimum(decided, steps - 1)
    capped = counts & ((trace.status & int(Status.SOLVER_CAP)) != 0)
    share = (capped.sum() / jnp.maximum(counts.sum(), 1)).astype(dtype)
    if trace.residual is None:
        return share, untold
    return share, jnp.where(capped, trace.residual, 0.0).max().astype(dtype)


def _unmoved(scene: Scene, trace: Trace, trial: Trial | None) -> jax.Array:
    """Whether the object ends where it was put on the table; False where that is not known.

    Above the table it may have sunk by its weight, so that its height does not say.
    """
    if trace.last is None or trial is None:
        return jnp.zeros((), bool)
    first = layout(scene).dofs.size + 6  # of the object's position, behind wrist and fingers
    place = trace.last[first : first + 2]
    return jnp.hypot(*(place - trial.position)) < MOVED


def _stuck(scene: Scene, trace: Trace, trial: Trial | None) -> jax.Array:
    if not scene.effects.ungrasp:
        return jnp.zeros((), bool)
    # A resting object's centre is at most its bounding radius above the table, whatever side it
    # lies on.
    radii = jnp.stack([jnp.asarray(shape.radius) for shape in scene.objects.object])
    if trial is None:
        radius = radii.max() * (1 + 4 * scene.objects.noise.size)
    else:
        radius = radii[trial.shape] * trial.size * _ROUNDING
    resting = trace.height[-1] < radius
    return (trace.distance[-1] <= scene.cost.lost_distance) & ~resting
