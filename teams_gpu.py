"""Rates and traces of teams of 8 lanes against a lane a finger: python3 teams_gpu.py."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import scene as scenes
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.engines.structured.kernel import Program, teams
from codesign_jax.engines.structured.world_model import world_constants
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


def contact(index):
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
    same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(out, out2))
    steps = args[1].shape[0] * args[1].shape[1]
    rate = steps / best / 1e6
    say(f"T={team} {name}: {best:.4f} s, {rate:.3f} M world-steps/s ({built:.0f} s), same {same}")
    return [np.asarray(x) for x in out]


teams.lanes_of_a_finger = lambda *_: 8
program = Program(scene, engine.limits, backend="gpu", width=32)
orders = {
    40: np.arange(40) % 24,
    1: np.array([5]),
    5000: np.random.default_rng(0).integers(0, 24, 5000),
}
tables = {}
for n, order in orders.items():
    pack = jax.jit(lambda f, c: program.inputs(world_constants(scene, f), engine.reset(f), c))
    tables[n] = [np.asarray(x) for x in pack(*contact(order))]
where = {w: int(np.argmax(orders[40] == w)) for w in range(24)}
for n in (1, 5000):
    rows = [where[int(w)] for w in orders[n]]
    bad = [
        int((a[rows] != b).any((1, 2) if b.ndim == 3 else (1, 2, 3)).sum())
        for a, b in zip(tables[40], tables[n])
    ]
    say(f"tables of {n} worlds that differ from those of 40:", bad)
found = {n: run(8, f"contact {n}", contact(order), 1) for n, order in orders.items()}
for n in (1, 5000):
    rows = [where[int(w)] for w in orders[n]]
    diff = [int((a[rows] != b).any(1).sum()) for a, b in zip(found[40], found[n])]
    say(f"rollouts of {n} worlds that differ from those of 40:", diff)
for n in (60, 16384):
    eight = run(8, f"contact {n}", contact(np.arange(n) % 24), 2)
grasps = {n: cast(work.inputs(scene, work.make_worlds(scene, n))) for n in (60, 1728)}
for n, args in grasps.items():
    run(8, f"whole grasps {n}", args, 1)
one = run(1, "contact 16384", contact(np.arange(16384) % 24), 1)
for k in (0, 1, 2, 5, 10, 20, 49):
    diff = [np.abs(x[:24, k] - y[:24, k]).max() for x, y in zip(one, eight)]
    say(f"step {k}: distance, height, speed differ by", *(f"{d:.1e}" for d in diff))
run(1, "whole grasps 1728", grasps[1728], 1)
run(1, "whole grasps 60", grasps[60], 1)
