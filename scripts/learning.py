# pyright: reportMissingImports=false
"""A learning curve of docs/control.md: PPO of Stable-Baselines3 on the default environment.

    taskset -c 0,1 python -m scripts.learning [--seeds 0 1 2] [--minutes 10] [--out TABLE]

Needs Stable-Baselines3. Objects of 50 to 250 g that look alike; the policy begins near the scene's
key frames and is judged, without its noise, in the same fresh grasps as they are. Each row of the
table is a judgement, whose own time does not count. The figure lies in docs/figures.
"""

import argparse
import csv
import os
import time
from pathlib import Path

import matplotlib.figure
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

from codesign_jax import env, scene, use_compilation_cache
from codesign_jax.env.stable_baselines import BatchEnv

DOCS = Path(__file__).parents[1] / "docs"
GRASPS = 64
"""Grasps of a batch: an update learns from one grasp of each."""
JUDGED = 256
"""Fresh grasps of a judgement."""
FRESH = 1_000_000
"""Seed of the first of them; training draws from small seeds."""
EVERY = 20
"""Updates from judgement to judgement."""
HEAD = ("seed", "actions", "held", "standard_error", "seconds", "load")


def task() -> env.GraspEnv:
    """Objects of one to five times 50 g, ten actions a second."""
    noise = {"mass_range": 5.0}
    return env.GraspEnv(scene.load("paper", overrides={"objects": {"noise": noise}}), period=0.1)


class Judge:
    """Rewards of a policy without its noise in fresh grasps, the same at each call."""

    def __init__(self) -> None:
        """Compiles once for all judgements."""
        self.grasps = BatchEnv(task(), GRASPS)

    def __call__(self, policy: PPO | None) -> np.ndarray:
        """Rewards of whole grasps, shape (JUDGED,); None for the key frames."""
        scaling = policy.get_vec_normalize_env() if policy else None
        rewards = []
        for first in range(FRESH, FRESH + JUDGED, GRASPS):
            self.grasps.seed(first)
            obs = self.grasps.reset()
            going = np.ones(GRASPS, bool)
            total = np.zeros(GRASPS)
            while going.any():
                action = np.zeros((GRASPS, self.grasps.env.action_size), np.float32)
                if policy is not None and scaling is not None:
                    action, _ = policy.predict(scaling.normalize_obs(obs), deterministic=True)
                obs, reward, done, _ = self.grasps.step(action)
                total += reward * going
                going &= ~done
            rewards.append(total)
        return np.concatenate(rewards)


class Curve(BaseCallback):
    """Judges a policy while it is trained, and writes rows; ends when its time is over."""

    def __init__(self, seed: int, judge: Judge, limit: float, table: Path) -> None:
        """Takes what a row needs, and the limit of the training [s]."""
        super().__init__()
        self.seed = seed
        self.judge = judge
        self.limit = limit
        self.table = table
        self.updates = 0
        self.judging = 0.0
        self.start = time.monotonic()

    @property
    def seconds(self) -> float:
        """Time of the training so far, compiling included and judging not."""
        return time.monotonic() - self.start - self.judging

    def _on_step(self) -> bool:
        return self.seconds < self.limit

    def _on_rollout_start(self) -> None:
        if self.updates % EVERY == 0:
            self.row()
        self.updates += 1

    def _on_training_end(self) -> None:
        self.row()

    def row(self) -> None:
        """A judgement."""
        seconds = self.seconds
        before = time.monotonic()
        held = self.judge(self.model if self.num_timesteps else None)
        self.judging += time.monotonic() - before
        error = held.std(ddof=1) / np.sqrt(len(held))
        numbers = (
            f"{held.mean():.4f}",
            f"{error:.4f}",
            f"{seconds:.0f}",
            f"{os.getloadavg()[0]:.1f}",
        )
        with self.table.open("a", newline="") as file:
            csv.writer(file).writerow((self.seed, self.num_timesteps, *numbers))


def train(seed: int, seconds: float, judge: Judge, table: Path) -> None:
    """One policy from its first action on."""
    vectors = VecNormalize(BatchEnv(task(), GRASPS, seed=1000 * seed), norm_reward=False)
    steps = judge.grasps.env.episode_length
    model = PPO(
        "MlpPolicy",
        vectors,
        n_steps=steps,
        batch_size=GRASPS * steps // 8,
        n_epochs=5,
        learning_rate=1e-3,
        gamma=0.995,
        seed=seed,
        device="cpu",
        policy_kwargs={"log_std_init": -1.0},
    )
    model.learn(10**9, callback=Curve(seed, judge, seconds, table))


def draw(table: Path) -> None:
    """The curves over the actions, and the key frames' own reward."""
    rows = np.genfromtxt(table, delimiter=",", names=True)
    figure = matplotlib.figure.Figure(figsize=(6, 3), layout="constrained")
    axes = figure.add_subplot()
    for seed in np.unique(rows["seed"]):
        chosen = rows[rows["seed"] == seed]
        axes.plot(chosen["seconds"] / 60, chosen["held"], ".-", label=f"seed {seed:.0f}")
    axes.axhline(rows["held"][rows["actions"] == 0][0], color="black", ls=":", label="key frames")
    axes.set(xlabel="minutes", ylabel="share of the time held", ylim=(0, 1))
    axes.legend(loc="lower left", ncols=4)
    figure.savefig(DOCS / "figures" / "learning.png", dpi=110)


def main() -> None:
    """Trains a policy for each seed, adds its judgements to the table, and draws the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--out", type=Path, default=DOCS / "data" / "learning.csv")
    options = parser.parse_args()
    use_compilation_cache()
    torch.set_num_threads(1)
    if not options.out.exists():
        options.out.write_text(",".join(HEAD) + "\n")
    judge = Judge()
    for seed in options.seeds:
        train(seed, 60 * options.minutes, judge, options.out)
    draw(options.out)


if __name__ == "__main__":
    main()
