"""Worlds in calls of few sizes: what was compiled for one batch simulates any other.

A call of the structured engine that has too few worlds is filled up with some that are not
simulated, see `rollout.simulated`: they cost what it takes to make their model fields.  Other
engines get the worlds that there are.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import devices, preflight, rollout
from codesign_jax.engines import Engine
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.scene import Scene
from codesign_jax.types import Outcome, Params, Status, Trace, Trial

LIMIT = 16_384
"""Most worlds of one device in one call."""
WORLDS = {"cpu": 512}
"""Most worlds of a call of `evaluate` by platform: few enough to see progress, enough to fill the
cores."""
SIZES = {"cpu": (96, 512)}
"""Worlds of a call on one device, by platform: an episode of the default searches has 36 and 75."""
LARGER_SIZES = tuple(2**k for k in range(7, 15))
"""The same of devices that simulate worlds side by side, up to `LIMIT`: a call for each batch."""

QUICK = 128
"""Most worlds of a call on one device whose program is compiled quickly, see
`reuse.quickly_compiled`: by the size of the calls alone, so that a seed keeps its bits.  A search
with so small episodes runs for less than it would compile longer."""


def call_size(worlds: int, count: int = 1) -> int:
    """Worlds of each call of `simulate` for so many, by the number alone; `count`: of devices.

    The smallest size that has room or, on CPUs, that has in two calls; else the largest.
    """
    sizes = SIZES.get(jax.default_backend(), LARGER_SIZES)
    share = -(-worlds // count)
    calls = 2 if jax.default_backend() in SIZES else 1
    return count * next((size for size in sizes if share <= calls * size), sizes[-1])


class Batch:
    """Simulates batches of worlds with one engine and options, in calls of few sizes."""

    def __init__(self, scene: Scene, engine: Engine, options: rollout.Options, count: int = 1):
        """Compiles nothing yet; `count`: devices that share a call."""
        self.scene = scene
        self.options = options
        self.count = count
        self.fills = getattr(engine, "fills", False)
        shared_options = options._replace(cost=None)
        shows = options.cost is not None or options.record_qpos
        programs = _worlds(engine, shared_options, count, shows)
        self._programs = _Sizes(*(SceneProgram(scene, program) for program in programs))
        self._by_user_cost = jax.jit(self._user_cost)

    def simulate(
        self,
        hands: Params,
        trials: Trial,
        scene: Scene | None = None,
        *,
        size: int | None = None,
        advance: Callable[[int], Any] = lambda worlds: None,
    ) -> tuple[Outcome, Trace]:
        """Outcomes and traces of worlds, arrays of NumPy with leading axis (world,).

        Without qpos nothing is known of a trace but its last state.

        Args:
          hands: Their hands, leading axis (world,).
          trials: Their trials, likewise.
          scene: A scene with other numbers, of shape ().
          size: Worlds of a call; None for `size`.
          advance: Is told the worlds of each call that has ended.
        """
        worlds = len(trials.yaw)
        size = size or self.size(worlds)
        inputs = jax.tree.map(np.asarray, (hands, trials))
        parts = []
        for first in range(0, worlds, size):
            rows = np.minimum(np.arange(first, first + size), worlds - 1)
            number = min(size, worlds - first)
            chosen = jax.tree.map(lambda v, rows=rows: v[rows], inputs)
            results = self._call(chosen, np.arange(size) < number, scene)
            parts.append(jax.tree.map(lambda v, n=number: np.asarray(v)[:n], results))
            advance(number)
        return jax.tree.map(lambda *v: np.concatenate(v), *parts)

    def size(self, worlds: int) -> int:
        """Worlds of each call for so many."""
        return call_size(worlds, self.count) if self.fills else min(worlds, self.count * LIMIT)

    def compile(self, hands: Params, trials: Trial, *, size: int | None = None) -> tuple:
        """Compiles ahead for worlds like these; what it returns of them means nothing.

        By a call that simulates none, of an engine that `fills`.
        """
        assert self.fills
        worlds = len(trials.yaw)
        rows = np.zeros(size or self.size(worlds), int)
        chosen = jax.tree.map(lambda v: np.asarray(v)[rows], (hands, trials))
        outcomes, trace = self._call(chosen, rows > 0, None)
        nothing = np.zeros(worlds, int)
        return jax.tree.map(lambda v: np.asarray(v)[nothing], (outcomes, trace.last))

    def start(self, hands: Params, *, size: int | None = None) -> bool:
        """Whether hands, leading axis (hand,), may start with each object as it lies without noise.

        By grasps of an engine that `fills`; False where it is not known.
        """
        scene = self.scene
        if not self.fills or scene.drawn.constant:
            return False
        shapes = range(len(scene.objects.object))
        each = [jax.tree.map(np.asarray, preflight.nominal_trial(scene, k)) for k in shapes]
        count = len(np.asarray(hands.length))
        worlds = jax.tree.map(lambda v: np.repeat(np.asarray(v), len(each), 0), hands)
        trials = jax.tree.map(lambda *v: np.stack(v * count), *each)
        outcomes, _ = self.simulate(worlds, trials, size=size)
        return not (outcomes.status & Status.INVALID_START).any()

    def _call(self, inputs: tuple, counts: np.ndarray, scene: Scene | None) -> tuple:
        small = len(counts) <= QUICK * self.count
        program = self._programs.small if small else self._programs.large
        outcomes, trace, ctrl = program(inputs, counts if self.fills else None, scene)
        if self.options.cost is not None:
            outcomes = self._by_user_cost((scene or self.scene).bare, trace, ctrl, outcomes)
        return outcomes, trace if self.options.record_qpos else _last_alone(trace.last)

    def _user_cost(self, scene: Scene, trace: Any, ctrl: Any, outcomes: Outcome) -> Outcome:
        return rollout.by_user_cost(scene, self.options, trace, ctrl, outcomes)


class _Sizes(NamedTuple):
    """The program for calls of few worlds, which come one at a time, and for those of many."""

    small: Any
    large: Any


def _last_alone(last: Any) -> Trace:
    """A trace of which nothing but the last states is known."""
    return Trace(None, None, None, None, last=last)  # type: ignore[arg-type]


@shared
def _worlds(engine: Engine, options: rollout.Options, count: int, shows: bool) -> _Sizes:
    """The programs of all batches; `shows`: they return whole traces, and the controls."""

    def simulate(inputs: tuple, counts: jax.Array | None, scene: Scene) -> tuple:
        def run(scene: Scene, hands: Params, trials: Trial, counts: Any) -> tuple:
            outcomes, trace, ctrl = rollout.simulated(scene, engine, hands, trials, options, counts)
            return (outcomes, trace, ctrl) if shows else (outcomes, _last_alone(trace.last), None)

        return devices.shared_out(run, count)(scene, *inputs, counts)

    return _Sizes(simulate, jax.jit(simulate))


def size(designs: int, trials: int, *, most: int | None = None, devices: int = 1) -> int:
    """Designs of each of equal calls of so many devices: a short last one would be filled up."""
    worlds = devices * (most or WORLDS.get(jax.default_backend(), LIMIT))
    at_most = min(max(1, worlds // trials), designs)
    return -(-designs // -(-designs // at_most))


def evaluate(
    task: Any,
    key: jax.Array,
    designs: np.ndarray,
    size: int,
    advance: Callable[[int], Any] = lambda worlds: None,
) -> Outcome:
    """Outcomes of designs [SI units] in a `Task`'s trials, arrays of shape (design, trial).

    So many designs at a time, and `advance` is told the worlds of each call.
    """

    def run(rows: np.ndarray) -> Outcome:
        return task.evaluate(jnp.asarray(designs[rows], jnp.float32), key)

    parts = []
    for outcome in in_chunks(run, len(designs), size):
        parts.append(outcome)
        advance(outcome.cost.size)
    return jax.tree.map(lambda *v: np.concatenate(v), *parts)


def in_chunks(run: Callable[[np.ndarray], Any], count: int, size: int) -> Iterator[Any]:
    """What run(rows) returns of rows 0 to count, as NumPy arrays, in their order.

    Each call has `size` rows, so that there is one program: the last is filled up with its last
    row, and cut.
    """
    for start in range(0, count, size):
        rows = np.minimum(np.arange(start, start + size), count - 1)
        length = min(size, count - start)
        yield jax.tree.map(lambda v, n=length: np.asarray(v)[:n], run(rows))
