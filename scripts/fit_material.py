"""Fits shear modulus and damping time of a finger to the tip's response to a pressure step.

The measurement is synthetic: MuJoCo C in float64 with another material, and noise on every tip
position.

python -m scripts.fit_material --figure runs/fit_material.png
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import fit, model, rollout, scene
from codesign_jax.engines.mujoco import MujocoEngine
from codesign_jax.engines.structured import StructuredEngine
from codesign_jax.scene import parameters
from scripts.shared import figures as pictures

OFF = ("finger_object", "finger_table", "palm_object", "palm_table", "disturb", "ungrasp")


def finger_scene(links: int, timestep: float) -> scene.Scene:
    """The paper's hand with one finger that touches nothing."""
    overrides = {
        "effects": dict.fromkeys(OFF, False),
        "discretization": {"links": links, "timestep": timestep},
    }
    loaded = scene.load("paper_spheres", overrides=overrides)
    hand = dataclasses.replace(loaded.hand, finger=loaded.hand.finger[:1])
    return dataclasses.replace(loaded, hand=hand)


def pressure_step(the_scene: scene.Scene, pressure: float, duration: float) -> jax.Array:
    """Controls of an arm at rest and a pressure that acts in the first half, (time, nu)."""
    time = np.arange(round(duration / the_scene.discretization.timestep))
    ctrl = np.zeros((len(time), 7))
    ctrl[:, 2] = the_scene.arm.start_height
    ctrl[: len(time) // 2, 6] = pressure
    return jnp.asarray(ctrl)


def world_fields(the_scene: scene.Scene) -> model.ModelFields:
    """Model fields of the default finger without noise."""
    space = parameters.design_space(the_scene.hand)
    params = space.params(space.default())
    return jax.jit(lambda p: model.model_fields(the_scene, p, rollout.nominal_trial(the_scene)))(
        params
    )


def measure(
    the_scene: scene.Scene, ctrl: jax.Array, truth: fit.Material, noise: float, seed: int
) -> jax.Array:
    """Noisy tip positions of the finger in MuJoCo C, shape (time, finger, 3)."""
    fields = fit.with_material(the_scene, world_fields(the_scene), truth)
    batch = jax.tree.map(lambda v: v[None], fields)
    trace = MujocoEngine(the_scene, num_threads=1).rollout(batch, ctrl[None], trajectory=True)
    tips = jax.jit(lambda q: fit.tip_positions(the_scene, fields, q))(trace.qpos[0])
    return tips + noise * jax.random.normal(jax.random.key(seed), tips.shape)


def draw(path: Path, time: np.ndarray, measured: jax.Array, tips: dict[str, jax.Array]) -> None:
    """Writes the figure: vertical tip position, measured, at the guess and fitted."""
    figure = pictures.new(6.4, 3.6)
    axes = figure.add_subplot()
    axes.plot(time, 1e3 * measured[:, 0, 2], ".", color="0.6", ms=4, label="measured")
    for (name, tip), style in zip(tips.items(), ("--", "-"), strict=True):
        axes.plot(time, 1e3 * tip[:, 0, 2], style, color="tab:blue", label=name)
    axes.set(xlabel="time [s]", ylabel="tip height [mm]")
    axes.legend(frameon=False)
    pictures.save(figure, path)


def main() -> None:
    """Measures, fits, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--links", type=int, default=3)
    parser.add_argument("--timestep", type=float, default=0.005)
    parser.add_argument("--duration", type=float, default=1.0)
    parser.add_argument("--pressure", type=float, default=60e3)
    parser.add_argument("--noise", type=float, default=3e-4, help="standard deviation [m]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--figure", type=Path, default=Path("runs") / "fit_material.png")
    args = parser.parse_args()
    the_scene = finger_scene(args.links, args.timestep)
    ctrl = pressure_step(the_scene, args.pressure, args.duration)
    truth = fit.Material(jnp.asarray(70e3), jnp.asarray(0.012))
    guess = fit.Material(jnp.asarray(50e3), jnp.asarray(0.006))
    measured = measure(the_scene, ctrl, truth, args.noise, args.seed)
    engine, fields = StructuredEngine(the_scene), world_fields(the_scene)
    found = fit.fit_material(engine, fields, ctrl, measured, guess, steps=args.steps)
    for name, unit in (("shear_modulus", "Pa"), ("damping_time", "s")):
        first, last, true = (float(getattr(m, name)) for m in (guess, found.material, truth))
        error = 100 * (last / true - 1)
        print(f"{name}: guess {first:g}, found {last:.6g}, true {true:g} {unit} ({error:+.2f} %)")
    print(f"loss: {float(found.loss[0]):.3g} to {float(found.loss[-1]):.3g}")
    simulate = jax.jit(lambda m: fit.simulate_tips(engine, fields, ctrl, m))
    tips = {"guess": simulate(guess), "fitted": simulate(found.material)}
    draw(args.figure, np.arange(len(ctrl)) * args.timestep, measured, tips)
    print(args.figure)


if __name__ == "__main__":
    main()
