"""A network that predicts whether a grasp is kept, and whether it saves grasps in a search.

It learns from a file of `codesign sample`: from design, object (extents, volume, mass, and where it
is unknown nothing else) and the trial's constants.  A fifth of the designs is held out; with
`--objects` each object of the file is held out in turn as well.  Errors are the log loss and the
Brier score beside those of each object's share, the calibration is the share kept in ten equal
parts of the predictions.

Then for growing numbers of grasps that train it, all counted: of random designs that were held out
the hundredth that it likes best, and with `--simulate` the design that gradients through it find
(as Yi et al. 2025, arXiv:2505.20404, do), simulated in fresh trials.
"""

import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.stats

from codesign_jax import rollout, scene, use_compilation_cache
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.engines import make_engine
from codesign_jax.report.bodies import object_mesh
from codesign_jax.runs import parquet
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.types import failed
from scripts.shared import provenance
from scripts.shared.output import write_json

NOISE = ("x_m", "y_m", "yaw_rad", "arm_roll_rad", "arm_pitch_rad") + tuple(
    f"{name}_factor" for name in ("mass", "size", "friction", "stiffness", "hand_mass")
)
WIDTHS, RATE, BATCH, DECAY = (128, 128), 2e-3, 512, 1e-4
STEPS = 4000
"""Most steps of training; the network of the least loss on a tenth of the designs is taken."""


class Grasps(NamedTuple):
    """Grasps as arrays, leading axis (grasp,).

    Attributes:
      design: Index of the design.
      unit: The design in unit coordinates, shape (grasp, parameter).
      object: Index of the object.
      noise: The trial's constants.
      kept: Whether it was kept, 0.0 or 1.0.
    """

    design: np.ndarray
    unit: np.ndarray
    object: np.ndarray
    noise: np.ndarray
    kept: np.ndarray

    def rows(self, which: np.ndarray) -> "Grasps":
        """Some of the grasps."""
        return Grasps(*(v[which] for v in self))


def read(path: Path, space: DesignSpace, names: list[str], most: int | None = None) -> Grasps:
    """Grasps of a file of `codesign sample`.

    Args:
      path: The file.
      space: Its design space.
      names: Names of the objects.
      most: Most grasps, from the first one on.
    """
    pa = parquet.pyarrow_module("scripts.dataset.surrogate")
    table = pa.parquet.read_table(path)[: most or None]
    own = [f.name for f in table.schema if b"parameter" in (f.metadata or {})]
    values = np.stack([table[n].to_numpy() for n in own], 1) * np.array(space.scale)
    unit = (values - space.low) / (space.high - space.low)
    noise = np.stack([table[f"noise_{n}"].to_numpy() for n in NOISE], 1)
    which = np.array([names.index(n) for n in table["object"].to_pylist()])
    kept = np.array([v == "kept" for v in table["verdict"].to_pylist()], np.float32)
    return Grasps(table["design"].to_numpy(), unit.astype(np.float32), which, noise, kept)


def shapes(the_scene: Scene) -> np.ndarray:
    """What the network is told of each object: extents, volume, mass, shape (object, 5)."""
    rows = []
    for index, shape in enumerate(the_scene.objects.object):
        vertices, faces = object_mesh(the_scene, index)
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
        rows.append([*np.ptp(vertices, axis=0), abs(volume) ** (1 / 3), shape.mass])
    return np.array(rows, np.float32)


class Model(NamedTuple):
    """A trained network.

    Attributes:
      layers: Weights and biases.
      mean: Of the inputs.
      spread: Of the inputs.
      range: Lowest and highest inputs that it learnt from, to which others are clipped.
    """

    layers: list
    mean: np.ndarray
    spread: np.ndarray
    range: tuple[np.ndarray, np.ndarray]

    def logit(self, inputs: jax.Array) -> jax.Array:
        """Log odds that grasps are kept, shape (grasp,)."""
        seen = jnp.clip(inputs, *self.range)
        return _forward(self.layers, (seen - self.mean) / self.spread)


def _forward(layers: list, x: jax.Array) -> jax.Array:
    for weights, bias in layers[:-1]:
        x = jax.nn.swish(x @ weights + bias)
    weights, bias = layers[-1]
    return (x @ weights + bias)[..., 0]


def _loss(layers: list, x: jax.Array, kept: jax.Array) -> jax.Array:
    return optax.sigmoid_binary_cross_entropy(_forward(layers, x), kept).mean()


def inputs(grasps: Grasps, told: np.ndarray) -> np.ndarray:
    """What the network reads, shape (grasp, input)."""
    return np.concatenate([grasps.unit, told[grasps.object], grasps.noise], 1).astype(np.float32)


def train(grasps: Grasps, told: np.ndarray, seed: int = 0) -> Model:
    """Fits a network; stops by designs of its own that it does not learn from.

    Args:
      grasps: What it learns from.
      told: See `shapes`.
      seed: Of the first weights and the order.
    """
    draws = np.random.default_rng(seed)
    x, own = inputs(grasps, told), np.unique(grasps.design)
    out = np.isin(grasps.design, draws.choice(own, max(1, len(own) // 10), replace=False))
    mean, spread, seen = x.mean(0), x.std(0), (x.min(0), x.max(0))
    spread = np.where(spread > 1e-6, spread, 1.0)
    x, sizes = (x - mean) / spread, (x.shape[1], *WIDTHS, 1)
    layers = [
        (draws.normal(size=(a, b)).astype(np.float32) / np.sqrt(a), np.zeros(b, np.float32))
        for a, b in zip(sizes, sizes[1:], strict=False)
    ]
    descent = optax.adamw(RATE, weight_decay=DECAY)
    state = descent.init(layers)

    @jax.jit
    def step(layers: list, state: Any, x: jax.Array, kept: jax.Array) -> tuple[Any, Any]:
        updates, state = descent.update(jax.grad(_loss)(layers, x, kept), state, layers)
        return optax.apply_updates(layers, updates), state

    loss, fitted = jax.jit(_loss), np.flatnonzero(~out)
    best, least = layers, np.inf
    for number in range(STEPS):
        rows = draws.choice(fitted, BATCH)
        layers, state = step(layers, state, x[rows], grasps.kept[rows])
        if number % 50 == 49 and (now := float(loss(layers, x[out], grasps.kept[out]))) < least:
            best, least = layers, now
    return Model(best, mean, spread, seen)


def predicted(model: Model, grasps: Grasps, told: np.ndarray) -> np.ndarray:
    """Probability that each grasp is kept."""
    return np.asarray(jax.nn.sigmoid(model.logit(jnp.asarray(inputs(grasps, told)))))


def scores(share: np.ndarray, kept: np.ndarray, base: np.ndarray) -> dict[str, Any]:
    """Errors and calibration of predictions.

    Args:
      share: Predicted probabilities, shape (grasp,).
      kept: What happened, 0 or 1.
      base: Probabilities to compare with, such as each object's share in training.
    """

    def loss(p: np.ndarray) -> float:
        p = np.clip(p, 1e-6, 1 - 1e-6)
        return float(-(kept * np.log(p) + (1 - kept) * np.log(1 - p)).mean())

    parts = np.array_split(np.argsort(share), 10)
    bins = [[float(share[p].mean()), float(kept[p].mean()), len(p)] for p in parts]
    good = int(kept.sum())
    ranks = scipy.stats.rankdata(share)[kept > 0.5].sum() - good * (good + 1) / 2
    return {
        "grasps": len(kept),
        "kept": float(kept.mean()),
        "log_loss": loss(share),
        "log_loss_of_shares": loss(base),
        "brier": float(((share - kept) ** 2).mean()),
        "brier_of_shares": float(((base - kept) ** 2).mean()),
        "auc": float(ranks / max(1, good * (len(kept) - good))),
        "calibration": bins,
        "calibration_error": float(np.average([abs(p - k) for p, k, _ in bins])),
    }


def shares(grasps: Grasps, count: int) -> np.ndarray:
    """Share kept of each object, shape (object,); that of all for an object without grasps."""
    return np.array(
        [grasps.kept[m].mean() if (m := grasps.object == k).any() else grasps.kept.mean()
         for k in range(count)]
    )  # fmt: skip


def liking(model: Model, unit: jax.Array, told: np.ndarray, noise: np.ndarray) -> jax.Array:
    """Mean log odds of designs over objects and constants, shape (design,).

    Args:
      model: The network.
      unit: Designs in unit coordinates, shape (design, parameter).
      told: See `shapes`.
      noise: Constants of some trials, shape (trial, constant).
    """

    def one(design: jax.Array) -> jax.Array:
        count = len(told), len(noise)
        x = jnp.concatenate(
            [
                jnp.broadcast_to(design, (*count, design.size)),
                jnp.broadcast_to(told[:, None], (*count, told.shape[1])),
                jnp.broadcast_to(noise, (*count, noise.shape[1])),
            ],
            -1,
        )
        return model.logit(x).mean()

    return jax.lax.map(one, unit, batch_size=256)


def climbed(
    model: Model, space: DesignSpace, told: np.ndarray, noise: np.ndarray, seed: int
) -> np.ndarray:
    """The design that gradients through the network like best [SI], from the best of 4,096 random.

    Args:
      model: The network.
      space: The design space.
      told: See `shapes`.
      noise: Constants of some trials.
      seed: Of the random designs.
    """
    drawn = space.sample(jax.random.key(seed), 4096)
    unit = (drawn - space.low) / (space.high - space.low)
    unit = unit[jnp.argsort(-liking(model, unit, told, noise))[:32]]
    descent = optax.adam(0.01)

    def step(carry: tuple, _: None) -> tuple[tuple, None]:
        unit, state = carry
        slope = jax.grad(lambda u: -liking(model, u, told, noise).sum())(unit)
        updates, state = descent.update(slope, state)
        moved: Any = optax.apply_updates(unit, updates)
        return (jnp.clip(moved, 0, 1), state), None

    (unit, _), _ = jax.lax.scan(step, (unit, descent.init(unit)), length=200)
    designs = jax.vmap(space.project)(space.low + unit * (space.high - space.low))
    unit = (designs - space.low) / (space.high - space.low)
    return np.asarray(designs[jnp.argmax(liking(model, unit, told, noise))])


def simulated(the_scene: Scene, space: DesignSpace, designs: np.ndarray, trials: int) -> np.ndarray:
    """Share of fresh grasps that designs keep, shape (design,)."""
    engine = make_engine("structured", the_scene)
    drawn = rollout.sample_trials(the_scene, jax.random.key(20), trials)
    program = jax.jit(
        lambda x: rollout.evaluate(the_scene, engine, jax.vmap(space.params)(x), drawn)
    )
    found = program(jnp.asarray(designs, jnp.float32))
    good = ~failed(np.asarray(found.status)) & (np.asarray(found.cost) < SUCCESS_COST)
    return good.mean(1)


def study(grasps: Grasps, told: np.ndarray, each: bool) -> tuple[dict[str, Any], np.ndarray]:
    """Errors on designs and objects that were held out, and which grasps are of such designs."""
    out = grasps.design % 5 == 4
    train_on, rest = grasps.rows(~out), grasps.rows(out)
    base = shares(train_on, len(told))
    model = train(train_on, told)
    found: dict[str, Any] = {
        "designs": scores(predicted(model, rest, told), rest.kept, base[rest.object])
    }
    if each:
        found["objects"] = {}
        for k in np.unique(grasps.object):
            own, unseen = train_on.rows(train_on.object != k), rest.rows(rest.object == k)
            model = train(own, told)
            share = np.full(len(unseen.kept), own.kept.mean())
            found["objects"][int(k)] = scores(predicted(model, unseen, told), unseen.kept, share)
    return found, out


def screened(grasps: Grasps, told: np.ndarray, out: np.ndarray, counts: list[int]) -> list[dict]:
    """What random designs keep that the network likes best, by the grasps that trained it."""
    train_on, rest = grasps.rows(~out), grasps.rows(out)
    own, first = np.unique(rest.design, return_index=True)
    kept = np.array([rest.kept[rest.design == d].mean() for d in own])
    rows = []
    for count in [c for c in counts if c <= len(train_on.kept)]:
        model = train(train_on.rows(np.arange(count)), told)
        like = np.asarray(liking(model, jnp.asarray(rest.unit[first]), told, rest.noise[:16]))
        best = np.argsort(-like)[: max(5, len(own) // 100)]
        rows.append(
            {
                "grasps": count,
                "designs": len(best),
                "kept": float(kept[best].mean()),
                "kept_of_all": float(kept.mean()),
            }
        )
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns the exit status."""
    parser = provenance.parser(__doc__)
    parser.add_argument("file", type=Path, help="Parquet file of `codesign sample`")
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--preset", default="23d")
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--object-set", help="object set of the file instead of the scene's")
    parser.add_argument("--most", type=int, help="grasps of the file that are used")
    parser.add_argument("--objects", action="store_true", help="hold out each object in turn")
    parser.add_argument("--counts", type=int, nargs="*", default=[600, 2400, 9600, 38_400])
    parser.add_argument("--repeats", type=int, default=6, help="searches by other grasps of it")
    parser.add_argument("--simulate", type=int, default=0, help="fresh trials of climbed designs")
    args = parser.parse_args(arguments)
    use_compilation_cache()
    the_scene = scene.load(args.scene, object_set=args.object_set)
    space, names = design_space(the_scene.hand, args.preset), the_scene.objects.object
    told = shapes(the_scene)
    grasps = read(args.file, space, [shape.name for shape in names], args.most)
    found, out = study(grasps, told, args.objects)
    found["screened"] = screened(grasps, told, out, args.counts)
    if args.simulate:
        learnt, rows, designs = grasps.rows(~out), [], []
        for count in args.counts:
            for block in range(min(args.repeats, len(learnt.kept) // count)):
                own = learnt.rows(np.arange(block * count, (block + 1) * count))
                designs.append(climbed(train(own, told), space, told, own.noise[:16], block))
                rows.append(count)
        kept = simulated(the_scene, space, np.stack(designs), args.simulate)
        found["climbed"] = [
            {
                "grasps": c,
                "trials": args.simulate,
                "kept": np.round(kept[np.array(rows) == c], 4).tolist(),
            }
            for c in dict.fromkeys(rows)
        ]
    row = {"file": args.file.name, "scene": args.scene, "object_set": args.object_set}
    write_json(args.json, row | found | {"provenance": provenance.results(args.commit)})
    for name, own in found.items():
        print(name, own)
    return 0


if __name__ == "__main__":
    sys.exit(main())
