"""Beams on a compliant wrist and a falling body: all that a scene without contacts has.

Written apart from the engine's solver, to compare its program with: kinematics, bodies and forces
are the engine's, the accelerations those of Featherstone's articulated-body algorithm (Rigid Body
Dynamics Algorithms, 2008, ch. 7).  No contact, no object in the recursion, no warm start.
"""

import jax
import jax.numpy as jnp

from codesign_jax.engines.structured import elimination as el
from codesign_jax.engines.structured.constants import WorldConstants
from codesign_jax.engines.structured.engine import integrate
from codesign_jax.engines.structured.inertia import bodies, smooth_forces
from codesign_jax.engines.structured.kinematics import Acc, State, kinematics
from codesign_jax.engines.structured.lanes import (
    Stages,
    contract,
    cross,
    inverse_spd,
    scan_links,
    spatial,
    sum_fingers,
)
from codesign_jax.engines.structured.newton import wrist_slides
from codesign_jax.model import layout
from codesign_jax.scene import Scene


def step(scene: Scene, hand: WorldConstants, state: State, ctrl: jax.Array) -> State:
    """Advances a batch by one time step.

    Args:
      scene: A scene without contacts, with a compliant wrist.
      hand: The hands.
      state: Their states.
      ctrl: Controls, shape (nu, world).

    Raises:
      ValueError: If the scene's arm is rigid.
    """
    if not scene.effects.wrist:
        raise ValueError("the beams hang on a compliant wrist")
    run = Stages(hand.object_id[0, 0] >= 0 if jax.default_backend() == "cpu" else None)
    kin = kinematics(run, hand, layout(scene).axes, state)
    body = bodies(run, hand, kin)
    smooth = smooth_forces(run, hand, kin, body, state, ctrl, scene)
    inertia = run(lambda b: b.matrix(), body.link)

    def next_joint(node: tuple, link: tuple):
        (axes, arm, tau), own = link
        p, r = run(_add, *node, *own)
        return _eliminate(run, p, r, axes, arm, tau)

    links = (kin.axes, hand.armature, smooth.finger)
    none = jnp.zeros_like(inertia[:, :, 0]), jnp.zeros_like(smooth.link[:, 0])
    own = inertia, smooth.link
    (p, r), factors = scan_links(next_joint, none, links, own, reverse=True)
    p, r = sum_fingers(p) + body.palm.matrix(), sum_fingers(r) + smooth.palm
    arm, slide_axes = hand.wrist_armature, wrist_slides(hand.wrist_armature)
    (p, r), hinges = _eliminate(run, p, r, kin.wrist_axes, arm[3:], smooth.wrist[3:])
    _, slides = _eliminate(run, p, r, slide_axes, arm[:3], smooth.wrist[:3])
    first, palm = run(_substitute, slide_axes, slides, jnp.zeros_like(smooth.palm))
    second, palm = run(_substitute, kin.wrist_axes, hinges, palm)

    def next_link(parent: jax.Array, link: tuple):
        a, motion = run(_substitute, *link[0], parent)
        return motion, a

    _, fingers = scan_links(next_link, palm + 0.0 * none[1], (kin.axes, factors))
    fall = el.solve_object(run, body.object.matrix(), smooth.object)
    fall = spatial(fall[:3], fall[3:] - cross(kin.object_pos, fall[:3]))
    acc = Acc(jnp.concatenate([first, second]), fingers, fall)
    return run(lambda s, k, a: integrate(s, k, a, scene.discretization.timestep), state, kin, acc)


def _add(p: jax.Array, r: jax.Array, inertia: jax.Array, force: jax.Array):
    return p + inertia, r + force


def _eliminate(run: Stages, p: jax.Array, r: jax.Array, axes: jax.Array, arm: jax.Array, tau):
    """Articulated inertia (6, 6, ...) and force (6, ...) without a joint, and D^-1 U', D^-1 y."""

    def project(p: jax.Array, r: jax.Array, axes: jax.Array, tau: jax.Array):
        return contract(p[None], axes[:, None], 2), contract(axes, r[None], 1) + tau

    def factor(axes: jax.Array, u: jax.Array, y: jax.Array, arm: jax.Array):
        eye = jnp.eye(axes.shape[0], dtype=axes.dtype)[:, :, None, None]
        d = run(lambda s, u, m: contract(s[:, None], u[None], 2) + eye * m[:, None], axes, u, arm)
        inverse = run(inverse_spd, d)
        return contract(inverse[:, :, None], u[None], 1), contract(inverse, y[None], 1)

    def reduce(p: jax.Array, r: jax.Array, u: jax.Array, w: jax.Array, z: jax.Array):
        return p - contract(u[:, :, None], w[:, None], 0), r - contract(u, z[:, None], 0)

    u, y = run(project, p, r, axes, tau)
    w, z = run(factor, axes, u, y, arm)
    return run(reduce, p, r, u, w, z), (w, z)


def _substitute(axes: jax.Array, factors: tuple, parent: jax.Array):
    w, z = factors
    a = z - contract(w, parent[None], 1)
    return a, parent + contract(axes, a[:, None], 0)
