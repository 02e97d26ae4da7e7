"""Missing axes, lengths that do not fit and numbers in other units are answered in words."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from codesign_jax import codesign, make_engine, rollout, scene
from codesign_jax.scene import InputError
from tests.helpers.toy_engine import TINY, tiny

SCENE, SPACE, ENGINE = tiny()
HAND = jax.tree.map(np.asarray, SPACE.params(SPACE.default()))
TRIAL = jax.tree.map(np.asarray, rollout.nominal_trial(SCENE))
OPTIMIZER = codesign.make_filter(SPACE)


def batch(tree, count):
    return jax.tree.map(lambda v: np.broadcast_to(v, (count, *np.shape(v))), tree)


def simulate(params, trials, **more):
    return rollout.simulate(SCENE, ENGINE, params, trials, **more)


def evaluate(population):
    made = codesign.Task(SCENE, SPACE, 2, ENGINE).evaluate
    return made(jnp.asarray(population), jax.random.key(0))


def draw(key, count):
    """Trials, as a program that JAX traces draws them."""
    return jax.eval_shape(lambda k: rollout.sample_trials(SCENE, k, count), key)


FINER = scene.load(TINY, overrides={"discretization.links": 4, "effects.twist": True})
LONG = dataclasses.replace(SCENE, gravity=np.full(5, 9.81))
CASES = {
    "an engine of another scene": (
        lambda: rollout.simulate(FINER, ENGINE, batch(HAND, 1), batch(TRIAL, 1)),
        r"engine toy was made for a scene of another structure \(other: effects.twist, "
        r"discretization.links\); make_engine\('toy', scene\) makes one",
    ),
    "one hand": (
        lambda: simulate(HAND, batch(TRIAL, 3)),
        r"params have no axis \(world,\); of one, jax.tree.map\(lambda v: v\[None\], params\)",
    ),
    "an array of another length": (
        lambda: simulate(batch(HAND, 2)._replace(spread=np.zeros(3)), batch(TRIAL, 2)),
        "the arrays of params have different lengths: length 2, .*spread 3",
    ),
    "a number for a key": (
        lambda: draw(0, 3),
        r"key must be one typed key from jax.random.key, got shape \(\) of int32",
    ),
    "a scene's name for a scene": (
        lambda: make_engine("structured", "paper"),  # type: ignore[arg-type]
        r"scene is 'paper', not a Scene; scene.load\('paper'\) reads it",
    ),
    "numbers": (
        lambda: rollout.simulate(LONG, ENGINE, batch(HAND, 2), batch(TRIAL, 2)),
        "scene.gravity has 5 values, one a world: there are 2",
    ),
    "one design": (
        lambda: evaluate(SPACE.default()),
        r"population has shape \(2,\), not \(particle, parameter\); population\[None\] makes",
    ),
    "millimetres": (lambda: evaluate([[97.0, 0.02]]), "length = 97.0 .* did you mean 0.097"),
    "millimetres at the start": (
        lambda: OPTIMIZER.init(jax.random.key(0), np.array([97.0, 20.0]), 3),
        r"seed_particle\[0\] = 97 is far outside its bounds, 0.01 to 0.18",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_said(case):
    call, words = CASES[case]
    with pytest.raises((InputError, ValueError), match=words) as caught:
        call()
    assert isinstance(caught.value, InputError) or case == "millimetres at the start"


def test_it_is_said_while_tracing():
    with pytest.raises(InputError, match="params have no axis"):
        jax.jit(lambda p, t: simulate(p, t))(HAND, batch(TRIAL, 3))
