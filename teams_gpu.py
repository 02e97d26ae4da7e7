"""Rates and traces of teams of 8 lanes against a lane a finger: python3 teams_gpu.py [short]."""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import scene as scenes
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import teams
from scripts.shared import work

begin = time.perf_counter()


def say(*text):
    print(f"[{time.perf_counter() - begin:.0f} s]", *text, flush=True)


scene = scenes.load("paper")
engine = StructuredEngine(scene)


def cast(t):
    def one(x):
        x = np.asarray(x)
        return jnp.asarray(x, jnp.float32 if np.issubdtype(x.dtype, np.floating) else x.dtype)

    return jax.tree.map(one, t)


plain = scenes.load("paper", overrides={"effects": {"surface": "spheres"}})
starts, ctrl = work.window(plain, 24, 50, distinct=24)
made, _ = work.inputs(scene, work.make_worlds(scene, 24))
near = (made._replace(start=np.asarray(starts.start)), np.asarray(ctrl))
say("inputs", jax.devices()[0].device_kind)


def contact(n):
    index = np.arange(n) % 24
    return cast(jax.tree.map(lambda x: np.asarray(x)[index], near))


def run(team, name, args, repeat=3):
    teams.lanes_of_a_finger = lambda *_: team
    start = time.perf_counter()
    call = jax.jit(lambda f, c: engine.rollout(f, c)[:3]).lower(*args).compile()
    built = time.perf_counter() - start
    out = jax.block_until_ready(call(*args))
    best = 1e9
    for _ in range(repeat):
        start = time.perf_counter()
        out2 = jax.block_until_ready(call(*args))
        best = min(best, time.perf_counter() - start)
        if best > 6:
            break
    same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(out, out2))
    steps = args[1].shape[0] * args[1].shape[1]
    say(f"T={team} {name}: {best:.4f} s, {steps / best / 1e6:.3f} M world-steps/s (built in {built:.0f} s), runs equal {same}")
    return [np.asarray(x) for x in out]


first = {team: run(team, "contact 24", contact(24)) for team in (8, 1)}
a, b = first[1], first[8]
for k in (0, 1, 2, 5, 10, 20, 35, 49):
    diff = [np.abs(x[:, k] - y[:, k]).max() for x, y in zip(a, b)]
    say(f"step {k}: distance, height, speed differ by", *(f"{d:.1e}" for d in diff), "of", *(f"{np.abs(x[:, k]).max():.2e}" for x in a))
many = run(8, "contact 8448", contact(8448))
say("neighbours change no bit", all(np.array_equal(x[:24], y) and np.array_equal(x[24:48], y) for x, y in zip(many, b)))
for n in (60, 16384):
    run(8, f"contact {n}", contact(n))
grasps = {n: cast(work.inputs(scene, work.make_worlds(scene, n))) for n in (60, 1728)}
for n, args in grasps.items():
    run(8, f"whole grasps {n}", args, 2)
for n in (60, 8448, 16384):
    run(1, f"contact {n}", contact(n))
for n, args in grasps.items():
    run(1, f"whole grasps {n}", args, 1)
