"""Contacts between spheres of different fingers: which pairs touch, and what they do to the links.

Every sphere of one finger is a candidate against every sphere of another; the relative motion is
the first finger's minus the second's.  Few candidates touch, so that once a step a broad phase
finds those that do and gives each a slot: slots have the axes (slot, 1, world), those in use come
first, and loops over them end after the last block of slots that any world uses.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax.engines.structured.lanes import dot, once
from codesign_jax.engines.structured.laws.contact import Cone, Contacts, Ends

BLOCK = 8
"""Slots that are done at a time."""
MARGIN = 1e-5
"""Of the squared distance: the broad phase leaves the last digit to the exact distance."""


def finger_pairs(fingers: int) -> list[tuple[int, int]]:
    """Pairs of fingers."""
    return list(itertools.combinations(range(fingers), 2))


def slots(spheres: int, fingers: int) -> int:
    """Number of slots of a world, whole blocks: as many as the kernel has, which tells of too few.

    Args:
      spheres: Spheres of a finger.
      fingers: Number of fingers.
    """
    count = min(4 * spheres, spheres**2) * len(finger_pairs(fingers))
    return BLOCK * -(-count // BLOCK)


def contacts(cone: Cone, centre: jax.Array, radius: jax.Array) -> Contacts:
    """Contacts of the pairs of spheres that touch.

    Args:
      cone: Their parameters.
      centre: Sphere centres, shape (3, link, k, finger, world).
      radius: Radii [m], shape (link, k, finger, world).
    """
    links, k, fingers, worlds = radius.shape
    (first, second), count = _candidates(links, k, fingers), slots(links * k, fingers)
    fits = once(_near, jax.lax.stop_gradient(centre), radius)
    touching = fits.sum(0, dtype=jnp.int32)[None]
    chosen = once(lambda f: _choose(f, count), fits)
    ends = jnp.stack([jnp.asarray(s, jnp.int32)[chosen] for s in (first, second)])
    used = jnp.arange(count)[:, None] < touching

    def place(centre: jax.Array, radius: jax.Array, ends: jax.Array, used: jax.Array):
        return _place(centre.reshape(3, -1, worlds), radius.reshape(-1, worlds), ends, used)

    found = once(place, centre, radius, ends, used)
    point, normal, gap = (x[..., None, :] for x in found)
    link = (ends // (k * fingers)) * fingers + ends % fingers
    return Contacts(point, normal, gap, cone, ends=Ends(link[:, :, None], touching))


def _candidates(links: int, k: int, fingers: int) -> tuple[np.ndarray, np.ndarray]:
    """Spheres of all candidates, as indices in (link, k, finger), in the order of `_near`."""
    index = np.arange(links * k * fingers).reshape(links * k, fingers)
    pairs = finger_pairs(fingers)
    first = np.concatenate([np.repeat(index[:, a], links * k) for a, _ in pairs])
    second = np.concatenate([np.tile(index[:, b], links * k) for _, b in pairs])
    return first, second


def _near(centre: jax.Array, radius: jax.Array) -> jax.Array:
    """Broad phase: which candidates may touch, shape (candidate, world)."""
    *_, fingers, worlds = radius.shape
    c, r = centre.reshape(3, -1, fingers, worlds), radius.reshape(-1, fingers, worlds)
    found = []
    for a, b in finger_pairs(fingers):
        away = c[:, :, None, a] - c[:, None, :, b]
        reach = r[:, None, a] + r[None, :, b]
        found.append((dot(away, away) < (1.0 + MARGIN) * reach**2).reshape(-1, worlds))
    return jnp.concatenate(found)


def _choose(fits: jax.Array, count: int) -> jax.Array:
    """The first candidates that fit, in every world, shape (slot, world); 0 where there is none."""
    # The s-th lies behind as many as have a sum of at most s: found by bisection.
    sums = jnp.cumsum(fits, axis=0, dtype=jnp.int32)
    wanted = jnp.arange(count, dtype=jnp.int32)[:, None]
    low = jnp.zeros((count, fits.shape[1]), jnp.int32)
    step = 1 << (fits.shape[0].bit_length() - 1)
    while step:
        probe = jnp.minimum(low + step, fits.shape[0])
        at = jnp.take_along_axis(sums, probe - 1, axis=0, mode="clip")
        low, step = jnp.where(at <= wanted, probe, low), step // 2
    return jnp.where(low < fits.shape[0], low, 0)


def _place(centre: jax.Array, radius: jax.Array, ends: jax.Array, used: jax.Array):
    """Points, normals and distances of pairs of spheres, shapes (3, slot, world) and (slot, world).

    Args:
      centre: Shape (3, sphere, world).
      radius: Shape (sphere, world).
      ends: Indices of the spheres, shape (2, slot, world).
      used: Which slots are in use, shape (slot, world).
    """
    a, b = (jnp.take_along_axis(centre, e[None], axis=1, mode="clip") for e in ends)
    ra, rb = (jnp.take_along_axis(radius, e, axis=0, mode="clip") for e in ends)
    away = a - b
    square = dot(away, away)
    apart = square > 0
    length = jnp.sqrt(jnp.where(apart, square, 1.0))
    # Concentric spheres have no normal: MuJoCo takes the x axis, from the first to the second.
    fallback = jnp.stack([-jnp.ones_like(square), 0 * square, 0 * square])
    normal = jnp.where(apart, away / length, fallback)
    gap = jnp.where(apart, length, 0.0) - (ra + rb)
    point = a - normal * (ra + 0.5 * gap)
    return point, normal, jnp.where(used, gap, 0.0)


def relative(links: jax.Array, ends: jax.Array) -> jax.Array:
    """Relative spatial motion of pairs of links.

    Args:
      links: Motion of the links, shape (6, link, finger, world).
      ends: Their indices, shape (2, slot, 1, world).

    Returns:
      Shape (6, slot, 1, world).
    """
    flat = links.reshape(6, -1, links.shape[-1])
    first, second = (jnp.take_along_axis(flat, e[None, :, 0], axis=1, mode="clip") for e in ends)
    return (first - second)[:, :, None]
