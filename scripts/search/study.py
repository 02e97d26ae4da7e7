"""One optimiser over many seeds at once, and how its recommended designs do on fresh trials.

At every mark the optimiser's best particles meet fresh trials, and the one that costs least in
these is what it recommends there: 25 particles in 12 trials each, or the final test of an optimiser
that says how many finalists it has.  These trials count as the search's; those by which the
recommended design is judged do not.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, optimize, rollout, runs
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine
from codesign_jax.optimize import Optimizer, State
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, Trial, failed
from scripts.shared.output import write_arrays

CANDIDATES, ROUNDS = 25, 12
"""Most particles that are tested at a mark, and trials of each, but for whole turns of the objects;
an optimiser with `finalists` has its runs' final test."""
UNFINISHED = 3
"""Exit status of a command that ran out of --minutes."""
STREAM_JUDGE = 0x6A756467
"""Stream of the trials that judge a recommended design ("judg")."""


@dataclasses.dataclass(frozen=True)
class Case:
    """An optimiser with its sizes, by a name such as `screened-es:sigma=0.2,particles=12,tests=0`.

    Attributes:
      name: The name.
      optimizer: The optimiser.
      particles: Its particles.
      trials: Trials of each in an episode.
      tests: Trials of each finalist that choose at a mark; 0 recommends the state's first particle.
      finalists: Particles that these choose from.
    """

    name: str
    optimizer: Optimizer
    particles: int
    trials: int
    tests: int = ROUNDS
    finalists: int = CANDIDATES

    @property
    def worlds(self) -> int:
        """Grasps of an episode of a seed."""
        return self.particles * self.trials


def make_case(name: str, space: DesignSpace, preset: str, objects: int = 3) -> Case:
    """A case by its name; what the name does not change has the command's defaults."""
    kind, _, changes = name.partition(":")
    given = dict(pair.split("=") for pair in changes.split(",") if pair)
    sizes = {n: int(given.pop(n)) for n in ("particles", "trials") if n in given}
    usual = runs.make_settings(
        preset,
        "concurrent",
        "morphology",
        "structured",
        0,
        optimizer=kind,
        objects=objects,
        **sizes,
    )
    made: Any = codesign.make_optimizer(kind, space)
    own_test = getattr(made, "finalists", None)
    tests = int(given.pop("tests", usual.test_trials if own_test else ROUNDS))
    finalists = min(own_test or CANDIDATES, usual.particles)
    if tests == 0 and not made.keeps_best:
        raise ValueError(f"{name}: tests=0 is for optimisers whose first particle is the best")
    own = {n: _as(type(getattr(made, n)), v) for n, v in given.items()}
    optimizer = dataclasses.replace(made, **own)
    return Case(name, optimizer, usual.particles, usual.trials, tests, finalists)


def _as(kind: type, text: str) -> Any:
    """A field's value from its text; "4.0" is a whole number too."""
    return text if kind is str else kind(float(text))


class Study:
    """The episodes of one case over many seeds, from a file and back to it."""

    def __init__(
        self,
        case: Case,
        scene: Scene,
        engine: Engine,
        space: DesignSpace,
        *,
        seeds: int,
        budget: int,
        tests: int,
        marks: int = 9,
        at: Sequence[int] = (),
        first_seed: int = 0,
        chunk: int,
        path: Path,
    ):
        """Reads what is done."""
        self.case, self.scene, self.engine, self.space = case, scene, engine, space
        self.tests, self.chunk, self.path = tests, chunk, path
        self.keys = jax.vmap(jax.random.key)(first_seed + jnp.arange(seeds))
        self.mask = jnp.ones(space.num_parameters, bool)
        objects = len(scene.objects.object)
        self.rounds = -(-case.tests // objects) * objects
        self.batch = min(chunk, seeds * case.worlds)
        self.simulate = jax.jit(self._simulate)
        self.ask = jax.jit(jax.vmap(lambda state: case.optimizer.ask(state, self.mask)))
        self.tell = jax.jit(
            jax.vmap(lambda state, x, c: case.optimizer.tell(state, x, c, self.mask)[0])
        )
        episodes = self._episodes(budget)
        first = getattr(case.optimizer, "screening", 0) + getattr(case.optimizer, "retests", 0) + 1
        self.marks = sorted(
            {*map(self._episodes, at)}
            # Backwards, so that a single mark is the last one.
            or {*np.geomspace(episodes, min(first, episodes), marks).round().astype(int)}
        )
        self.kept: dict[int, np.ndarray] = {}
        self.designs: dict[int, np.ndarray] = {}
        self.state, self.last = self._restore() if path.exists() else (self._start(), None)

    def _episodes(self, grasps: int) -> int:
        """Episodes of a seed after which no more than so many grasps have been simulated."""
        return max(1, int((grasps - self.before - self.tested) / self.case.worlds))

    @property
    def before(self) -> int:
        """Grasps that find a poor seed particle."""
        return 0 if getattr(self.case.optimizer, "screens", False) else self.case.worlds

    @property
    def tested(self) -> int:
        """Grasps by which a mark chooses."""
        return self.case.finalists * self.rounds

    @property
    def done(self) -> int:
        """Finished episodes."""
        return int(self.state.episode[0])

    @property
    def finished(self) -> bool:
        """Whether every mark is judged."""
        return len(self.kept) == len(self.marks)

    def step(self) -> int:
        """Simulates an episode, or judges the designs of a mark; returns its grasps."""
        if self.done in self.marks and self.done not in self.kept:
            return self._mark()
        population = self.ask(self.state)
        outcome = self._all(
            population, self._noise(codesign.STREAM_TRIAL, self.done), self.case.trials
        )
        cost = self._costs(outcome)
        self.last = population, cost
        self.state = self.tell(self.state, population, cost)
        return cost.size * self.case.trials

    def save(self) -> None:
        """Writes what is done."""
        arrays = {f"state{i}": leaf for i, leaf in enumerate(self._leaves())}
        for name, values in (("kept", self.kept), ("designs", self.designs)):
            arrays |= {f"{name}{mark}": value for mark, value in values.items()}
        if self.last is not None:
            arrays |= {"population": self.last[0], "cost": self.last[1]}
        write_arrays(self.path, {n: np.asarray(v) for n, v in arrays.items()})

    def row(self) -> dict[str, Any]:
        """Grasps of a seed at each mark, all counted, and the share that its design keeps."""
        found = sorted(self.kept)
        return {
            "optimizer": self.case.name,
            "particles": self.case.particles,
            "trials": self.case.trials,
            "grasps": [int(self.before + e * self.case.worlds + self.tested) for e in found],
            "kept": [np.round(self.kept[e], 4).tolist() for e in found],
        }

    def _start(self) -> State:
        space, first = self.case.optimizer.space, np.arange(self.case.particles)
        drawn = jax.jit(jax.vmap(lambda key: optimize.candidates(key, space, first)))(self.keys)
        rows = jnp.zeros(len(self.keys), int)
        if self.before:
            noise = self._noise(codesign.STREAM_SCREEN, 0)
            poor = self._costs(self._all(drawn, noise, self.case.trials)) > codesign.SEED_COST
            if not np.asarray(poor.any(1)).all():
                raise RuntimeError("a seed has no poor particle among its first candidates")
            rows = poor.argmax(1)
        init = jax.vmap(lambda k, x: self.case.optimizer.init(k, x, self.case.particles))
        return jax.jit(init)(self.keys, drawn[jnp.arange(len(rows)), rows])

    def _mark(self) -> int:
        """Chooses what is recommended now, and judges it."""
        assert self.last is not None
        best_first = self.case.optimizer.keeps_best
        return self.judge(self.done, *((self.state.particles,) if best_first else self.last))

    def judge(self, mark: int, particles: jax.Array, costs: jax.Array | None = None) -> int:
        """Chooses from particles by fresh trials, and judges the chosen one by others.

        Returns:
          The number of grasps.
        """
        if costs is not None:
            order = jnp.argsort(jnp.asarray(costs), axis=1)[..., None]
            particles = jnp.take_along_axis(jnp.asarray(particles), order, 1)
        chosen = particles[:, : self.case.finalists]
        best, grasps = jnp.zeros(len(chosen), int), 0
        if self.rounds:
            noise = self._noise(codesign.STREAM_TEST, mark)
            tested = self._costs(self._all(chosen, noise, self.rounds))
            best, grasps = tested.argmin(1), tested.size * self.rounds
        design = chosen[jnp.arange(len(chosen)), best][:, None]
        outcome = self._all(design, self._noise(STREAM_JUDGE, 0), self.tests)
        kept = ~failed(np.asarray(outcome.status)) & (np.asarray(outcome.cost) < SUCCESS_COST)
        self.kept[mark] = kept[:, 0].mean(-1)
        self.designs[mark] = np.asarray(design[:, 0])
        return grasps + kept.size

    def _noise(self, stream: int, index: int) -> jax.Array:
        return jax.vmap(lambda key: codesign.stream_key(key, stream, index))(self.keys)

    def _costs(self, outcome: Outcome) -> jax.Array:
        return jax.jit(lambda found: particle_cost(self.scene, found))(outcome)

    def _all(self, populations: jax.Array, keys: jax.Array, trials: int) -> Outcome:
        """Outcomes of shape (seed, particle, trial) in the trials of these keys."""
        return self.outcomes(populations, self.drawn(keys, trials))

    def outcomes(self, populations: jax.Array, trials: Trial) -> Outcome:
        """Outcomes of shape (seed, particle, trial), by one program whatever the shape."""
        shape = (*populations.shape[:2], trials.yaw.shape[1])
        seed, particle, trial = np.indices(shape).reshape(3, -1)
        designs, trials = np.asarray(populations), jax.tree.map(np.asarray, trials)
        parts = []
        for start in range(0, len(seed), self.batch):
            rows = np.minimum(np.arange(start, start + self.batch), len(seed) - 1)
            own = jax.tree.map(lambda v, at=(seed[rows], trial[rows]): v[at], trials)
            parts.append(self.simulate(designs[seed[rows], particle[rows]], own))
        found = jax.tree.map(lambda *v: np.concatenate(v)[: len(seed)], *parts)
        return jax.tree.map(lambda v: v.reshape(*shape, *v.shape[1:]), found)

    def drawn(self, keys: jax.Array, trials: int) -> Trial:
        """Trials of each key, of objects that take turns, with leading axes (seed, trial)."""
        return jax.vmap(lambda key: rollout.sample_trials(self.scene, key, trials))(keys)

    def _simulate(self, designs: jax.Array, trials: Trial) -> Outcome:
        hands = jax.vmap(self.space.params)(designs)
        return rollout.simulate(self.scene, self.engine, hands, trials)[0]

    def _leaves(self) -> list[jax.Array]:
        state = self.state._replace(key=jax.vmap(jax.random.key_data)(self.state.key))
        return jax.tree.leaves(state)

    def _restore(self) -> tuple[State, Any]:
        """What a file holds of the study; the arrays' order is that of a state."""
        n, zeros = self.case.particles, jnp.zeros(self.mask.shape)
        like = jax.eval_shape(jax.vmap(lambda k: self.case.optimizer.init(k, zeros, n)), self.keys)
        with np.load(self.path) as stored:
            shapes = jax.tree.leaves(like._replace(key=np.zeros(0)))
            leaves = [jnp.asarray(stored[f"state{i}"]) for i in range(len(shapes))]
            for name in stored:
                for word, values in (("kept", self.kept), ("designs", self.designs)):
                    if name.startswith(word):
                        values[int(name.removeprefix(word))] = stored[name]
            last = [jnp.asarray(stored[n]) for n in ("population", "cost") if n in stored]
        state = jax.tree.unflatten(jax.tree.structure(like), leaves)
        if state.particles.shape != like.particles.shape:
            raise ValueError(f"{self.path} is of other seeds or sizes: choose another folder")
        return state._replace(key=jax.vmap(jax.random.wrap_key_data)(state.key)), (*last,) or None
