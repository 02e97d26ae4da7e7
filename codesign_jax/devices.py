"""Several devices of a process, each of which simulates a share of the worlds."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

Device = Any
"""A `jax.Device`, which type checkers do not know."""

AXIS = "world"
"""Name of the axis along which worlds are shared out."""


def take(count: int | None) -> list[Device]:
    """The first devices of this process, by default all.

    Raises:
      ValueError: If there are not so many.
    """
    available = jax.local_devices()
    if count is not None and not 1 <= count <= len(available):
        raise ValueError(f"{count} devices asked for, {len(available)} available")
    return available[:count]


def shared_out(simulate: Callable[..., Any], count: int) -> Callable[..., Any]:
    """The function of worlds, of which each of so many devices simulates a share.

    With one device it is the function itself.  Under `jax.vmap` each device has a share of every
    batch: worlds whose hands touch and hold more take longer.

    Args:
      simulate: From pytrees, whose arrays have a leading axis (world,) or are numbers, to a pytree
        of arrays with a leading axis (world,); worlds must not depend on each other.
      count: Number of devices.
    """
    if count == 1:
        return simulate
    mesh = jax.sharding.Mesh(np.array(take(count)), (AXIS,))
    by_world = PartitionSpec(AXIS)

    def run(*arguments: Any) -> Any:
        worlds = max(v.shape[0] for v in jax.tree.leaves(arguments) if jnp.ndim(v))
        # Shares are of one size: the last world is repeated, and what it gives is cut off.
        rows = np.minimum(np.arange(-(-worlds // count) * count), worlds - 1)
        filled = jax.tree.map(lambda v: v[rows] if jnp.ndim(v) else v, arguments)
        specs = jax.tree.map(lambda v: by_world if jnp.ndim(v) else PartitionSpec(), filled)
        # No check of what varies between devices: the kernels' calls do not tell.
        sharding = {"mesh": mesh, "in_specs": specs, "out_specs": by_world, "check_vma": False}
        return jax.tree.map(lambda v: v[:worlds], jax.shard_map(simulate, **sharding)(*filled))

    return run
