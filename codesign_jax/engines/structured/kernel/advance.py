"""Semi-implicit Euler inside the kernel, and which worlds may go on."""

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured.kernel import grip
from codesign_jax.engines.structured.kernel.contact_sets import zeros
from codesign_jax.engines.structured.kernel.memory import loop
from codesign_jax.engines.structured.kernel.problem import Iterate
from codesign_jax.engines.structured.lanes import total
from codesign_jax.engines.structured.lanewise import Lanes, lanes, lanewise
from codesign_jax.engines.structured.laws import kinematics as kin
from codesign_jax.engines.structured.laws.integration import integrate
from codesign_jax.engines.structured.laws.kinematics import State

if TYPE_CHECKING:
    from codesign_jax.engines.structured.kernel.step import Step


def advance(step: "Step", state: dict, at: dict, now: Iterate, goes_on: Any, speed: Any):
    """Semi-implicit Euler; worlds that are decided or whose step fails stay as they were.

    Returns:
      Largest velocity after the step, and whether the world has moved, shapes (1, world).
    """
    p, h = step.p, step.p.scene.discretization.timestep
    new = lanewise(partial(moved, h), state, at["columns"], now.wrist, now.object_motion)
    size = lanewise(_largest, new)

    def link(i: Any, largest: Lanes) -> Lanes:
        q, rate, acc = (
            p.finger_state.read(step.finger_state, n, i) for n in ("finger", "finger_vel", "acc")
        )
        rate, q, top = lanewise(partial(turned, h), q, rate, acc)
        p.scratch.write(step.scratch, "new_finger", q, i)
        p.scratch.write(step.scratch, "new_finger_vel", rate, i)
        return lanewise(_worse, largest, top)

    like = jnp.zeros((p.size,), step.finger_state.dtype)
    fingers = loop(p.links, link, zeros((), like), p.size).lane
    largest = _worse(size.lane, step.block.fold(fingers, _worse))
    limit = step.constant("speed").lane
    good = goes_on & (largest <= limit)
    acc = {"acc_wrist": now.wrist, "acc_object": now.object_motion}
    for name, value in {**new, **acc}.items():
        kept = lanewise(jnp.where, lanes([good], (), wide=False), value, state[name])
        p.world_state.write(step.world_state, name, kept, 0, step.block.world)

    def store(i: Any, x: Any) -> Any:
        for name in ("finger", "finger_vel"):
            value = p.scratch.read(step.scratch, f"new_{name}", i)
            old = p.finger_state.read(step.finger_state, name, i)
            kept = lanewise(jnp.where, lanes([good], (), wide=False), value, old)
            p.finger_state.write(step.finger_state, name, kept, i)
        return x

    jax.lax.fori_loop(0, p.links, store, jnp.int32(0))
    grip.store(step, good)
    return jnp.where(goes_on, largest, speed), good


def moved(h: float, state: dict, columns, wrist, obj) -> dict:
    """Wrist and object after the step."""
    names = ("wrist", "position", "quat", "wrist_vel", "linear_vel", "angular_vel")
    # The fingers' joints are moved link by link, see `turned`.
    old = State(finger=0.0, finger_vel=0.0, acc=None, **{n: state[n] for n in names})  # type: ignore[arg-type]
    new = integrate(old, columns, kin.Acc(wrist, 0.0, obj), h)  # type: ignore[arg-type]
    return {n: getattr(new, n) for n in names}


def _worse(a: jax.Array, b: jax.Array) -> jax.Array:
    """The larger one, or what is not finite."""
    return jnp.where((b > a) | (b != b), b, a)


def _largest(new: dict):
    velocities = [new[n] for n in ("wrist_vel", "linear_vel", "angular_vel")]
    top = jnp.abs(velocities[0][0])
    for value in velocities:
        for i in range(value.shape[0]):
            top = _worse(top, jnp.abs(value[i]))
    places = [new["wrist"][i] for i in range(6)] + [new["position"][i] for i in range(3)]
    place = total(places + [new["quat"][i] for i in range(4)])
    return jnp.where(place == place, top, place)


def turned(h: float, q, rate, acc):
    """A joint after the step: velocities, angles, and the largest velocity."""
    rate = rate + h * acc
    q = q + h * rate
    top = jnp.abs(rate[0])
    for k in range(1, rate.shape[0]):
        top = _worse(top, jnp.abs(rate[k]))
    return rate, q, top
