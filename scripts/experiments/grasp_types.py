"""What the hand does: postures of the landscape's good designs, clustered into grasp types.

The cost says that a grasp holds, not how.  The posture is the mean bending of the fingers at the
end of the lift, once for each object in a trial without noise; designs that drop none of them are
clustered by it.  The object's largest tilt up to then tells whether it was flipped (Sec. VI.5).
"""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.cluster.hierarchy
import scipy.spatial.distance

from codesign_jax import model, rollout
from codesign_jax.engines import Engine
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace
from codesign_jax.types import Trial, failed
from scripts.experiments.strategies import Arrays

MOST = 5
"""Largest number of grasp types that is tried."""

MOST_SHOWN = 8
"""Designs of a type of which the first that keeps every object is shown."""

NONE = -1
"""Type of a point that was not simulated or did not keep every object."""


def postures(
    scene: Scene,
    engine: Engine,
    space: DesignSpace,
    designs: np.ndarray,
    *,
    chunk: int = 180,
    say: Callable[[str], None] = print,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulates designs with every object of the scene, without noise.

    Args:
      scene: The scene.
      engine: Engine that keeps trajectories.
      space: Design space.
      designs: Designs [SI units], shape (design, parameter).
      chunk: Worlds of a call.
      say: Told one line a call.

    Returns:
      Mean bending of the fingers at the end of the lift [rad], root to tip, whether the object was
      kept, and the largest angle between its axis and the vertical up to then [rad], of shape
      (design, object) each.
    """
    layout = model.layout(scene)
    bends = 6 + np.arange(layout.dofs.size).reshape(layout.dofs.shape)[..., 0]
    step = round(scene.phases.lift / scene.discretization.timestep)

    def simulate(chosen: jax.Array, trials: Trial) -> tuple[jax.Array, ...]:
        params = jax.vmap(space.params)(chosen)
        outcome, trace = rollout.simulate(scene, engine, params, trials, record_qpos=True)
        bend = trace.qpos[:, step][:, bends].sum(-1).mean(-1)
        kept = (outcome.cost == 0) & ~failed(outcome.status)
        x, y = trace.qpos[:, : step + 1, -3], trace.qpos[:, : step + 1, -2]
        # The third column of the rotation matrix of the quaternion (w, x, y, z) is the axis.
        upright = 1 - 2 * (x**2 + y**2)
        return bend, kept, jnp.arccos(jnp.clip(upright, -1, 1)).max(-1)

    run, objects = jax.jit(simulate), len(scene.objects.object)
    shape, found = (len(designs), objects), []
    trials = stack([rollout.nominal_trial(scene, k) for k in range(objects)])
    total = int(np.prod(shape))
    for start in range(0, total, chunk):
        # Filled up with the last world, so that every call has the compiled size.
        world = np.minimum(np.arange(start, start + chunk), total - 1)
        design, k = np.unravel_index(world, shape)
        chosen = jnp.asarray(designs[design], jnp.float32)
        part = run(chosen, jax.tree.map(lambda v, k=k: v[k], trials))
        found.append([np.asarray(v) for v in part])
        say(f"{min(start + chunk, total):,} of {total:,} grasps")
    bend, kept, tilt = (np.concatenate(v)[:total].reshape(shape) for v in zip(*found, strict=True))
    return bend, kept, tilt


def stack(trials: list[Trial]) -> Trial:
    """Trials with leading axis (trial,), NumPy arrays."""
    return jax.tree.map(lambda *v: np.stack([np.asarray(x) for x in v]), *trials)


def cluster(features: np.ndarray, most: int = MOST) -> tuple[np.ndarray, np.ndarray]:
    """Ward's clusters of standardized features; their number has the largest silhouette.

    Args:
      features: Shape (sample, feature).
      most: Largest number of clusters.

    Returns:
      Labels from 0, the largest cluster first, shape (sample,), and the mean silhouette of 2 to
      `most` clusters: near 1 where clusters lie apart, near 0 where they are cut from one.

    Raises:
      ValueError: If there are fewer samples than clusters or all are alike.
    """
    spread = features.std(0)
    if len(features) <= most or not spread.any():
        raise ValueError(f"{len(features)} samples cannot be clustered")
    points = (features - features.mean(0)) / np.where(spread > 0, spread, 1.0)
    tree = scipy.cluster.hierarchy.linkage(points, "ward")
    cuts = [scipy.cluster.hierarchy.fcluster(tree, n, "maxclust") for n in range(2, most + 1)]
    scores = np.array([silhouette(points, cut) for cut in cuts])
    chosen = cuts[int(scores.argmax())]
    names, count = np.unique(chosen, return_counts=True)
    order = names[np.argsort(-count, kind="stable")]
    return np.argmax(chosen[:, None] == order, axis=1), scores


def silhouette(points: np.ndarray, labels: np.ndarray) -> float:
    """Mean silhouette of a clustering (Rousseeuw 1987); points have shape (sample, feature)."""
    distance = scipy.spatial.distance.cdist(points, points)
    member = labels[:, None] == np.unique(labels)
    count = member.sum(0)
    total = distance @ member
    own = (total * member).sum(1) / np.maximum((member * (count - 1)).sum(1), 1)
    other = np.where(member, np.inf, total / count).min(1)
    alone = (member * count).sum(1) == 1
    return float(np.where(alone, 0.0, (other - own) / np.maximum(own, other)).mean())


def study(
    grid: Arrays,
    scene: Scene,
    engine: Engine,
    space: DesignSpace,
    threshold: float,
    say: Callable[[str], None] = print,
) -> Arrays:
    """Finds the grasp types of a landscape.

    Args:
      grid: Arrays of the landscape.
      scene: Its scene.
      engine: Engine that keeps trajectories.
      space: Its design space.
      threshold: Cost below which points are simulated.
      say: Told one line a call.

    Returns:
      `type` of each point, shape (point, point), `NONE` where there is none; `bend` and `tilt`
      [rad], see `postures`, shape (point, point, object), not a number where not simulated;
      `silhouette` of 2 to `MOST` types.
    """
    points = grid["exclude"] < threshold
    axes = np.meshgrid(grid["first_axis"], grid["second_axis"], indexing="ij")
    designs = space.from_units(np.stack(axes, -1)[points])
    bend, kept, tilt = postures(scene, engine, space, designs, say=say)
    good = kept.all(1)
    labels, scores = cluster(bend[good])
    types = np.full(points.shape, NONE, np.int8)
    types[tuple(np.argwhere(points)[good].T)] = labels
    arrays = {"type": types, "silhouette": scores}
    for name, value in (("bend", bend), ("tilt", tilt)):
        arrays[name] = np.full((*points.shape, bend.shape[1]), np.nan, np.float32)
        arrays[name][points] = value
    return arrays


def typical(grid: Arrays, found: Arrays, number: int) -> list[tuple[int, int]]:
    """Grid points of a type, best designs first; of equally good ones the more typical posture."""
    points = np.argwhere(found["type"] == number)
    at = tuple(points.T)
    bend = found["bend"][at]
    away = np.abs(bend - bend.mean(0)).sum(1)
    order = np.lexsort((away, grid["exclude"][at]))
    return [(int(i), int(j)) for i, j in points[order]]


def describe(grid: Arrays, found: Arrays) -> str:
    """The grasp types as a Markdown table."""
    names, units = grid["parameters"], grid["units"]
    lines = [
        "| grasp type | designs | "
        + " | ".join(f"{n} [{u}]" for n, u in zip(names, units, strict=True))
        + " | bending of the fingers, mean [range] | tilt of the object up to the end of the lift, "
        "median [5 to 95 %] | mean cost |",
        "|---|---|---|---|---|---|---|",
    ]
    for number in range(int(found["type"].max()) + 1):
        points = found["type"] == number
        at, bend = np.argwhere(points), np.degrees(found["bend"][points]).mean(1)
        ends = [grid[f"{axis}_axis"][at[:, i]] for i, axis in enumerate(("first", "second"))]
        cells = [f"{number + 1}", f"{len(at)}"]
        cells += [f"{e.min():.0f} to {e.max():.0f}" for e in ends]
        cells += [f"{bend.mean():.0f}° [{bend.min():.0f}, {bend.max():.0f}]"]
        if "tilt" in found:  # results of before the tilt was kept have none
            low, middle, high = np.degrees(np.quantile(found["tilt"][points], (0.05, 0.5, 0.95)))
            cells += [f"{middle:.0f}° [{low:.0f}, {high:.0f}]"]
        else:
            cells += ["–"]
        lines.append("| " + " | ".join([*cells, f"{grid['exclude'][points].mean():.2f}"]) + " |")
    scores = ", ".join(f"{n}: {s:.2f}" for n, s in enumerate(found["silhouette"], 2))
    return "\n".join(lines) + f"\n\nMean silhouette by the number of types: {scores}."


def videos(
    grid: Arrays, found: Arrays, scene: Scene, engine: Engine, space: DesignSpace, folder: Path
) -> list[Path]:
    """Animates each type's best design with every object of the scene, without noise.

    Args:
      grid: Arrays of the landscape.
      found: See `study`.
      scene: The scene.
      engine: Engine that keeps trajectories.
      space: Design space.
      folder: Folder of the animations.

    Returns:
      Paths of the animations, in the order of the types.

    Raises:
      ValueError: If the best few designs of a type all lose an object. One may, although the study
        kept it: a batch of another size rounds differently, and contact is chaotic.
    """
    from codesign_jax.report import animation

    paths, objects = [], len(scene.objects.object)
    trials = stack([rollout.nominal_trial(scene, k) for k in range(objects)])
    for number in range(int(found["type"].max()) + 1):
        for i, j in typical(grid, found, number)[:MOST_SHOWN]:
            units = np.array([grid["first_axis"][i], grid["second_axis"][j]])
            params = space.params(jnp.asarray(space.from_units(units), jnp.float32))
            grasps = animation.replay(scene, engine, params, trials)
            if all(np.asarray(g.outcome.cost) == 0 for g in grasps):
                break
        else:
            raise ValueError(f"the best designs of type {number + 1} lose an object")
        path = folder / f"grasp_type_{number + 1}.gif"
        paths.append(animation.write_gif(scene, grasps, path, frames_per_second=5, size=(200, 240)))
    return paths
