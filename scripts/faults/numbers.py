"""Numbers that are none: planted in designs and costs, and trials that all fail."""

import functools
from typing import Any

import numpy as np

from scripts.faults import finished
from scripts.faults.bench import Bench
from scripts.faults.campaigns import Campaign
from scripts.faults.store import Result

VALUES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, 3e38, 1e-45)
_DESIGNS, _TRIALS = 8, 3


@functools.cache
def _evaluate() -> tuple[Any, Any, np.ndarray, Any]:
    """A function from designs to outcomes, its space, sound designs and their outcomes."""
    import jax

    from codesign_jax import codesign, scene
    from codesign_jax.programs import Program
    from codesign_jax.scene.parameters import design_space

    world = scene.load("paper_spheres", overrides={"discretization": {"links": 3}})
    space = design_space(world.hand, "2d")
    # The program itself, without its checks of the population.
    program = Program(world, codesign.Task(world, space, _TRIALS)._evaluation)
    random = np.random.default_rng(0)
    low, high = np.asarray(space.low), np.asarray(space.high)
    designs = (low + (high - low) * random.random((_DESIGNS, len(low)))).astype(np.float32)

    def run(designs: np.ndarray) -> Any:
        return jax.tree.map(np.asarray, program(designs, jax.random.key(0)))

    return run, space, designs, run(designs)


def planted(bench: Bench, number: int) -> Result:
    """A value planted in one or two of eight designs: the others do not change by a bit."""
    from codesign_jax.types import failed

    run, space, designs, sound = _evaluate()
    random = np.random.default_rng(number)
    value = VALUES[number % len(VALUES)]
    rows = random.choice(_DESIGNS, 1 + number // len(VALUES) % 2, replace=False)
    columns = range(len(space.names))
    if number // (2 * len(VALUES)) % 2:
        columns = [int(random.integers(len(space.names)))]
    changed = designs.copy()
    for row in rows:
        changed[row, columns] = value
    found = run(changed)
    others = np.setdiff1d(np.arange(_DESIGNS), rows)
    for name in found._fields:
        mine, theirs = getattr(found, name), getattr(sound, name)
        if mine is not None and mine[others].tobytes() != theirs[others].tobytes():
            return Result("changed others", f"{name}, {value} in {list(rows)} {list(columns)}")
    if not np.isfinite(found.cost).all():
        return Result("cost not finite", f"{value} in {list(rows)} {list(columns)}: {found.cost}")
    if not np.isfinite(value) and not failed(found.status[rows]).all():
        return Result("not flagged", f"{value} in {list(rows)} {list(columns)}: {found.status}")
    return Result("others unchanged")


_COSTS = {
    "equal": lambda n: np.ones(n),
    "zero": lambda n: np.zeros(n),
    "all NaN": lambda n: np.full(n, np.nan),
    "one NaN": lambda n: np.where(np.arange(n) == 1, np.nan, 1.0 + np.arange(n)),
    "all inf": lambda n: np.full(n, np.inf),
    "one inf": lambda n: np.where(np.arange(n) == 2, np.inf, 1.0 + np.arange(n)),
    "huge": lambda n: np.full(n, 1e30),
    "one huge": lambda n: np.where(np.arange(n) == 0, 3e38, 1.0),
    "negative": lambda n: -0.1 - np.arange(n),
    "denormal": lambda n: np.full(n, 1e-45),
    "the scene's limits": lambda n: np.where(np.arange(n) % 2, 3.0, 0.0),
}
_OPTIMIZERS = ("particle-filter", "cma-es", "pso", "random")


def resampled(bench: Bench, number: int) -> Result:
    """Three episodes of degenerate costs: particles stay finite and inside their bounds."""
    import jax

    from codesign_jax import codesign

    _, space, _, _ = _evaluate()
    name = _OPTIMIZERS[number % len(_OPTIMIZERS)]
    kind = list(_COSTS)[number // len(_OPTIMIZERS)]
    optimizer = codesign.make_optimizer(name, space)
    low, high = np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
    mask = np.ones(len(low), bool)
    state = optimizer.init(jax.random.key(number), np.asarray(space.default()), _DESIGNS)
    slack = 1e-6 * (high - low)
    for episode in range(3):
        population = optimizer.ask(state, mask)
        cost = _COSTS[kind](_DESIGNS).astype(np.float32)
        state, info = optimizer.tell(state, population, cost, mask)
        for what in (population, state.particles):
            values = np.asarray(what)
            inside = (values >= low - slack).all() and (values <= high + slack).all()
            if not (np.isfinite(values).all() and inside):
                return Result("out of bounds", f"{name}, {kind}, episode {episode}: {values}")
        if name == "particle-filter" and not np.isfinite(np.asarray(info.weight)).all():
            return Result("weights not finite", f"{kind}: {info.weight}")
    return Result("finite and in bounds")


FAILING = ("--set", "discretization.links=3", "limits.speed=1", "arm.start_height=2")
FAILING += ("phases.approach=0.05", "phases.inflate=0.1", "phases.lift=0.15")
"""Values with which every trial fails."""
_EPISODES = 3


def failing(bench: Bench, number: int) -> Result:
    """A run in which every trial fails, started more often than it has episodes."""
    more = [] if number % 2 else ["--test-trials", "0"]
    words = ["optimize", *finished.SIZE, "--scene", "paper_spheres", "--episodes", str(_EPISODES)]
    words += [*more, "--seed", str(number), *FAILING]
    codes = []
    with bench.scratch() as scratch:
        for start in range(_EPISODES + 2):
            said = bench.command(*words, "--out", scratch / "run")
            codes.append(said.code)
            if said.traceback:
                return Result("traceback", f"start {start}: {said.text}")
            if said.code == 0:
                return Result("exit 0", f"start {start} of {codes}: {said.text}")
    return Result("never 0", "", {"starts": len(codes)})


CAMPAIGNS = (
    Campaign("planted", 160, planted, "others unchanged", size=20),
    Campaign(
        "resampling", len(_OPTIMIZERS) * len(_COSTS), resampled, "finite and in bounds", size=11
    ),
    Campaign("failing", 2, failing, "never 0", limit=600, tries="starts"),
)
