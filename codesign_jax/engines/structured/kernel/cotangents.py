"""Reverse-mode derivatives of functions of lanes, and tables to which their cotangents are added.

JAX differentiates the program of components that `lanewise` makes of a function: values over the
lanes and elementwise operations only, so that the derivative is such a program too.  A number that
belongs to a world gets one cotangent on each of its fingers' lanes, to be summed by the caller.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.components import FINGER, is_number, splat
from codesign_jax.engines.structured.kernel.memory import Block, BoundTable, MemoryLayout, zeros
from codesign_jax.engines.structured.kernel.rows import StepBar
from codesign_jax.engines.structured.kernel.step_memory import KernelLayout, References
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise


def pull(function: Callable, args: tuple, fixed: tuple, bars: Any) -> Any:
    """Cotangents of args: the transposed derivative of function(*args, *fixed) times bars.

    Args:
      function: Function of arrays whose two last axes are those of lanes.
      args: Trees of lanes by which to differentiate.
      fixed: Trees of lanes: its further arguments.
      bars: Cotangents of the function's results.

    Returns:
      A tree as `args`, all of it lanes of a finger each.
    """
    leaves, tree = jax.tree.flatten(args, is_leaf=_is_lanes)
    spots = [
        (n, at)
        for n, leaf in enumerate(leaves)
        for at, part in np.ndenumerate(leaf.parts)
        if not is_number(part) and jnp.issubdtype(part.dtype, jnp.floating)
    ]
    results: list[Lanes] = []

    def run(values: list[jax.Array]) -> list[jax.Array]:
        filled = [Lanes(leaf.parts.copy(), leaf.shape, leaf.dtype) for leaf in leaves]
        for (n, at), value in zip(spots, values, strict=True):
            filled[n].parts[at] = value
        out = lanewise(function, *jax.tree.unflatten(tree, filled), *fixed)
        results[:] = jax.tree.leaves(out, is_leaf=_is_lanes)
        return [part for leaf in results for part in leaf.parts.ravel() if not is_number(part)]

    primals, back = jax.vjp(run, [leaves[n].parts[at] for n, at in spots])
    seeds = [
        bar
        for leaf, given in zip(results, jax.tree.leaves(bars, is_leaf=_is_lanes), strict=True)
        for part, bar in zip(leaf.parts.ravel(), given.parts.ravel(), strict=True)
        if not is_number(part)
    ]
    seeds = [splat(s, p.shape, p.dtype) for s, p in zip(seeds, primals, strict=True)]
    (arg_bars,) = back(seeds)
    shells = [_nothing(leaf) for leaf in leaves]
    for (n, at), bar in zip(spots, arg_bars, strict=True):
        shells[n].parts[at] = bar
    return jax.tree.unflatten(tree, shells)


def plus(first: Any, second: Any) -> Any:
    """Sums of two trees of lanes, leaf by leaf."""
    return lanewise(_sum, first, second)


def only_on(mask: Lanes, tree: Any) -> Any:
    """A tree of lanes, zero on the lanes where the mask is false."""
    return lanewise(_where, mask, tree)


def _sum(first: Any, second: Any) -> Any:
    return jax.tree.map(jnp.add, first, second)


def _where(mask: jax.Array, tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.where(mask, x, jnp.zeros_like(x)), tree)


def _is_lanes(x: Any) -> bool:
    return isinstance(x, Lanes)


def _nothing(leaf: Lanes) -> Lanes:
    parts = np.empty(leaf.parts.shape, object)
    parts.fill(np.zeros((), leaf.dtype)[()])
    return Lanes(parts, (*leaf.shape[:-2], FINGER, leaf.shape[-1]), leaf.dtype)


class CotangentTables:
    """Cotangents by the name of what they belong to.

    Attributes:
      hand: Of the hand's constants, laid out as those.
      world: Of the worlds' constants, with a value for each finger, to be summed.
      finger_state: Of the fingers' state after the step, then before it.
      world_state: Likewise of wrist and object.
      names: What several parts of a step add to beside these, in scratch memory: `rows.StepBar`.
    """

    def __init__(self, layout: KernelLayout, block: Block, bars: References):
        """Binds the rows; bars: references to the cotangents, those of worlds on each lane."""
        self.block = block
        self.scratch = BoundTable(layout.scratch, bars.scratch)
        self.hand = BoundTable(layout.hand, bars.hand)
        self.world = BoundTable(MemoryLayout(True, **layout.world.groups), bars.world)
        self.finger_state = BoundTable(layout.finger_state, bars.finger_state)
        self.world_state = BoundTable(layout.world_state, bars.world_state, block.world)
        self.like = jnp.zeros((layout.size,), bars.scratch.dtype)
        self.names = [n for n, row in StepBar.by_attribute().items() if row in self.scratch]

    def begin(self) -> None:
        """Sets to zero what the parts of a step add to, the rows of `rows.StepBar`."""
        for name in self.names:
            row = StepBar.by_attribute()[name]
            for item in range(self.scratch.layout.groups[row][0]):
                self.scratch.write(row, zeros(self.scratch.shape(row), self.like), item)

    def of_step(self, name: str) -> Lanes:
        """What was added to a name of `rows.StepBar`, on each lane."""
        return self.scratch.read(StepBar.by_attribute()[name])

    def add(self, values: dict[str, Lanes], item: Any = 0, lane: jax.Array | None = None) -> None:
        """Adds to cotangents of constants and of `rows.StepBar`; lane: if items differ by lane."""
        for name, value in values.items():
            table = self.hand if name in self.hand else self.world
            if name in self.names:
                table = self.scratch
                name = StepBar.by_attribute()[name]
            if lane is None:
                table.write(name, plus(table.read(name, item), value), item)
            else:
                table.scatter(name, plus(table.gather(name, item, lane), value), item, lane)

    def add_once(self, values: dict[str, Lanes]) -> None:
        """`add` of what all lanes of a world have alike."""
        first = lanes([self.block.finger == 0], (), wide=True)
        self.add({name: only_on(first, value) for name, value in values.items()})

    def add_joint(self, values: dict[str, Lanes], i: Any) -> None:
        """Adds to cotangents of a joint's state.

        Args:
          values: Lanes of shape (axis, ...) by row of `rows.FingerState`.
          i: Number of the joint's link.
        """
        for name, value in values.items():
            self.finger_state.write(name, plus(self.finger_state.read(name, i), value), i)
