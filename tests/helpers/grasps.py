"""Small scenes and states for the tests: two fingers, few links, one object a scene."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import control, cost, model, rollout, scene
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.scene import parameters, schema
from codesign_jax.types import Trial

DATA = Path(__file__).parents[1] / "data"
# The primitives, which are also the names of the one-object sets in data/.
SHAPES = ("box", "cylinder", "capsule", "sphere")


# Found by a random search over symmetric designs, straight above the object; in the files' units.
GOOD = {"length": 86, "height": 24.5, "wall": 5, "spread": 55, "arm_z": 58, "pressure": 130}
"""A design of the paper's hand that holds all its objects, in the units of the hand's file."""


def overrides_of(settings):
    """Overrides of a scene by table, of settings as table__key=value."""
    overrides = {}
    for key, value in settings.items():
        table, name = key.split("__")
        table = "hand.section" if table == "section" else table
        overrides.setdefault(table, {})[name] = list(value) if type(value) is tuple else value
    return overrides


@functools.cache
def pinch(shape="box", links=3, *, hand=DATA / "pinch.toml", objects=None, **settings):
    """Two opposed fingers and one object, or other files; settings as table__key=value."""
    overrides = overrides_of({"discretization__links": links} | settings)
    files = {"hand_name": hand, "object_set": objects or DATA / f"{shape}.toml"}
    return scene.load("paper_spheres", **files, overrides=overrides)


def off(effects):
    """Settings of `pinch` without these effects, named in one text."""
    return {f"effects__{name}": False for name in effects.split()}


def hurried(*ends, without=""):
    """Settings of `pinch`: ends of the first phases [s], and without these effects."""
    names = ("approach", "inflate", "lift", "disturb", "ungrasp")
    return {f"phases__{n}": end for n, end in zip(names, ends, strict=False)} | off(without)


@functools.cache
def short_grasp():
    """0.6 s: the hand comes down beside the box, closes by a real air supply, lifts and shakes.

    Contact forces are solved so far that two programs of a grasp end within 10 um of one another.
    """
    settings = hurried(0.2, 0.35, 0.5, 0.6, without="ungrasp palm_object palm_table")
    settings |= {"newton__decrement": 1e-6}
    return pinch("box", effects__pressure_dynamics=True, arm__start_height=0.15, **settings)


def random_designs(space, seed, count):
    """Uniform designs inside the bounds and under the pressure limit, (count, parameter)."""
    low = np.array(space.low)
    high = np.array(space.high)
    designs = low + (high - low) * np.random.default_rng(seed).random((count, len(low)))
    return jax.jit(jax.vmap(space.project))(jnp.asarray(designs))


def random_worlds(the_scene, seed, count):
    """Params and trials of random hands, both with leading axis (world,)."""
    space = parameters.design_space(the_scene.hand)
    params = jax.jit(jax.vmap(space.params))(random_designs(space, seed, count))
    return params, _trials(the_scene, jax.random.key(seed), count)


@functools.partial(jax.jit, static_argnums=(0, 2))
def _trials(the_scene, key, count):
    return rollout.sample_trials(the_scene, key, count)


@functools.partial(jax.jit, static_argnums=0)
def world_inputs(the_scene, params, trial):
    """Model fields and controls of one world; operation by operation they compile for 15 s."""
    return model.model_fields(the_scene, params, trial), control.commands(the_scene, params, trial)


@functools.partial(jax.jit, static_argnums=0)
def batch_inputs(the_scene, params, trials):
    """Model fields and controls of worlds, with a leading axis (world,)."""
    return jax.vmap(lambda p, t: world_inputs(the_scene, p, t))(params, trials)


@functools.partial(jax.jit, static_argnums=0)
def lanes(the_scene, fields):
    """`world_constants` of worlds, in one program."""
    return world_constants(the_scene, fields)


def random_constants(the_scene, seed, count=None):
    """The scene with numbers up to 20 % larger or smaller, leaves of shape () or (count,).

    They stay in their ranges, and the phases in order.
    """
    random = np.random.default_rng(seed)
    shape = () if count is None else (count,)
    varied = jax.tree.map(
        lambda v, r: np.clip(v * random.uniform(0.8, 1.2, shape), r.low, r.high),
        the_scene,
        schema.ranges(the_scene),
    )
    slow = jax.tree.map(lambda v: v * random.uniform(0.97, 1.03, shape), the_scene.phases)
    return dataclasses.replace(varied, phases=jax.tree.map(np.asarray, slow))


def still(shape=0):
    """A trial without noise, as NumPy arrays."""
    zero = np.zeros(())
    unity = np.ones(())
    return Trial(np.int32(shape), np.zeros(2), zero, np.zeros(2), unity, unity, unity, unity, unity)


def hand_world(the_scene, **changes):
    """The table's default design with changes, and a still trial, as NumPy arrays in float64."""
    space = parameters.design_space(the_scene.hand)
    with jax.enable_x64(True):
        params = nth(space.params(space.default()), ...)
    changes = {k: 0 * getattr(params, k) + v for k, v in changes.items()}
    return params._replace(**changes), still()


def nth(tree, index):
    """Entry of every array of a batch, as NumPy arrays."""
    return jax.tree.map(lambda v: np.asarray(v)[index], tree)


def stack(*trees):
    """Batches single worlds."""
    return jax.tree.map(lambda *v: np.stack([np.asarray(x) for x in v]), *trees)


def repeat(tree, count):
    """A batch of one world, `count` times; by NumPy, for which nothing is compiled."""
    return jax.tree.map(lambda v: np.repeat(np.asarray(v)[None], count, 0), tree)


@functools.partial(jax.jit, static_argnums=0)
def outcome(the_scene, trace, start=0):
    """`cost.outcome` of a world, in one program."""
    return cost.outcome(the_scene, trace, start)


@functools.partial(jax.jit, static_argnums=0)
def outcomes(the_scene, traces):
    """`cost.outcome` of worlds, in one program."""
    return jax.vmap(lambda trace: cost.outcome(the_scene, trace))(traces)
