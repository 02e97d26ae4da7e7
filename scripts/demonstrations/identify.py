"""Constants of hand and object from a shake: Gauss-Newton by reverse passes against CMA-ES.

Fingers that hold an object are shaken, and one step of pressure excites them.  Measured is where
all bodies are at the end of each window of 0.2 s, of which the state at the start is known.  The
Gauss-Newton matrix J'J comes from a few reverse passes with random cotangents s of signs +-1:
the mean of (J's)(J's)' is J'J.  One more pass gives the gradient, so that an iteration costs
one forward pass and six reverse ones, whatever the number of measurements.
"""

import json
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.engines import Engine, make_engine
from codesign_jax.model import layout
from codesign_jax.scene import Scene
from scripts.demonstrations import windows

NAMES = ("shear modulus", "pressure gain", "friction", "contact stiffness", "object mass")
GUESS = np.log([1.3, 0.7, 1.5, 0.7, 1.2])
"""Logarithms of the factors on the constants at which a search begins; the true ones are 1."""
GRASPS, STARTS, STEPS = 24, (480, 600, 720), 20
POSITION, ANGLE = 1e-4, 2e-3
"""Standard deviations of the measurements [m, rad]."""
EXCITATION = 0.1
"""Relative step of the pressures, up and down in turn."""
PROBES, ITERATIONS, SEEDS = 5, 10, 10
DAMPINGS = 10.0 ** np.arange(-4, 3)
POPULATION = 1 + len(DAMPINGS)
"""Candidates of a generation: Hansen's 4 + 3 log(5), which is as many as there are dampings."""


class Windows(NamedTuple):
    """Windows with a leading axis (window,)."""

    grasps: windows.Grasps
    start: jax.Array
    ctrl: jax.Array

    def ends(self, scene: Scene, engine: Engine, logs: jax.Array) -> jax.Array:
        """Positions at the end, (window, nq), with factors exp(logs), (window, constant)."""
        modulus, gain, friction, stiffness, mass = jnp.exp(logs).T
        trials = self.grasps.trials
        trials = trials._replace(
            stiffness=modulus * trials.stiffness,
            friction=friction * trials.friction,
            mass=mass * trials.mass,
        )
        numbers = scene.constants()
        contact = numbers.contact
        numbers = numbers._replace(
            contact=contact._replace(normal_stiffness=stiffness * contact.normal_stiffness)
        )
        fields, *_ = rollout.prepare(scene, self.grasps.params, trials, numbers)
        ctrl = self.ctrl.at[:, :, 6:].multiply(gain[:, None, None])
        last = engine.rollout(fields._replace(start=self.start), ctrl).last
        assert last is not None
        return last[:, : self.grasps.fields.qpos.shape[1]]


def make_windows(scene: Scene, engine: Engine) -> Windows:
    """The windows of all grasps, one start after the other."""
    grasps = windows.held(scene, engine, GRASPS)
    starts = windows.states(engine, grasps, list(STARTS))
    ctrl = jnp.concatenate([grasps.ctrl[:, s : s + STEPS] for s in STARTS])
    sign = np.where(np.arange(len(ctrl)) % 2, -1.0, 1.0)[:, None, None]
    ctrl = ctrl.at[:, :, 6:].multiply(1 + EXCITATION * sign)
    many = jax.tree.map(lambda v: jnp.concatenate([v] * len(STARTS)), grasps)
    return Windows(many, jnp.concatenate(starts), ctrl)


def deviations(scene: Scene) -> np.ndarray:
    """Standard deviations of what is measured, shape (nq,); a quaternion has half the angle's."""
    joints = layout(scene).dofs.size
    parts = [POSITION] * 3 + [ANGLE] * (3 + joints) + [POSITION] * 3 + [ANGLE / 2] * 4
    return np.array(parts, np.float32)


class Search:
    """The problem: windows, what is measured of them, and two ways to the constants."""

    def __init__(self, scene: Scene, engine: Engine, given: Windows):
        """Simulates the windows with the true constants."""
        self.sigma, count = deviations(scene), len(given.ctrl)

        def ends(logs: jax.Array) -> jax.Array:
            return given.ends(scene, engine, logs)

        self._truth = np.asarray(jax.jit(ends)(jnp.zeros((count, len(NAMES)))))
        self.measured, self.count, self._ends = self._truth, count, ends
        self.residuals = jax.jit(self._residuals)
        self.linearized = jax.jit(self._linearized)
        self.losses = jax.jit(self._losses)

    def measure(self, seed: int) -> None:
        """Draws the noise."""
        noise = self.sigma * np.random.default_rng(seed).normal(size=self._truth.shape)
        self.measured = self._truth + noise.astype(np.float32)

    def _residuals(self, logs: jax.Array, measured: jax.Array) -> jax.Array:
        return (self._ends(logs) - measured) / self.sigma

    def _losses(self, logs: jax.Array, measured: jax.Array) -> jax.Array:
        """Half of the sum of squares, for logarithms of shape (candidate, constant)."""
        each = jax.vmap(lambda x: self._residuals(jnp.tile(x, (self.count, 1)), measured))(logs)
        return 0.5 * (each**2).sum((1, 2))

    def _linearized(
        self, logs: jax.Array, measured: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Half of the sum of squares, its gradient, and an estimate of J'J."""
        found, pull = jax.vjp(
            lambda x: self._residuals(x, measured), jnp.tile(logs, (self.count, 1))
        )
        signs = jax.random.rademacher(key, (PROBES, *found.shape), found.dtype)
        [bars] = jax.vmap(pull)(jnp.concatenate([found[None], signs]))
        gradient, rows = bars[0].sum(0), bars[1:]
        return 0.5 * (found**2).sum(), gradient, jnp.einsum("pwi,pwj->ij", rows, rows) / PROBES

    def gauss_newton(self, seed: int) -> tuple[np.ndarray, list[float], float]:
        """Levenberg's and Marquardt's method; the logarithms, all losses, and the seconds.

        Of steps with several dampings, whose losses are one batch of rollouts, it takes the best.
        """
        logs, losses, seconds = GUESS.astype(np.float32), [], 0.0
        for k in range(ITERATIONS):
            key = jax.random.fold_in(jax.random.key(seed), k)
            found, used = windows.timed(self.linearized, logs, self.measured, key)
            loss, gradient, matrix = (np.asarray(v, float) for v in found)
            scale = np.diag(np.diag(matrix))
            steps = [np.linalg.solve(matrix + d * scale, gradient) for d in DAMPINGS]
            tried = np.stack([logs, *(logs - s for s in steps)]).astype(np.float32)
            each, more = windows.timed(self.losses, tried, self.measured)
            logs, seconds = tried[int(np.nanargmin(each))], seconds + used + more
            losses.append(float(loss))
        return logs, losses, seconds

    def cma_es(self, seed: int, budgets: list[float]) -> list[dict[str, Any]]:
        """The best of all candidates within each of some processor times, shortest first."""
        from evosax.algorithms import CMA_ES

        strategy = CMA_ES(POPULATION, jnp.zeros(len(NAMES)))
        params = strategy.default_params.replace(std_init=0.3)
        key = jax.random.key(seed)
        state = strategy.init(key, jnp.asarray(GUESS, jnp.float32), params)
        ask, tell = jax.jit(strategy.ask), jax.jit(strategy.tell)
        best, used, count, found = (GUESS, np.inf), 0.0, 0, []
        for seconds in budgets:
            while used < seconds:
                key, one, other = jax.random.split(key, 3)
                asked, state = ask(one, state, params)
                losses, more = windows.timed(self.losses, asked, self.measured)
                state, _ = tell(other, asked, losses, state, params)
                place = int(np.argmin(losses))
                if losses[place] < best[1]:
                    best = np.asarray(asked[place], float), float(losses[place])
                used, count = used + more, count + POPULATION
            errors = np.expm1(best[0]).tolist()
            found.append({"seconds": used, "candidates": count, "loss": best[1], "errors": errors})
        return found


def jacobian(search: Search, step: float) -> np.ndarray:
    """Residuals by logarithms at the truth, by central differences: (window, nq, constant)."""
    columns = []
    for k in range(len(NAMES)):
        move = np.tile(step * np.eye(len(NAMES))[k], (search.count, 1)).astype(np.float32)
        sides = [np.asarray(search.residuals(s * move, search.measured)) for s in (1, -1)]
        columns.append((sides[0] - sides[1]) / (2 * step))
    return np.stack(columns, -1)


def check(search: Search) -> dict[str, Any]:
    """Whether gradients mean something here: against differences over 1 %, and their cost."""
    difference = jacobian(search, 0.01)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], search.measured.shape)
    signs = signs.astype(np.float32)

    @jax.jit
    def along(logs: jax.Array) -> jax.Array:
        return jax.grad(lambda x: (search._residuals(x, search.measured) * signs).sum())(logs)

    slope = np.asarray(along(jnp.zeros((search.count, len(NAMES)))))
    want = np.einsum("wq,wqi->wi", signs, difference)
    cosines = [windows.cosine(slope[:, i], want[:, i]) for i in range(len(NAMES))]
    information = np.einsum("wqi,wqj->ij", difference, difference)
    bound = np.sqrt(np.diag(np.linalg.inv(information)))
    return {
        "cosine": dict(zip(NAMES, cosines, strict=True)),
        "cramer_rao": dict(zip(NAMES, bound.tolist(), strict=True)),
    }


def run(scene: Scene) -> dict[str, Any]:
    """All seeds; seconds are processor time, "compile" what the first call takes longer."""
    engine = make_engine("structured", scene)
    search = Search(scene, engine, make_windows(scene, engine))
    guess, compiled = GUESS.astype(np.float32), []
    programs = (
        (search.linearized, guess, search.measured, jax.random.key(0)),
        (search.losses, np.tile(guess, (POPULATION, 1)), search.measured),
    )
    for program in programs:
        compiled.append(windows.timed(*program)[1] - windows.timed(*program)[1])
    found: dict[str, Any] = {"windows": search.count, "names": NAMES, "seeds": []}
    found |= {"check": check(search), "compile": compiled}
    for seed in range(SEEDS):
        search.measure(seed)
        logs, losses, seconds = search.gauss_newton(seed)
        # With the same time to search, and with the same time from the first compile on.
        others = search.cma_es(seed, [seconds, seconds + compiled[0]])
        errors = np.expm1(logs.astype(float)).tolist()
        entry = {"seconds": seconds, "losses": losses, "errors": errors, "cma_es": others}
        found["seeds"].append(entry)
        print(json.dumps(entry), flush=True)
    return found
