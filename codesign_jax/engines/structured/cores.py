"""Worlds shared between a CPU's cores, which JAX sees as devices if told so at the start."""

import contextlib
import contextvars
import os
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

_SMALLEST = 8  # worlds a core below which a share costs as much as the whole

_alone = contextvars.ContextVar("alone", default=False)


@contextlib.contextmanager
def on_one_core() -> Iterator[None]:
    """What is traced in this context stays on its device: the caller shares worlds out itself."""
    token = _alone.set(True)
    try:
        yield
    finally:
        _alone.reset(token)


def use_all_cores() -> None:
    """Lets JAX see every core as a device; to be called before JAX is used for the first time.

    Raises:
      RuntimeError: If JAX has been used already.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    jax.config.update("jax_num_cpu_devices", cores or 1)


def on_all_cores(function: Callable[..., Any], *args: Any) -> Any:
    """Runs a function on shares of the worlds, one share a core, at the same time.

    The function must treat worlds one by one. Shares are equal: the last one is filled up with
    repetitions. World k goes to core k modulo the cores: the trials of a design, which take about
    as long as each other, are spread.

    Args:
      function: From arrays to arrays, all with leading axis (world,).
      *args: Pytrees of its arrays.
    """
    worlds = jax.tree.leaves(args)[0].shape[0]
    devices = jax.devices("cpu") if jax.default_backend() == "cpu" else []
    cores = len(devices)
    if cores < 2 or _alone.get() or worlds < cores * _SMALLEST:
        return function(*args)
    share = -(-worlds // cores)
    order = np.arange(share * cores).reshape(share, cores).T.ravel()
    mesh = Mesh(np.array(devices), ("core",))
    dealt = jax.tree.map(lambda v: jnp.take(v, order % worlds, axis=0), args)
    spec = PartitionSpec("core")
    shared = jax.shard_map(
        function, mesh=mesh, in_specs=(spec,) * len(args), out_specs=spec, check_vma=False
    )
    back = np.argsort(order)[:worlds]
    return jax.tree.map(lambda v: jnp.take(v, back, axis=0), shared(*dealt))
