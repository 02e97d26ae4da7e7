"""Episodes of many runs at once, on every device of the host.

The results are bitwise those of running each seed alone: what is computed for a run by itself
(moves, noise, model fields, verdicts, resampling) is a program of one run's size, called once for
each, and only the engine's blocks, which do not depend on each other (`engines.base.Staged`), are
joined over the runs and dealt to the devices.  One larger program for everything would be no
faster, and XLA would round it differently in the last bit, after which contact goes its own way.
"""

import itertools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout
from codesign_jax.codesign import EpisodeInfo, Task, asked, episode_trials, told
from codesign_jax.engines import Engine
from codesign_jax.engines.base import block_lanes, staged
from codesign_jax.optimize import Optimizer, OptimizerState
from codesign_jax.reuse import SceneProgram, shared
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Outcome, Trial

Device = Any
"""A `jax.Device`, which type checkers do not know."""

LIMIT = 16_384
"""Most worlds of one device in one call; more runs are simulated group by group."""


class Request(NamedTuple):
    """An episode that a run wants."""

    state: OptimizerState  # the optimiser's state before it
    mask: Any  # parameters that may move, bool, shape (parameter,)


class _Packed(NamedTuple):
    """A run's episode, ready to be simulated."""

    population: jax.Array  # particles [SI units], shape (particle, parameter)
    trials: Trial  # trials of the worlds, with leading axis (world,)
    initial: jax.Array  # bits of `Status` that the worlds start with, shape (world,)
    blocks: tuple  # see `engines.base.Staged`
    common: tuple  # see `engines.base.Staged`
    ctrl: jax.Array | None = None  # controls of the worlds, where a cost of one's own reads them


class _Launched(NamedTuple):
    """What the devices have been told to simulate."""

    packed: list[_Packed]  # the runs' episodes without their blocks
    drawn: list[Trial]
    running: list[tuple]  # what the devices make of the blocks


class Batch:
    """Runs episodes as `codesign.Task.episode` does, of many runs in one call.

    The runs have scene, sizes and design space in common; their states, seeds and schedules differ.
    """

    def __init__(
        self, task: Task, optimizer: Optimizer, *, devices: int | None = None, limit: int = LIMIT
    ):
        """Compiles nothing yet."""
        self._task = task
        self._optimizer = optimizer
        self._parts = None
        self._joins = staged(task.engine).joins
        self._limit = limit
        self.devices = take(devices)
        self._programs: dict[Any, Callable] = {}

    def compile(self, request: Request, runs: int) -> None:
        """Compiles the programs that so many such episodes take."""
        parts = self._stages(request, runs)
        self._program("draw", parts.draw.compile, *request)
        self._program("before", parts.before.compile, *request)
        packed = jax.eval_shape(parts.before, *request)
        total = min(runs, self._group(request))
        count = len(self.devices)
        shares = _shares(total * _length(packed.blocks), count) if self._joins else [0] * total
        for device, share in zip(self.devices, shares, strict=False):
            blocks = _resized(packed.blocks, share) if self._joins else packed.blocks
            self._launcher(blocks, packed.common, device)
        out = jax.eval_shape(parts.launch, packed.blocks, packed.common)
        self._program(
            "after", parts.after.compile, (request.state, _light(packed)), (request.mask, out)
        )

    def __call__(self, requests: Sequence[Request]) -> list[tuple[OptimizerState, EpisodeInfo]]:
        """Runs an episode for each request; states and reports in their order."""
        return self.begin(requests)()

    def begin(
        self, requests: Sequence[Request]
    ) -> Callable[[], list[tuple[OptimizerState, EpisodeInfo]]]:
        """Lets the devices begin an episode for each request; returns what goes on and answers.

        That takes about as long as the simulation, although it only tells the devices what to do:
        JAX lets a program wait its turn while 32 are under way on a GPU
        (`max_inflight_computations` of XLA's GPU client).
        """
        places = self._groups(requests)
        groups = [[requests[i] for i in group] for group in places]
        first = [self._launched(group) for group in groups[:1]]

        def finish() -> list[tuple[OptimizerState, EpisodeInfo]]:
            found = []
            for group in groups:
                # A group begins when the one before it has been judged and its arrays have left
                # the memory, so no name here may hold on to them.
                found += self._judged(group, first.pop() if first else self._launched(group))
            by_place = dict(zip(itertools.chain(*places), found, strict=True))
            return [by_place[i] for i in range(len(requests))]

        return finish

    def _groups(self, requests: Sequence[Request]) -> list[list[int]]:
        by_size: dict[int, list[int]] = {}
        for i, request in enumerate(requests):
            by_size.setdefault(len(request.state.particles), []).append(i)
        groups = []
        for alike in by_size.values():
            size = self._group(requests[alike[0]])
            groups += [alike[k : k + size] for k in range(0, len(alike), size)]
        return groups

    def _group(self, request: Request) -> int:
        return max(1, self._limit * len(self.devices) // self._worlds(request))

    def _worlds(self, request: Request) -> int:
        return len(request.state.particles) * self._task.trials

    def _stages(self, request: Request, runs: int) -> "_Stages":
        """The programs, whose blocks fit the first call's worlds.

        Later calls keep them: runs that end would otherwise make the others' blocks narrower, and
        all programs would be compiled again in the middle.
        """
        if self._parts is None:
            task = self._task
            joined = min(runs, self._group(request))
            worlds = -(-joined * self._worlds(request) // len(self.devices))
            engine, space, trials, options = task.how
            made = _stages(engine, space, block_lanes(engine, worlds), trials, options)
            ours = {n: SceneProgram(task.scene, getattr(made, n), self._optimizer) for n in _OURS}
            self._parts = made._replace(**ours)
        return self._parts

    def _launched(self, requests: Sequence[Request]) -> _Launched:
        parts = self._stages(requests[0], len(requests))
        draw = self._program("draw", parts.draw.compile, *requests[0])
        before = self._program("before", parts.before.compile, *requests[0])
        # Trials are drawn by a program of their own. `before` draws them as well, but with one more
        # result XLA might round its others differently; a program that is started later would wait
        # until the devices have simulated.
        drawn, packed = ([program(*request) for request in requests] for program in (draw, before))
        running = self._joined(packed) if self._joins else self._one_by_one(packed)
        return _Launched([_light(p) for p in packed], drawn, running)

    def _judged(
        self, requests: Sequence[Request], launched: _Launched
    ) -> list[tuple[OptimizerState, EpisodeInfo]]:
        assert self._parts is not None
        packed, drawn, running = launched
        home = tuple(jax.device_put(out, self.devices[0]) for out in running)
        found = _collect(home, len(requests)) if self._joins else home
        results = []
        for (state, mask), mine, trials, out in zip(requests, packed, drawn, found, strict=True):
            told = (state, mine), (mask, out)
            new, info = self._program("after", self._parts.after.compile, *told)(*told)
            results.append((new, info._replace(drawn=trials)))
        return results

    def _joined(self, packed: Sequence[_Packed]) -> list[tuple]:
        parts = _deal(tuple(p.blocks for p in packed), len(self.devices))
        return [
            self.call(blocks, packed[0].common, device)
            for blocks, device in zip(parts, self.devices, strict=False)
        ]

    def _one_by_one(self, packed: Sequence[_Packed]) -> list[tuple]:
        turns = zip(packed, itertools.cycle(self.devices), strict=False)
        return [self.call(p.blocks, p.common, device) for p, device in turns]

    def call(self, blocks: tuple, common: tuple, device: Device) -> tuple:
        """Begins to simulate on a device; returns at once."""
        blocks, common = jax.device_put((blocks, common), device)
        return self._launcher(blocks, common, device)(blocks, common)

    def _launcher(self, blocks: tuple, common: tuple, device: Device) -> Callable:
        place = jax.sharding.SingleDeviceSharding(device)
        parts = self._parts
        assert parts is not None

        def lower(blocks: tuple, common: tuple) -> Callable:
            like = jax.tree.map(
                lambda v: jax.ShapeDtypeStruct(v.shape, v.dtype, sharding=place), (blocks, common)
            )
            return parts.launch.lower(*like).compile()

        return self._program(device, lower, blocks, common)

    def _program(self, name: Any, compile: Callable, first: Any, second: Any) -> Callable:
        shapes = tuple(jnp.shape(v) for v in jax.tree.leaves((first, second)))
        if (name, shapes) not in self._programs:
            self._programs[name, shapes] = compile(first, second)
        return self._programs[name, shapes]


class _Stages(NamedTuple):
    """The programs of an episode, see `engines.base.Staged`."""

    draw: Any
    before: Any
    launch: Any
    after: Any


_OURS = "draw", "before", "after"
"""Programs that get an optimiser and the scene's numbers."""


@shared
def _stages(
    engine: Engine,
    space: DesignSpace,
    lanes: int | None,
    num_trials: int,
    options: rollout.Options,
) -> _Stages:
    """Draws an episode's trials; moves particles and prepares worlds; simulates them; judges."""
    stages = staged(engine, lanes, trajectory=options.to_end)

    def draw(state: OptimizerState, mask: Any, scene: Scene, optimizer: Optimizer) -> Trial:
        return episode_trials(scene, state.key, state.episode, num_trials)

    def before(state: OptimizerState, mask: Any, scene: Scene, optimizer: Optimizer) -> _Packed:
        population, worlds = asked(space, num_trials, state, mask, scene, optimizer)
        fields, ctrl, initial = rollout.prepare(*worlds, engine)
        trials = worlds[2]
        blocks = stages.pack(fields, ctrl)
        return _Packed(population, trials, initial, *blocks, None if options.cost is None else ctrl)

    def after(
        begun: tuple[OptimizerState, _Packed],
        found: tuple[Any, tuple],
        scene: Scene,
        optimizer: Optimizer,
    ) -> tuple[OptimizerState, EpisodeInfo]:
        state, packed = begun
        mask, out = found
        trace = stages.unpack(out, len(packed.population) * num_trials)
        judged = trace, packed.ctrl, packed.initial, packed.trials
        outcome = rollout.judge(scene, *judged, options)
        own = state, mask, scene, optimizer
        return told(num_trials, *own, packed.population, (outcome, trace.last))

    return _Stages(draw, before, stages.launch, after)


WORLDS = {"cpu": 512}
"""Most worlds of a call of `evaluate` by platform: few enough to see progress, enough to fill the
cores."""


def size(designs: int, trials: int, *, most: int | None = None, devices: int = 1) -> int:
    """Designs of each of equal calls for so many devices: a short last one would be filled up."""
    worlds = most or WORLDS.get(jax.default_backend(), LIMIT)
    at_most = min(max(1, worlds // trials), -(-designs // devices))
    return -(-designs // -(-designs // at_most))


def evaluate(
    task: Task,
    key: jax.Array,
    designs: np.ndarray,
    size: int,
    advance: Callable[[int], Any] = lambda worlds: None,
    *,
    devices: int | None = 1,
) -> Outcome:
    """Outcomes of designs [SI units] in a task's trials, arrays of shape (design, trial).

    So many designs at a time, and `advance` is told the worlds of each call.
    """

    def run(rows: np.ndarray, device: Device) -> Outcome:
        part = jnp.asarray(designs[rows], jnp.float32)
        return task.evaluate(*jax.device_put((part, key), device))

    found = []
    for outcome in in_chunks(run, len(designs), size, take(devices)):
        found.append(outcome)
        advance(outcome.cost.size)
    return jax.tree.map(lambda *v: np.concatenate(v), *found)


def in_chunks(
    run: Callable[[np.ndarray, Device], Any],
    count: int,
    size: int,
    devices: Sequence[Device] = (None,),
) -> Iterator[Any]:
    """What run(rows, device) returns of rows 0 to count, as NumPy arrays, in their order.

    Each call has `size` rows, so that there is one program: the last is filled up with its last
    row, and cut. The devices take turns.
    """
    running: deque[tuple[int, Any]] = deque()

    def arrived() -> Any:
        rows, found = running.popleft()
        return jax.tree.map(lambda v: np.asarray(v)[:rows], found)

    for start, device in zip(range(0, count, size), itertools.cycle(devices), strict=False):
        if len(running) == len(devices):
            yield arrived()
        rows = np.minimum(np.arange(start, start + size), count - 1)
        running.append((min(size, count - start), run(rows, device)))
    while running:
        yield arrived()


def take(count: int | None) -> list[Device]:
    """The first devices of this process, by default all."""
    available = jax.local_devices()
    if count is not None and not 1 <= count <= len(available):
        raise ValueError(f"{count} devices asked for, {len(available)} available")
    return available[:count]


def _light(packed: _Packed) -> _Packed:
    return packed._replace(blocks=(), common=())  # without what only the simulation reads


def _length(blocks: tuple) -> int:
    return jax.tree.leaves(blocks)[0].shape[0]


def _shares(total: int, parts: int) -> list[int]:
    # As many blocks as `_deal` gives to each device that gets any.
    return [len(range(part, total, parts)) for part in range(min(parts, total))]


def _resized(blocks: tuple, count: int) -> tuple:
    return jax.tree.map(lambda v: jax.ShapeDtypeStruct((count, *v.shape[1:]), v.dtype), blocks)


def _deal(runs: tuple[tuple, ...], parts: int) -> Sequence[tuple]:
    """Blocks of all runs, dealt like cards.

    Runs whose hands touch and hold more take longer: so dealt, each device has some of every run.
    """
    return runs if len(runs) == parts == 1 else _split(runs, parts)


def _collect(parts: tuple[tuple, ...], runs: int) -> Sequence[tuple]:
    return parts if len(parts) == runs == 1 else _gather(parts, runs)


def _split_now(runs: tuple[tuple, ...], parts: int) -> list[tuple]:
    whole = jax.tree.map(lambda *v: jnp.concatenate(v), *runs)
    shares = len(_shares(_length(whole), parts))
    return [jax.tree.map(lambda v, p=part: v[p::parts], whole) for part in range(shares)]


def _gather_now(parts: tuple[tuple, ...], runs: int) -> list[tuple]:
    def in_place(*dealt: jax.Array) -> jax.Array:
        total = sum(len(v) for v in dealt)
        first = dealt[0]
        whole = jnp.zeros((total, *first.shape[1:]), first.dtype)
        for part, values in enumerate(dealt):
            whole = whole.at[part :: len(dealt)].set(values)
        return whole.reshape(runs, -1, *first.shape[1:])

    whole = jax.tree.map(in_place, *parts)
    return [jax.tree.map(lambda v, r=run: v[r], whole) for run in range(runs)]


_split = jax.jit(_split_now, static_argnums=1)
"""Blocks of all runs one behind the other, every n-th of them in a part."""
_gather = jax.jit(_gather_now, static_argnums=1)
"""Inverse of `_split`, cut into runs of one length."""
