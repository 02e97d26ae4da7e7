"""What a run has so far: the optimiser's state and its episodes' reports, and both as arrays."""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from codesign_jax import array_files
from codesign_jax.array_files import Array, Described
from codesign_jax.codesign import EpisodeInfo
from codesign_jax.judge import fresh_trials
from codesign_jax.judge.fresh_trials import Retest
from codesign_jax.optimize import OptimizerState
from codesign_jax.runs.errors import RunError
from codesign_jax.runs.settings import Settings
from codesign_jax.types import Outcome, failed


class History(NamedTuple):
    """Reports of all episodes; those not run yet are zero."""

    # Particles as simulated [SI units], shape (episode, particle, parameter)
    population: np.ndarray
    outcomes: Outcome  # arrays of shape (episode, particle, trial)
    cost: np.ndarray  # mean cost of each particle, shape (episode, particle)
    weight: np.ndarray  # normalised weights, shape (episode, particle)
    # Row of the population that each new particle copies, -1 if it is from an earlier episode,
    # shape (episode, particle)
    ancestors: np.ndarray


class Start(NamedTuple):
    """The particle that a run starts from, as `codesign.seed_search` found it."""

    design: np.ndarray  # the particle [SI units], shape (parameter,)
    cost: np.ndarray  # its cost, shape ()
    candidates: np.ndarray  # candidates that were drawn until it was found, int, shape ()


def empty_history(settings: Settings, num_parameters: int) -> History:
    """Returns a history with room for all episodes of a run."""
    e = settings.episodes
    n = settings.particles
    t = settings.trials

    def trials(dtype: type) -> np.ndarray:
        return np.zeros((e, n, t), dtype)

    real = np.float32
    whole = np.int32
    return History(
        population=np.zeros((e, n, num_parameters), real),
        outcomes=Outcome(
            cost=trials(real),
            status=trials(whole),
            lost_time=trials(real),
            bad_step=trials(whole),
            capped=trials(real),
            residual=trials(real),
        ),
        cost=np.zeros((e, n), real),
        weight=np.zeros((e, n), real),
        ancestors=np.zeros((e, n), whole),
    )


def with_room(history: History, episodes: int) -> History:
    """A history with room for this many episodes, at least those it has room for."""
    more = episodes - len(history.cost)
    return jax.tree.map(lambda v: np.pad(v, [(0, more)] + [(0, 0)] * (v.ndim - 1)), history)


def add_report(history: History, episode: int, info: EpisodeInfo) -> None:
    """Writes the report of an episode into the history's arrays."""
    s = info.selection
    new = History(info.population, info.outcomes, s.cost, s.weight, s.ancestors)
    for array, value in zip(jax.tree.leaves(history), jax.tree.leaves(new), strict=True):
        array[episode] = np.asarray(value)


@dataclasses.dataclass
class Record:
    """What a run has so far; the content of a checkpoint."""

    state: OptimizerState  # state of the optimiser
    history: History  # reports of the episodes
    # Outcomes of the final test, shape (particle, trial), or None before it
    test: Outcome | None = None
    # What the run started from; None if its optimiser looks for its start by itself
    start: Start | None = None
    # Outcomes of the final test's trials at the accuracy of the search, shape (particle, trial);
    # None where the test has that accuracy itself
    searched: Outcome | None = None

    @property
    def done(self) -> int:
        return int(self.state.episode)

    @property
    def retest(self) -> Retest | None:
        """How the finalists did at both accuracies, where search and test have two."""
        if self.test is None or self.searched is None:
            return None
        return fresh_trials.retest(np.asarray(self.state.particles), self.test, self.searched)

    def failed_outcomes(self) -> Outcome | None:
        """The final test or the last episode, where every trial of it failed."""
        outcomes = [] if self.test is None else [self.test]
        if self.done:
            outcomes.append(jax.tree.map(lambda v: v[self.done - 1], self.history.outcomes))
        return next((every for every in outcomes if failed(np.asarray(every.status)).all()), None)

    def last_outcomes(self) -> Outcome:
        """Outcomes in the last episode of the particle filter's final particles.

        Every array has shape (particle, trial).
        """
        kept = self.history.ancestors[self.done - 1]
        last = jax.tree.map(lambda v: v[self.done - 1][kept], self.history.outcomes)
        return jax.device_put(last)


def to_arrays(record: Record) -> dict:
    """Returns a record as nested dictionaries of NumPy arrays."""
    s = record.state
    h = record.history
    state = {"particles": s.particles, "episode": s.episode, "key": jax.random.key_data(s.key)}
    if s.memory is not None:
        state["memory"] = s.memory
    # The outcomes' name in checkpoints, of which there are many, is an older one.
    history = h._asdict() | {"trials": h.outcomes._asdict()}
    del history["outcomes"]
    arrays = {"state": state, "history": history}
    if record.test is not None:
        arrays["test"] = record.test._asdict()
    if record.start is not None:
        arrays["start"] = record.start._asdict()
    if record.searched is not None:
        arrays["searched"] = record.searched._asdict()
    return jax.tree.map(np.asarray, arrays)


def _on_device(values: Any) -> jax.Array:
    """An array of JAX's, without one of its operations: each is a program for every shape."""
    return jax.device_put(np.asarray(values))


def from_arrays(arrays: dict) -> Record:
    """Inverse of `to_arrays`; the history is copied, so that `add_report` may write to it."""
    try:
        s = arrays["state"]
        h = jax.tree.map(np.array, arrays["history"])
        key = jax.random.wrap_key_data(_on_device(s["key"]))
        memory = jax.tree.map(_on_device, s.get("memory"))
        state = OptimizerState(_on_device(s["particles"]), _on_device(s["episode"]), key, memory)
        tests = {
            name: Outcome(**jax.tree.map(_on_device, arrays[name])) if name in arrays else None
            for name in _TESTS
        }
        start = Start(**arrays["start"]) if "start" in arrays else None
        history = History(outcomes=Outcome(**h.pop("trials")), **h)
        return Record(state, history, start=start, **tests)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise RunError(
            f"its checkpoints hold other arrays than this version of codesign-jax has ({error}): "
            "use the version that made the run, which provenance.json names"
        ) from error


def _shapes(record: Any, settings: Settings) -> Iterator[tuple[str, Any, tuple]]:
    """Arrays of a record by name, and the shapes that they have in a run of these settings."""
    history = record.history
    state = record.state
    e, n, t = np.shape(history.outcomes.cost)
    p = np.shape(state.particles)[-1]
    yield "particles", state.particles, (settings.particles, p)
    yield "episode", state.episode, ()
    yield "key", state.key, ()
    for name, value in history.outcomes._asdict().items():
        if value is not None or name not in _NOT_EVERYWHERE:
            yield f"trials/{name}", value, (e, n, t)
    yield "population", history.population, (e, n, p)
    for name in ("cost", "weight", "ancestors"):
        yield name, getattr(history, name), (e, n)
    for group in _TESTS:
        if (test := getattr(record, group)) is None:
            continue
        # The last episode's trials may be among them, see `run.Run.finish`.
        tested = n, max(np.shape(test.cost)[-1], settings.test_rounds * settings.trials)
        for name, value in test._asdict().items():
            if value is not None or name not in _NOT_EVERYWHERE:
                yield f"{group}/{name}", value, tested
    if record.start is not None:
        yield "start/design", record.start.design, (p,)
        yield "start/cost", record.start.cost, ()
        yield "start/candidates", record.start.candidates, ()


_TESTS = ("test", "searched")
"""Outcomes of final particles in a record."""
_MOST_MEMORY = 100
"""Most arrays that an optimiser keeps for itself."""
_NOT_EVERYWHERE = {"capped", "residual"}
"""Arrays that not every engine tells."""
_WHOLE = {"episode", "ancestors", "status", "bad_step", "candidates"}
"""Arrays of whole numbers; the others have real ones."""


def outcome_layout(*axes: str) -> dict[str, Array]:
    """Arrays of outcomes, each with these axes."""
    return {
        name: Array("iu" if name in _WHOLE else "f", axes, name in _NOT_EVERYWHERE)
        for name in Outcome._fields
    }


def refuse_other_arrays(described: Described) -> None:
    """Refuses arrays that no run's checkpoint has, before they are read.

    What the optimiser keeps for itself, below `state/memory`, may be anything of numbers.
    """
    layout: dict[str, Array] = {
        "state/particles": Array("f", ("particle", "parameter")),
        "state/episode": Array("iu", ()),
        "state/key": Array("u", ("word",)),
        "history/population": Array("f", ("episode", "particle", "parameter")),
        **dict.fromkeys(("history/cost", "history/weight"), Array("f", ("episode", "particle"))),
        "history/ancestors": Array("iu", ("episode", "particle")),
        "start/design": Array("f", ("parameter",), True),
        "start/cost": Array("f", (), True),
        "start/candidates": Array("iu", (), True),
    }
    trials = outcome_layout("episode", "particle", "trial")
    tests = outcome_layout("particle", "tested")
    layout |= {f"history/trials/{name}": array for name, array in trials.items()}
    for group in _TESTS:
        layout |= {f"{group}/{n}": array._replace(optional=True) for n, array in tests.items()}
    memory = [name for name in described if name.startswith("state/memory")][:_MOST_MEMORY]
    layout |= {n: Array("biuf", tuple(described[n][1])) for n in memory}
    if wrong := array_files.problem(described, layout):
        raise RunError(
            f"its checkpoints hold what no run has ({wrong}): put checkpoints/ back from a copy"
        )


def _problem(record: Record, settings: Settings) -> str:
    """Which array is none of a run of these settings; nothing if each is.

    Digests say that arrays are those that were saved, not who saved them.
    """
    try:
        for name, value, shape in _shapes(record, settings):
            last = name.rpartition("/")[2]
            kinds = "iu" if last in _WHOLE else "f"
            if value.shape != shape or (name != "key" and value.dtype.kind not in kinds):
                return name
    except (AttributeError, IndexError, TypeError, ValueError):
        return "cost"
    ancestors = record.history.ancestors
    rooms = len(record.history.cost)
    if not 0 <= record.done <= rooms:
        return "episode"
    if ancestors.size and not (-1 <= ancestors.min() and ancestors.max() < settings.particles):
        return "ancestors"
    return ""


def refuse_other(record: Record, settings: Settings) -> None:
    """Refuses a record that is not of a run of these settings."""
    sizes = np.shape(record.history.outcomes.cost)[1:]
    if len(sizes) == 2 and np.shape(record.state.episode) == ():
        done = record.done
        if (settings.particles, settings.trials) != sizes or done > settings.episodes:
            raise RunError(
                f"its checkpoints have {done} episodes of {sizes[0]} particles and {sizes[1]} "
                f"trials, and provenance.json {settings.episodes} of {settings.particles} and "
                f"{settings.trials}: put back the one that belongs to them"
            )
    if problem := _problem(record, settings):
        raise RunError(
            f"its checkpoints hold an array {problem!r} that no run of these settings has: put "
            "checkpoints/ back from a copy"
        )
