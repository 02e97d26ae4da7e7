"""Derivatives of a rollout's kernel against central differences of the kernel itself, in float64.

They are taken of the kernel's own tables: one call of the forward kernel has a world for each side
of each group of numbers, moved along a random direction, and one call of the reverse kernel has the
derivatives by all of them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured import StructuredEngine, coordinates
from codesign_jax.engines.structured.kernel.adjoint import AdjointProgram, Cotangents, state_path
from codesign_jax.engines.structured.kernel.rollout import Inputs
from tests.helpers import grasps
from tests.helpers.curled_hands import state

EXACT = {"iterations": 100, "evaluations": 40, "tolerance": 1e-26}
"""Solved to rounding: differences divide the solver's error by twice the step."""
FIXED = (
    "step",
    "going",
    "object_id",
    "lost_distance",
    "start",
    "end",
    "speed",
    "penetration",
    "centre_weight",
)
FIXED += ("support", "grid_first", "grid_nodes", "grid_reach")
"""Rows of the tables that no derivative is asked for: indices, bounds, and what only saves time."""
FINGERS = "finger_finger"
TABLES = ("hand", "world", "finger_state", "world_state", "arm", "pressure")


class Start(NamedTuple):
    """One world: its fields, its velocities at the start and its controls, (time, nu)."""

    fields: Any
    qvel: np.ndarray
    ctrl: np.ndarray


class Weights(NamedTuple):
    """Cotangents of what a rollout returns: of a world's last state, entries and positions."""

    last: np.ndarray
    entries: np.ndarray
    qpos: np.ndarray

    def times(self, factor):
        return Weights(*(factor * x for x in self))


def curled(scene, steps, *, bend=0.9, height=0.07, seed=1):
    """A hand with bent fingers around the object, all of it moving."""
    fields, qpos, qvel, ctrl = state(scene, seed, bend, height)
    qpos[-7:-4] += [0.001, 0.002, -0.002]
    qvel[-4] = -6.0  # the object is thrown at the table
    return Start(fields._replace(start=jnp.asarray(qpos)), qvel, np.repeat(ctrl[None], steps, 0))


def weights_of(start, seed=0):
    """Random ones."""
    random = np.random.default_rng(seed)
    nq = len(start.fields.start)
    steps = len(start.ctrl)
    shapes = (2 * nq - 1,), (steps, 3), (steps, nq)
    weights = Weights(*(random.normal(size=shape) for shape in shapes))
    weights.entries[0, 2] = 0.0  # the first speed is a number of the state, as it is given
    return weights


class Case:
    """A scene's kernels and the tables of one world."""

    def __init__(self, scene, start, width=8, backend="cpu"):
        """Packs the world into tables; width: lanes of a block."""
        engine = StructuredEngine(scene, **EXACT)
        self.program = AdjointProgram(scene, engine.limits, backend=backend, width=width)
        self._reverse = jax.jit(self._cotangents)
        self.start, (hand, state) = start, self._lanes(scene, engine, start)
        ctrl = jnp.asarray(start.ctrl)[None]
        inputs = jax.jit(self.program.inputs)(hand, state, ctrl)
        self.tables = [np.array(x) for x in jax.tree.leaves(inputs)]
        random = np.random.default_rng(1)
        for name in self.program.held:  # contacts hold friction from the start
            hold = np.zeros(self.world(self.tables[2]).shape)
            rows = self.rows(2, f"held.{name}")
            hold[rows] = 0.3 * random.normal(size=hold[rows].shape)
            self._move(self.tables[2], 0, self._opposite(hold) if name == FINGERS else hold)
        layouts = [getattr(self.program, name) for name in TABLES[:4]]
        self.groups = [
            (k, name)
            for k, layout in enumerate(layouts)
            for name in layout.groups
            if name not in FIXED and not name.startswith("acc")
        ] + [(4, "arm"), (5, "pressure")]

    @staticmethod
    def _lanes(scene, engine, start):
        @jax.jit
        def placed(fields, qvel):
            state = engine.reset(fields)
            return engine.state_at(state, engine.qpos(state), qvel)

        fields = grasps.repeat(start.fields, 1)
        return grasps.lanes(scene, fields), placed(fields, start.qvel[None])

    def world(self, table, k=0):
        """A world's numbers of a table, (block, ..., lane or world) to (..., finger or 1)."""
        split = table.reshape(*table.shape[:-1], -1, self.program.block)
        return split[(k // self.program.block, ..., k % self.program.block)]

    def many(self, worlds):
        """Tables of so many copies of the world, and a function that sets one world's numbers."""
        blocks = -(-worlds // self.program.block)
        tables = []
        for x in self.tables[:6]:
            column = self.world(x)[..., None]
            block = np.repeat(column, self.program.block, -1).reshape(x.shape[1:])
            tables.append(np.repeat(block[None], blocks, 0))
        return tables + [x.copy() for x in self.tables[6:]]

    def _move(self, table, world, change):
        """Adds to a world's numbers of a table."""
        block, place = divmod(world, self.program.block)
        split = table.reshape(*table.shape[:-1], -1, self.program.block)
        split[(block, ..., place)] += change

    def rows(self, k, name):
        """Rows of a group in its table."""
        if k > 3:
            return Ellipsis
        layout = getattr(self.program, TABLES[k])
        count = layout.groups[name][0] * layout.stride[name]
        first = layout.offset[name]
        return slice(first, first + count)

    def _opposite(self, values):
        """Rows of what fingers hold on one another, of values (row, finger): equal and opposite."""
        opposite = np.zeros_like(values)
        fingers = np.arange(values.shape[1])
        rows = self.rows(2, f"held.{FINGERS}")
        for item, row in enumerate(np.arange(values.shape[0])[rows][::3]):
            other = fingers ^ item
            mine = values[row : row + 3] * ((fingers < other) | (item == 0))
            opposite[row : row + 3] = mine - mine[:, other] * (item > 0)
        return opposite

    def directions(self):
        """A random direction for each group, as large as its numbers."""
        random = np.random.default_rng(0)
        directions = []
        for k, name in self.groups:
            numbers = self.world(self.tables[k])
            rows = self.rows(k, name)
            along = np.zeros_like(numbers)
            noise = random.normal(size=numbers.shape)
            size = {2: 0.1, 3: 0.1, 4: 0.01, 5: np.abs(numbers).max()}.get(k)
            along[rows] = noise[rows] * (np.abs(numbers[rows]) if size is None else size)
            if name == f"held.{FINGERS}":
                along = self._opposite(along)
            if name == "quat":  # it stays one
                along[rows] -= numbers[rows] * (numbers[rows] * along[rows]).sum()
            directions.append(along)
        return directions

    def differences(self, weights, step):
        """Central differences of the weighted results along the groups' directions; the trace."""
        tables = self.many(2 * len(self.groups) + 1)
        count = 2 * len(self.groups) + 1
        for g, ((k, name), along) in enumerate(zip(self.groups, self.directions(), strict=True)):
            for side, sign in ((2 * g, 1), (2 * g + 1, -1)):
                self._move(tables[k], side, sign * step * along)
                if name == "grid_factor":  # a mesh's support points are as large as its grid
                    rows = self.rows(1, name)
                    support = self.rows(0, "support")
                    growth = along[rows] / self.world(self.tables[1])[rows]
                    more = np.zeros_like(self.world(tables[0]))
                    more[support] = sign * step * growth * self.world(self.tables[0])[support]
                    self._move(tables[0], side, more)

        @jax.jit
        def results(out):
            outputs, last = self.program.outputs(out, count, states=True)
            return outputs, coordinates.flat(last)

        outputs, last = jax.tree.map(np.asarray, results(self.execute(tables)))
        entries = np.stack([outputs[n] for n in ("distance", "height", "speed")], 2)
        value = last @ weights.last
        value = value + np.einsum("wte,te->w", entries, weights.entries)
        value = value + np.einsum("wtq,tq->w", outputs["qpos"], weights.qpos)
        sides = value[:-1].reshape(-1, 2)
        return (sides[:, 0] - sides[:, 1]) / (2 * step), outputs

    def execute(self, tables):
        """What the forward kernel makes of tables, all states recorded."""
        run = jax.jit(lambda x: self.program.execute(x, states=1))
        return run(Inputs(*map(jnp.asarray, tables)))

    def bars(self, tables, out, weights):
        """Cotangents of tables for weights of each world, by what `execute` made of them."""
        count = tables[0].shape[0] * self.program.block
        missing = [weights[0].times(0.0)] * (count - len(weights))
        last, entries, qpos = (np.stack(x) for x in zip(*weights, *missing, strict=True))
        tables = Inputs(*map(jnp.asarray, tables))
        bars = self._reverse(tables, out, last, entries, qpos)
        return [np.asarray(x) for x in jax.tree.leaves(bars)]

    def _cotangents(self, tables, out, last, entries, qpos):
        program = self.program
        trace, _ = program.outputs(out, len(last))
        taken = program.by_block(trace["moved"].sum(1)[:, None, None, None])
        rows = Cotangents(*program.rows_of_end(last), entries[..., None], program.rows_of(qpos))
        rows = jax.tree.map(program.by_block, rows)
        bars = program.adjoint(tables, state_path(out, taken), rows)
        return bars._replace(world=program.summed(bars.world))

    def along(self, bars, world=0):
        """Derivatives of a world along the groups' directions."""
        directions = zip(self.groups, self.directions(), strict=True)
        return np.array([(self.world(bars[k], world) * d).sum() for (k, _), d in directions])
