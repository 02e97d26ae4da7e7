"""The episodes of an optimiser over many seeds, and what its recommended designs keep."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, optimize, rollout, runs
from codesign_jax.batch import LIMIT, WORLDS, in_chunks
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine, make_engine
from codesign_jax.judge import fresh_trials
from codesign_jax.optimize import Optimizer, OptimizerState
from codesign_jax.reuse import SceneProgram
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, Trial, failed
from scripts.shared import output

CANDIDATES = 25
ROUNDS = 12
"""Most particles that are tested at a mark, and trials of each, but for whole turns of the objects;
an optimiser with `finalists` has its runs' final test."""
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
        return self.particles * self.trials


def make_case(name: str, space: DesignSpace, preset: str, objects: int = 3) -> Case:
    """A case by its name; what the name does not change has the command's defaults."""
    kind, _, changes = name.partition(":")
    given = dict(pair.split("=") for pair in changes.split(",") if pair)
    sizes = {n: int(given.pop(n)) for n in ("particles", "trials") if n in given}
    choices = preset, "concurrent", "morphology", "structured", 0
    usual = runs.make_settings(*choices, optimizer=kind, objects=objects, **sizes)
    made: Any = codesign.make_optimizer(kind, space)
    own_test = getattr(made, "finalists", None)
    tests = int(given.pop("tests", usual.test_trials if own_test else ROUNDS))
    finalists = min(own_test or CANDIDATES, usual.particles)
    if tests == 0 and not made.keeps_best:
        raise ValueError(f"{name}: tests=0 is for optimisers whose first particle is the best")
    options = {n: _as(type(getattr(made, n)), v) for n, v in given.items()}
    optimizer = dataclasses.replace(made, **options)
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
        path: Path,
        first: int = 0,
        searched: Scene | None = None,
        judged: Scene | None = None,
    ):
        """Starts a study, or goes on with that of its file.

        Args:
          first: The first of the seeds.
          searched: The scene at the accuracy of the episodes; by default the scene.
          judged: The scene at the accuracy at which recommended designs are judged; likewise.
        """
        self.case = case
        self.scene = scene
        self.judged = judged or scene
        self.engine = engine
        self.space = space
        self.tests = tests
        self.path = path
        self.keys = jax.vmap(jax.random.key)(first + jnp.arange(seeds))
        self.mask = jnp.ones(space.num_parameters, bool)
        objects = len(scene.objects.object)
        self.rounds = -(-case.tests // objects) * objects
        most = WORLDS.get(jax.default_backend(), LIMIT)
        self.batch = min(most, seeds * case.worlds)
        self.programs: dict[Any, SceneProgram] = {}
        searched = searched or scene
        self.searched = searched
        task = codesign.Task(searched, space, case.trials, self._engine(searched))
        self.episode = task.side_by_side(case.optimizer)
        episodes = self._episodes(budget)
        begins = getattr(case.optimizer, "screening", 0) + getattr(case.optimizer, "retests", 0) + 1
        self.marks = sorted(
            {*map(self._episodes, at)}
            # Backwards, so that a single mark is the last one.
            or {*np.geomspace(episodes, min(begins, episodes), marks).round().astype(int)}
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
        return int(self.state.episode[0])

    @property
    def finished(self) -> bool:
        return len(self.kept) == len(self.marks)

    def run(self, progress: Callable[[int], None]) -> None:
        """Goes on to the last mark, and calls progress(grasps) after every step.

        Every step is saved, so that a later call goes on behind it, whatever ends this one.
        """
        while not self.finished:
            grasps = self.step()
            self.save()
            progress(grasps)

    def step(self) -> int:
        """Simulates an episode, or judges the designs of a mark; returns its grasps."""
        if self.done in self.marks and self.done not in self.kept:
            return self._mark()

        def run(seeds: np.ndarray) -> tuple[Any, ...]:
            states = jax.tree.map(lambda v: v[seeds], self.state)
            new, info = self.episode(states, jnp.tile(self.mask, (len(seeds), 1)))
            return new._replace(key=None), info.population, info.selection.cost

        parts = in_chunks(run, len(self.keys), max(1, self.batch // self.case.worlds))
        state, population, cost = jax.tree.map(lambda *v: np.concatenate(v), *parts)
        self.state = state._replace(key=self.keys)  # root keys, which stay
        self.last = population, cost
        return cost.size * self.case.trials

    def save(self) -> None:
        arrays = {f"state{i}": leaf for i, leaf in enumerate(self._leaves())}
        for name, values in (("kept", self.kept), ("designs", self.designs)):
            arrays |= {f"{name}{mark}": value for mark, value in values.items()}
        if self.last is not None:
            arrays |= {"population": self.last[0], "cost": self.last[1]}
        output.write_arrays(self.path, {n: np.asarray(v) for n, v in arrays.items()})

    def row(self) -> dict[str, Any]:
        """Grasps of a seed at each mark, all counted, and the share that its design keeps."""
        marks = sorted(self.kept)
        return {
            "optimizer": self.case.name,
            "particles": self.case.particles,
            "trials": self.case.trials,
            "grasps": [int(self.before + e * self.case.worlds + self.tested) for e in marks],
            "kept": [np.round(self.kept[e], 4).tolist() for e in marks],
        }

    def _start(self) -> OptimizerState:
        space = self.case.optimizer.space
        first = np.arange(self.case.particles)
        drawn = jax.jit(jax.vmap(lambda key: optimize.candidates(key, space, first)))(self.keys)
        rows = jnp.zeros(len(self.keys), int)
        if self.before:
            noise = self.noise(codesign.STREAM_SCREEN, 0)
            poor = self.costs(self.outcomes(drawn, noise, self.case.trials)) > codesign.SEED_COST
            if not np.asarray(poor.any(1)).all():
                raise RuntimeError("a seed has no poor particle among its first candidates")
            rows = poor.argmax(1)
        init = jax.vmap(lambda k, x: self.case.optimizer.init(k, x, self.case.particles))
        return jax.jit(init)(self.keys, drawn[jnp.arange(len(rows)), rows])

    def _mark(self) -> int:
        """Chooses from particles by fresh trials, and judges the chosen one by others."""
        mark = self.done
        chosen = self._finalists()
        best = jnp.zeros(len(chosen), int)
        grasps = 0
        if self.rounds:
            tested = self.costs(self._test(chosen, self.scene))
            best = tested.argmin(1)
            grasps = tested.size * self.rounds
        design = chosen[jnp.arange(len(chosen)), best][:, None]
        self.designs[mark] = np.asarray(design[:, 0])
        self.kept[mark] = self.judge(self.designs[mark], self.judged)
        return grasps + len(chosen) * self.tests

    def retest(self) -> dict[str, int]:
        """The finalists at the end, in the same trials at the accuracies of episodes and test.

        Returns:
          Finalists, those of them that the accuracy of the episodes alone likes
          (`fresh_trials.retest`), and seeds for which the two accuracies choose different designs.
        """
        chosen = self._finalists()
        searched, tested = (self._test(chosen, s) for s in (self.searched, self.scene))
        finalists = lost = 0
        for seed, particles in enumerate(np.asarray(chosen)):
            of_seed = (jax.tree.map(lambda v, s=seed: v[s], o) for o in (tested, searched))
            counts = fresh_trials.retest(particles, *of_seed)
            finalists += counts.finalists
            lost += counts.lost
        best = [np.asarray(self.costs(outcome)).argmin(1) for outcome in (searched, tested)]
        seeds = np.arange(len(chosen))
        others = (np.asarray(chosen)[seeds, best[0]] != np.asarray(chosen)[seeds, best[1]]).any(1)
        return {"finalists": finalists, "lost": lost, "chosen_otherwise": int(others.sum())}

    def _finalists(self) -> jax.Array:
        """Particles that a mark chooses from, shape (seed, finalist, parameter)."""
        assert self.last is not None
        particles = self.state.particles
        if not self.case.optimizer.keeps_best:
            order = jnp.argsort(jnp.asarray(self.last[1]), axis=1)[..., None]
            particles = jnp.take_along_axis(jnp.asarray(self.last[0]), order, 1)
        return jnp.asarray(particles[:, : self.case.finalists])

    def _test(self, chosen: jax.Array, scene: Scene) -> Outcome:
        """Outcomes of the trials by which a mark chooses, shape (seed, finalist, trial)."""
        noise = self.noise(codesign.STREAM_TEST, self.done)
        return self.outcomes(chosen, noise, self.rounds, scene)

    def judge(self, designs: np.ndarray, scene: Scene) -> np.ndarray:
        """Share of the judging trials that each seed's design keeps, in another scene."""
        noise = self.noise(STREAM_JUDGE, 0)
        outcome = self.outcomes(jnp.asarray(designs)[:, None], noise, self.tests, scene)
        kept = ~failed(np.asarray(outcome.status)) & (np.asarray(outcome.cost) < SUCCESS_COST)
        return kept[:, 0].mean(-1)

    def noise(self, stream: int, index: int) -> jax.Array:
        return jax.vmap(lambda key: codesign.stream_key(key, stream, index))(self.keys)

    def costs(self, outcome: Outcome) -> jax.Array:
        return jax.jit(lambda outcomes: particle_cost(self.scene, outcomes))(outcome)

    def outcomes(
        self, populations: jax.Array, keys: jax.Array, count: int, scene: Scene | None = None
    ) -> Outcome:
        """Outcomes of shape (seed, particle, trial) in the trials of these keys, by one program."""
        scene = scene or self.scene
        simulate = self._program(scene)
        draw = lambda key: rollout.sample_trials(scene, key, count)  # noqa: E731
        trials = jax.tree.map(np.asarray, jax.vmap(draw)(keys))
        shape = (*populations.shape[:2], count)
        seed, particle, trial = np.indices(shape).reshape(3, -1)
        designs = np.asarray(populations)

        def run(rows: np.ndarray) -> Outcome:
            drawn = jax.tree.map(lambda v: v[seed[rows], trial[rows]], trials)
            return simulate(designs[seed[rows], particle[rows]], drawn, scene)

        parts = in_chunks(run, len(seed), self.batch)
        outcomes = jax.tree.map(lambda *v: np.concatenate(v), *parts)
        return jax.tree.map(lambda v: v.reshape(*shape, *v.shape[1:]), outcomes)

    def _engine(self, scene: Scene) -> Engine:
        """The engine of a scene, which may have another accuracy."""
        alike = scene.structure == self.scene.structure
        return self.engine if alike else make_engine(self.engine.name, scene)

    def _program(self, scene: Scene) -> SceneProgram:
        """What simulates designs in trials of a scene, one program for each accuracy."""
        if scene.structure not in self.programs:
            simulate = partial(self._simulate, self._engine(scene))
            self.programs[scene.structure] = SceneProgram(scene, jax.jit(simulate))
        return self.programs[scene.structure]

    def _simulate(self, engine: Engine, designs: jax.Array, trials: Trial, scene: Scene) -> Outcome:
        hands = jax.vmap(self.space.params)(designs)
        return rollout.simulate(scene, engine, hands, trials)[0]

    def _leaves(self) -> list[jax.Array]:
        state = self.state._replace(key=jax.vmap(jax.random.key_data)(self.state.key))
        return jax.tree.leaves(state)

    def _restore(self) -> tuple[OptimizerState, Any]:
        """What a file holds of the study; the arrays' order is that of a state."""
        n = self.case.particles
        zeros = jnp.zeros(self.mask.shape)
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
