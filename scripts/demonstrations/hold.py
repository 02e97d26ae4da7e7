"""Hold the object still while it is shaken: pressures by gradients, CEM and MPPI.

Every 0.1 s each method looks 0.3 s ahead from the present state and chooses factors on the four
pressures at six knots, between which they are linear; then the world goes on for 0.1 s.  All
methods minimise the same cost, the object's motion in the palm and the change of the pressures, and
begin with the plan before, shifted.  The gradient's method takes three values with gradients a
plan; the others have as many rollouts as take the same processor time.  How far each method moves
or spreads is what served it best on other grasps, of the same few lengths for all.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from codesign_jax.engines import make_engine
from codesign_jax.scene import Scene
from scripts.demonstrations import windows

GRASPS, BEGIN, END = 48, 450, 800
"""Held grasps, and the first and the last time step of the shaking."""
HORIZON, STRIDE, KNOTS = 30, 10, 6
MOST = 0.3
"""Largest relative change of a pressure."""
SLIP, CHANGE = 1e-4, 0.1
"""Units of the cost: motion a step [m], and relative change of a pressure between knots."""
GRADIENTS = 3
LENGTHS = 0.003, 0.01, 0.03, 0.1
"""Relative changes of a pressure by which methods move at first, or spread."""


class Plan(NamedTuple):
    """Worlds at the beginning of a plan, all with a leading axis (world,).

    Attributes:
      start: Positions and velocities.
      ctrl: Controls of the horizon, without the plan's factors.
      factors: Relative changes of the pressures before, (world, finger).
    """

    start: jax.Array
    ctrl: jax.Array
    factors: jax.Array


def in_palm(qpos: jax.Array) -> jax.Array:
    """Position of the object in the palm's frame [m], (..., 3), from positions (..., nq)."""
    turns = qpos[..., 3:6].reshape(-1, 3)  # roll, yaw, pitch: each axis turned by those before it
    away = (qpos[..., -7:-4] - qpos[..., :3]).reshape(-1, 3)
    own = jax.vmap(lambda t, v: Rotation.from_euler("XZY", t).inv().apply(v))(turns, away)
    return own.reshape(*qpos.shape[:-1], 3)


def factors_of(knots: jax.Array, steps: int = HORIZON) -> jax.Array:
    """Relative changes at each step, (..., step, finger), of knots (..., knot, finger)."""
    at = jnp.linspace(0.0, HORIZON, KNOTS)
    one = jax.vmap(lambda values: jnp.interp(jnp.arange(steps), at, values), 1, 1)
    flat = knots.reshape(-1, *knots.shape[-2:])
    return jax.vmap(one)(flat).reshape(*knots.shape[:-2], steps, knots.shape[-1])


def driven(ctrl: jax.Array, knots: jax.Array) -> jax.Array:
    """Controls with the knots' pressures."""
    return ctrl.at[..., 6:].multiply(1 + factors_of(knots, ctrl.shape[-2]))


class Shaking:
    """The grasps and the programs of all methods."""

    def __init__(self, scene: Scene, seed: int):
        """Simulates the grasps of a seed up to the shaking."""
        self.engine = make_engine("structured", scene)
        self.grasps = windows.held(scene, self.engine, GRASPS, seed)
        [self.start] = windows.states(self.engine, self.grasps, [BEGIN])
        # The pressures go on where the hand would let go: what is planned for is the shaking.
        ctrl = np.array(self.grasps.ctrl[:, : END + HORIZON])
        ctrl[:, BEGIN:, 6:] = ctrl[:, BEGIN : BEGIN + 1, 6:]
        self.ctrl, self.shape = ctrl, (GRASPS, KNOTS, ctrl.shape[2] - 6)
        self.costs = jax.jit(self._many)
        self.slopes = jax.jit(self._slopes)
        self.advance = jax.jit(self._advance)

    def _trace(self, plan: Plan, knots: jax.Array) -> Any:
        fields = self.grasps.fields._replace(start=plan.start)
        return self.engine.rollout(fields, driven(plan.ctrl, knots), trajectory=True)

    def _cost(self, plan: Plan, knots: jax.Array) -> jax.Array:
        """Costs of a plan for each world, (world,)."""
        trace = self._trace(plan, knots)
        assert trace.last is not None
        nq = trace.qpos.shape[-1]
        path = jnp.concatenate([trace.qpos, trace.last[:, None, :nq]], 1)
        moved = jnp.diff(in_palm(path), axis=1) / SLIP
        change = jnp.diff(jnp.concatenate([plan.factors[:, None], knots], 1), axis=1) / CHANGE
        return (moved**2).sum(2).mean(1) + (change**2).mean((1, 2))

    def _many(self, plan: Plan, knots: jax.Array) -> jax.Array:
        """Costs of candidates (candidate, world, knot, finger)."""
        return jax.vmap(lambda k: self._cost(plan, k))(knots)

    def _slopes(self, plan: Plan, knots: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Costs and their gradients by the knots of each world."""

        def total(knots: jax.Array) -> tuple[jax.Array, jax.Array]:
            each = self._cost(plan, knots)
            return each.sum(), each

        (_, each), slopes = jax.value_and_grad(total, has_aux=True)(knots)
        return each, slopes

    def _advance(self, plan: Plan, knots: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The state after a stride, and the path of the object in the palm on the way [m]."""
        plan = plan._replace(ctrl=driven(plan.ctrl, knots)[:, :STRIDE])
        fields = self.grasps.fields._replace(start=plan.start)
        trace = self.engine.rollout(fields, plan.ctrl, trajectory=True)
        assert trace.last is not None
        nq = trace.qpos.shape[-1]
        path = jnp.concatenate([trace.qpos, trace.last[:, None, :nq]], 1)
        slip = jnp.linalg.norm(jnp.diff(in_palm(path), axis=1), axis=2).sum(1)
        return trace.last, slip

    def first(self) -> tuple[Plan, jax.Array]:
        """The first plan's worlds, and a plan that changes nothing."""
        ctrl = jnp.asarray(self.ctrl[:, BEGIN : BEGIN + HORIZON])
        none = jnp.zeros(self.shape)
        return Plan(self.start, ctrl, none[:, 0]), none


class Gradient:
    """Of three points the best; two lie down the clipped gradient of the best one before.

    Each world's moves grow while they help and shrink where they do not.
    """

    def __init__(self, length: float, rollouts: int):
        """Takes the first moves' length."""
        self.length = jnp.full(GRASPS, length)

    def __call__(self, task: "Shaking", plan: Plan, knots: jax.Array, random: Any) -> jax.Array:
        """The knots of a plan, from those of the plan before."""
        best, least = knots, None
        slope = knots
        for _ in range(GRADIENTS):
            cost, new = task.slopes(plan, knots)
            better = jnp.ones(GRASPS, bool) if least is None else cost < least
            best, slope = (
                jnp.where(better[:, None, None], *x) for x in ((knots, best), (new, slope))
            )
            if least is not None:
                self.length = self.length * jnp.where(better, 1.5, 0.5)
            least = cost if least is None else jnp.minimum(cost, least)
            scale = jnp.sqrt((slope**2).mean((1, 2), keepdims=True))
            move = jnp.clip(slope / jnp.maximum(scale, 1e-30), -2.0, 2.0)
            knots = jnp.clip(best - self.length[:, None, None] * move, -MOST, MOST)
        return best


class Sampled:
    """Draws around the plan before, the first of which is that plan; their weighted mean."""

    def __init__(self, length: float, rollouts: int):
        """Takes the spread and the number of draws."""
        self.spread, self.rollouts = length, rollouts

    def weights(self, costs: np.ndarray) -> np.ndarray:
        """Weights of draws by their costs, both (draw, world)."""
        raise NotImplementedError

    def __call__(self, task: "Shaking", plan: Plan, knots: jax.Array, random: Any) -> jax.Array:
        """The knots of a plan, from those of the plan before."""
        noise = self.spread * random.normal(size=(self.rollouts, *task.shape))
        noise[0] = 0.0
        tried = np.clip(np.asarray(knots) + noise, -MOST, MOST).astype(np.float32)
        weights = self.weights(np.asarray(task.costs(plan, tried)))
        return jnp.asarray(np.einsum("cw,cwkf->wkf", weights, tried), jnp.float32)


class CrossEntropy(Sampled):
    """The mean of the best third."""

    def weights(self, costs: np.ndarray) -> np.ndarray:
        """See `Sampled`."""
        count = max(1, len(costs) // 3)
        return (np.argsort(np.argsort(costs, 0), 0) < count) / count


class PathIntegral(Sampled):
    """MPPI: weights exp(-cost / temperature), the temperature the costs' standard deviation."""

    def weights(self, costs: np.ndarray) -> np.ndarray:
        """See `Sampled`."""
        away = costs - costs.min(0)
        found = np.exp(-away / np.maximum(away.std(0), 1e-30))
        return found / found.sum(0)


def nothing(task: "Shaking", plan: Plan, knots: jax.Array, random: Any) -> jax.Array:
    """Constant pressure."""
    return jnp.zeros_like(knots)


METHODS = {"gradient": Gradient, "CEM": CrossEntropy, "MPPI": PathIntegral}


def shifted(knots: jax.Array) -> jax.Array:
    """The plan from a stride later on; it ends as it ended."""
    at = jnp.linspace(0.0, HORIZON, KNOTS)
    one = lambda values: jnp.interp(at + STRIDE, at, values)  # noqa: E731
    return jax.vmap(jax.vmap(one, 1, 1))(knots)


def drive(task: Shaking, choose: Callable, seed: int = 0) -> tuple[np.ndarray, float]:
    """Paths of slip over the shaking [m], (world,), and the processor time of all choices [s]."""
    random, (plan, knots) = np.random.default_rng(seed), task.first()
    slip, seconds = np.zeros(GRASPS), 0.0
    for begin in range(BEGIN, END, STRIDE):
        plan = plan._replace(ctrl=jnp.asarray(task.ctrl[:, begin : begin + HORIZON]))
        knots, used = windows.timed(choose, task, plan, knots, random)
        seconds += used
        start, way = task.advance(plan, knots)
        slip += np.asarray(way)
        plan = plan._replace(start=start, factors=factors_of(knots, STRIDE + 1)[:, STRIDE])
        knots = shifted(knots)
    return slip, seconds


def check(task: Shaking, step: float = 0.02) -> dict[str, Any]:
    """Cosine of the gradient by all knots with differences, and what both programs cost."""
    plan, none = task.first()
    plan = plan._replace(ctrl=jnp.asarray(task.ctrl[:, BEGIN : BEGIN + HORIZON]))
    _, slope = task.slopes(plan, none)
    moves = np.eye(math.prod(task.shape[1:])).reshape(-1, 1, *task.shape[1:])
    moves = np.tile(step * moves, (1, GRASPS, 1, 1)).astype(np.float32)
    parts = np.split(moves, 4)
    high, low = (
        np.concatenate([np.asarray(task.costs(plan, sign * m)) for m in parts]) for sign in (1, -1)
    )
    difference = ((high - low) / (2 * step)).T.reshape(task.shape)
    each = [windows.cosine(a, b) for a, b in zip(np.asarray(slope), difference, strict=True)]
    return {"median": float(np.median(each)), "quantile_10": float(np.quantile(each, 0.1))}


def run(scene: Scene) -> dict[str, Any]:
    """All methods on grasps of seed 1, with the lengths that served best on those of seed 2."""
    task, other = Shaking(scene, 1), Shaking(scene, 2)
    found: dict[str, Any] = {"grasps": GRASPS, "cosine": check(task), "methods": {}}
    plan, none = task.first()
    draws = jnp.stack([none] * 6)
    gradient, rollout = (
        min(windows.timed(f, plan, x)[1] for _ in range(6))
        for f, x in ((task.slopes, none), (task.costs, draws))
    )
    rollouts = math.ceil(GRADIENTS * gradient / (rollout / len(draws)))
    found |= {"gradient": gradient, "rollout": rollout / len(draws), "rollouts": rollouts}
    constant, _ = drive(task, nothing)
    found["constant"] = constant.tolist()
    for name, method in METHODS.items():
        lengths = {n: float(drive(other, method(n, rollouts))[0].mean()) for n in LENGTHS}
        best = min(lengths, key=lengths.__getitem__)
        task.costs(plan, jnp.stack([none] * rollouts))  # it compiles once for each task
        slip, seconds = drive(task, method(best, rollouts))
        gain = 1 - slip / constant
        entry = {"lengths": lengths, "length": best, "seconds": seconds, "slip": slip.tolist()}
        entry |= {"shorter": float(np.median(gain)), "improved": float((gain > 0).mean())}
        found["methods"][name] = entry
        print(name, {k: v for k, v in entry.items() if k != "slip"}, flush=True)
    return found
