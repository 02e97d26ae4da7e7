"""How deep fingers, object and palm stand in one another over grasps.

python -m scripts.contact_depths docs/data/search/buildable.npz --trials 3 --out runs/depths.json
python -m scripts.contact_depths runs/ten --trials 18 --batch 1024 --out runs/depths.json

A file is the .npz of a search of `scripts.search` (what it recommends in the end), a .json whose
`designs` have a `vector` each, as --out has, or a folder of runs.  One program simulates all
grasps, --batch at a time.  Depths are those of the rings that the engine presses with, in every
step from the inflation on.  Beside them stand, as *_surface_mm, depths from recorded poses alone:
of a body's deepest point from the other's surface, with |y/a|^4 + |z/b|^4 = 1 along a finger's
blended links and a cap over the last quarter of a segment.  Both are of sections under their
pressure, where they grow with it.
"""

import argparse
import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import files, model, rollout, section_sizes, types
from codesign_jax import scene as scenes
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.engines import make_engine
from codesign_jax.model.layout import PALM_FROM, beyond_base
from codesign_jax.scene import InputError, Scene, keypaths, parameters
from codesign_jax.scene.primitives import PRIMITIVES
from scripts.shared import provenance, work

# sections a link; the cap's length in links, that of one section
STATIONS = 4
TIP = 0.25
CAP = 0.5, 0.8, 0.95, 1.0  # places of its rings
ARC = 3.0, 1.8  # links and heights along a finger from which on its parts touch one another
# Kinds of contact whose depths the engine records, by the names that they have here.
RINGS = {"self": "finger_itself", "finger": "finger_finger", "palm": "finger_palm"}
RINGS |= {"object": "finger_object", "object_palm": "palm_object"}
LIMITS = dict(self_mm=3.0, finger_share=1 / 3, finger_deep_s=0.5, palm_mm=2.0)
LIMITS |= dict(object_held_mm=4.0, object_palm_mm=2.0)  # beyond which kept grasps are counted


_TURN, _UP = (v.ravel() for v in np.meshgrid(*[np.linspace(0, np.pi / 2, n) for n in (25, 7)]))
AHEAD = np.stack([np.sin(_UP), np.cos(_UP) * np.cos(_TURN), np.cos(_UP) * np.sin(_TURN)], 1)
ACROSS = AHEAD[_UP == 0]
_CIRCLE = np.stack([f(np.pi / 10 * np.arange(20)) for f in (np.cos, np.sin)], 1)
OUTLINE = _CIRCLE / (_CIRCLE**4).sum(1, keepdims=True) ** 0.25
RING = np.concatenate([OUTLINE, OUTLINE / 2, [[0, 0]]])


class Tube(NamedTuple):
    """A finger in states.

    Centres (state, station, 3) and frames (state, station, 3, 3) of sections with their places
    along it, a link's length, the cap's half axes (state, 3), and rings of points (state, ring,
    point, 3) with their places.
    """

    centre: np.ndarray
    frame: np.ndarray
    along: np.ndarray
    segment: float
    half: np.ndarray
    rings: np.ndarray
    place: np.ndarray


def tube(joints: np.ndarray, turn: np.ndarray, size: tuple[float, Any, Any]) -> Tube:
    """A finger in states.

    Args:
      joints: Places of its joints [m], shape (state, link, 3).
      turn: Frames of its links, that of the half link at the palm first.
      size: Length, and width and height in each state, shape (state,) or () [m].
    """
    states, links = joints.shape[:2]
    segment = size[0] / links
    half = np.empty((states, 3))
    for axis, extent in enumerate((2 * TIP * segment, *size[1:])):
        half[:, axis] = extent / 2
    along = segment * np.arange(STATIONS * links) / STATIONS
    row = np.clip(np.ceil(along / segment - 1e-9).astype(int) - 1, 0, links - 1)
    blend = np.minimum(along / segment - row, 1)[:, None, None]
    mean = turn[:, row] + blend * (turn[:, row + 1] - turn[:, row])  # linear blend skinning
    ahead, across, up = np.moveaxis(mean, -1, 0)
    beyond = along - (row + 0.5) * segment  # their joints
    centre = joints[:, row] + beyond[:, None] * ahead + half[:, 2, None, None] * up
    ahead = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
    across = across - (across * ahead).sum(-1, keepdims=True) * ahead
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    frame = np.stack([ahead, across, np.cross(ahead, across)], -1)
    outlines = RING * half[:, None, None, 1:]
    body = centre[:, :, None] + outlines @ frame[..., 1:].swapaxes(-1, -2)
    cap = [np.insert(RING * (1 - u**4) ** 0.25, 0, u, axis=1) for u in CAP]
    cap = np.stack(cap) * half[:, None, None]
    cap = centre[:, -1:, None] + cap @ frame[:, -1:].swapaxes(-1, -2)
    place = np.append(along, np.full(len(CAP), along[-1]))
    return Tube(centre, frame, along, segment, half, np.concatenate([body, cap], 1), place)


def in_tube(
    rings: np.ndarray, solid: Tube, itself: tuple[np.ndarray, np.ndarray] | None = None
) -> Any:
    """Depth of the deepest point of each state in a finger [m], 0 where none is, shape (state,).

    Args:
      rings: Points around their last one, shape (state, ring, point, 3).
      solid: The finger.
      itself: Of the finger's own rings their places along it, and from which distance on they
        count, shape (state,).
    """
    deepest = np.zeros(len(rings))
    last = len(solid.along) - 1
    if not rings.size:
        return deepest  # a ball has no edges
    reach = np.linalg.norm(solid.half[:, 1:], axis=1).max() + solid.along[1]
    wide = np.linalg.norm(rings - rings[:, :, -1:], axis=-1).max()
    gap = rings[:, :, -1, None].astype(np.float32) - solid.centre[:, None].astype(np.float32)
    near = np.einsum("sijk,sijk->sij", gap, gap) < (reach + wide) ** 2
    if itself is not None:
        near &= np.abs(itself[0][:, None] - solid.along) > itself[1][:, None, None]
    for s in np.flatnonzero(near.any((1, 2))):
        ring, k = np.nonzero(near[s])
        away = rings[s, ring] - solid.centre[s, k][:, None]
        pair, point = np.nonzero((away**2).sum(-1) < reach**2)
        if not len(pair):
            continue
        k = k[pair]
        p = rings[s, ring[pair], point]
        after = np.minimum(k + 1, last)
        local, beyond = (
            np.einsum("nij,ni->nj", solid.frame[s, i], p - solid.centre[s, i]) for i in (k, after)
        )
        tip = k == last
        whole = local[:, 0] - beyond[:, 0]
        inside = (local[:, 0] >= 0) & (tip | (beyond[:, 0] < 0) & (whole > 0))
        share = np.where(inside & ~tip, local[:, 0] / np.where(whole > 0, whole, 1), 0)
        half = solid.half[s]
        to_tip = solid.along[-1] + half[0] - solid.along[k] - share * solid.along[1]
        local = local + share[:, None] * (beyond - local)
        local[~tip, 0] = 0
        inside &= ((local / half) ** 2**2).sum(1) < 1
        for some, directions in ((inside & ~tip, ACROSS), (inside & tip, AHEAD)):
            if some.any():  # the nearest tangent of a convex section
                support = ((directions * half) ** (4 / 3)).sum(1) ** 0.75
                depth = (support - np.abs(local[some]) @ directions.T).min(1)
                depth = np.where(tip[some], depth, np.minimum(depth, to_tip[some]))
                deepest[s] = max(deepest[s], depth.max())
    return deepest


def in_disc(
    palm: Any, place: np.ndarray, turn: np.ndarray, points: np.ndarray, counts: Any = True
) -> np.ndarray:
    """Depth of the deepest point in the palm's disc from below or aside, shape (state,).

    Args:
      points: Points, shape (state, ring, point, 3).
      counts: Which rings count, shape (state, ring); all without.
    """
    away = points - place[:, None, None]
    x, y, z = np.moveaxis(away @ turn[:, None], -1, 0)
    inside = np.minimum(palm.radius - np.hypot(x, y), z).max(2, initial=0, where=z < palm.thickness)
    return inside.max(1, initial=0, where=counts)


def in_object(kind: str, size: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Depth of the deepest point in a primitive, in whose frame the points are [m]."""
    beyond = np.abs(local) - size
    if kind == "sphere":
        beyond = np.linalg.norm(local, axis=-1, keepdims=True) - size[0]
    elif kind == "cylinder":
        across = np.linalg.norm(local[..., :2], axis=-1) - size[0]
        beyond = np.stack([across, np.abs(local[..., 2]) - size[1]], -1)
    return np.maximum(-beyond.max(-1).min(1), 0)


def surface(shape: Any, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on a primitive's edges, and on all of it, in its frame [m]."""
    mesh = PRIMITIVES[shape.type].triangles(size)
    sharp = mesh.vertices[mesh.face_adjacency_edges[mesh.face_adjacency_angles > 0.5]]
    between = np.linspace(0, 1, 41 if shape.type == "box" else 3)[:, None, None]
    edges = sharp[:, 0] + between * (sharp[:, 1] - sharp[:, 0])
    return edges.reshape(-1, 3), np.asarray(mesh.subdivide_to_size(0.005).vertices)


def poses(compiled: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (state, body, 3) and orientations (state, body, 3, 3) of bodies, by MuJoCo C."""
    data = mujoco.MjData(compiled)
    place = []
    turn = []
    for state in qpos:
        data.qpos[:] = state
        mujoco.mj_kinematics(compiled, data)
        place.append(data.xpos.copy())
        turn.append(data.xmat.reshape(-1, 3, 3).copy())
    return np.stack(place), np.stack(turn)


def surface_depths(
    scene: Scene,
    tubes: list[Tube],
    place: np.ndarray,
    turn: np.ndarray,
    solid: tuple[str, np.ndarray, np.ndarray],
) -> dict[str, np.ndarray]:
    """Depths of fingers' surfaces [m], one as a share of a finger, by kind of contact, (state,).

    Args:
      solid: The object's type, its half sizes, and points of its edges, (state, point, 3).
    """
    kind, size, edges = solid
    lay = model.layout(scene)
    palm = scene.hand.palm
    centre = place[:, lay.object]
    frame = turn[:, lay.object]
    depths = {n: np.zeros(len(place)) for n in ("self", "finger", "share", "palm", "object")}

    def deeper(name: str, depth: np.ndarray) -> None:
        depths[name] = np.maximum(depths[name], depth)

    for f, finger_tube in enumerate(tubes):
        height = 2 * finger_tube.half[:, 2]
        least = np.maximum(ARC[0] * finger_tube.segment, ARC[1] * height)
        deeper("self", in_tube(finger_tube.rings, finger_tube, (finger_tube.place, least)))
        for other in tubes[:f] + tubes[f + 1 :]:
            depth = in_tube(finger_tube.rings, other)
            deeper("finger", depth)
            deeper("share", depth / (2 * other.half[:, 1:].min(1)))
        free = finger_tube.place > PALM_FROM * lay.links * finger_tube.segment
        free = free & beyond_base(finger_tube.place, height[:, None])
        deeper("palm", in_disc(palm, place[:, 1], turn[:, 1], finger_tube.rings, free))
        points = finger_tube.rings.reshape(len(place), -1, 3) - centre[:, None]
        deeper("object", in_object(kind, size, points @ frame))
        deeper("object", in_tube(edges[:, :, None], finger_tube))
    return depths


def measure(
    scene: Scene, params: Any, trial: Any, qpos: np.ndarray, recorded: dict[str, np.ndarray]
) -> dict[str, float]:
    """Depths [mm], durations [s], and bending while held, of a grasp from the inflation on.

    Args:
      qpos: Positions of these states, shape (state, nq).
      recorded: Depths of `types.Forces` in these states [m], by kind of contact, (state,) each.
    """
    h = scene.discretization.timestep
    lay = model.layout(scene)
    place, turn = poses(model.compile_model(scene, params, trial), qpos)
    shape = scene.objects.object[int(trial.shape)]
    size = float(trial.size) * np.array(shape.half_sizes)
    centre = place[:, lay.object]
    frame = turn[:, lay.object]
    edges, skin = (centre[:, None] + v @ frame.swapaxes(-1, -2) for v in surface(shape, size))
    first, begin, end = (int(scene.last_step(p)) for p in ("approach", "inflate", "disturb"))
    grown = section_sizes.of_bodies(scene, params, trial)[first : first + len(qpos)]
    tubes = []
    for f, bodies in enumerate(lay.bodies):
        # The half link at the palm has the size of the others here, which no contact meets.
        width, height = grown[:, bodies[0]].T
        sizes = (
            float(params.length[f]),
            scene.hand.section.width * width,
            float(params.height[f]) * height,
        )
        tubes.append(tube(place[:, bodies], turn[:, [lay.stubs[f], *bodies]], sizes))
    surface_series = surface_depths(scene, tubes, place, turn, (shape.type, size, edges))
    hold = slice(begin - first, end - first)
    surface_series["object_palm"] = in_disc(
        scene.hand.palm, place[:, 1], turn[:, 1], skin[:, :, None]
    )
    none = np.zeros(len(qpos))
    series = {name: recorded.get(kind, none) for name, kind in RINGS.items()}
    hinges = lay.dofs[..., 0]  # hinges that bend
    bend = np.median(qpos[hold][:, hinges], 0)
    curved = np.abs(bend).max(1) * np.asarray(params.height) / np.array([t.segment for t in tubes])

    def deepest(series: dict[str, np.ndarray], end: str = "") -> dict[str, float]:
        depths = {name: series[name].max() for name in ("self", "finger", "palm", "object")}
        depths |= {"object_held": series["object"][hold].max()}
        depths |= {"object_palm": series["object_palm"][hold].max()}
        depths |= {"object_held_median": np.median(series["object"][hold])}
        return {f"{name}{end}": depth for name, depth in depths.items()}

    depths = deepest(series) | deepest(surface_series, "_surface")

    def lasting(depth: np.ndarray, limit: float) -> float:
        return round(h * int((depth > limit).sum()), 3)

    return {f"{k}_mm": round(1e3 * float(v), 2) for k, v in depths.items()} | {
        "self_deep_s": lasting(series["self"], 1e-3 * LIMITS["self_mm"]),
        "finger_share": round(float(surface_series["share"].max()), 3),
        "finger_deep_s": lasting(surface_series["share"], LIMITS["finger_share"]),
        "palm_deep_s": lasting(series["palm"], 1e-3 * LIMITS["palm_mm"]),
        "angle": round(float(np.degrees(bend.sum(1).max())), 0),
        "strain": round(float(curved.max()), 2),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Quantiles over the kept grasps, and how many of them are beyond a limit."""
    kept = [r for r in rows if r["kept"]]
    statistics: dict[str, Any] = {"grasps": len(rows), "kept": len(kept)}
    statistics["failed"] = sum(r["failed"] for r in rows)
    for key in list(kept[0])[4:] if kept else ():  # behind what a lost grasp has as well
        values = np.array([r[key] for r in kept])
        quantiles = np.quantile(values, [0.5, 0.9, 0.95, 0.99, 1]).round(2).tolist()
        statistics[key] = dict(zip(("median", "90%", "95%", "99%", "most"), quantiles, strict=True))
        if key in LIMITS:
            statistics[key] |= {"limit": LIMITS[key], "beyond": int((values > LIMITS[key]).sum())}
    return statistics


def grasps(scene: Scene, designs: np.ndarray, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of all designs in all trials."""
    space = parameters.design_space(scene.hand, args.preset)
    engine = make_engine("structured", scene)
    key = jax.random.fold_in(jax.random.key(args.seed), 0x64657074)  # no search has met them
    trials = jax.tree.map(np.asarray, rollout.sample_trials(scene, key, args.trials))
    hands = jax.jit(jax.vmap(space.params))(jnp.asarray(designs, jnp.float32))
    hands = jax.tree.map(np.asarray, hands)
    total = len(designs) * args.trials
    size = min(args.batch, total)
    start = int(scene.last_step("approach"))
    shown = {"record_qpos": True, "record_forces": True}
    run = jax.jit(lambda p, t: rollout.simulate(scene, engine, p, t, **shown))
    rows: list[dict[str, Any]] = []
    os.environ["JAX_PLATFORMS"] = "cpu"  # of the processes that measure
    with ProcessPoolExecutor(args.workers, multiprocessing.get_context("spawn")) as pool:
        for first in range(0, total, size):
            world = np.minimum(first + np.arange(size), total - 1)
            p = jax.tree.map(lambda v, w=world: v[w // args.trials], hands)
            t = jax.tree.map(lambda v, w=world: v[w % args.trials], trials)
            outcome, trace = jax.tree.map(np.asarray, run(p, t))
            bad = types.failed(outcome.status)
            pending = []
            kept = ~bad & (outcome.cost < SUCCESS_COST)
            for i in range(min(size, total - first)):
                hand, trial = jax.tree.map(lambda v, i=i: v[i], (p, t))
                row = {"design": int(world[i]) // args.trials, "kept": bool(kept[i])}
                row |= {
                    "object": scene.objects.object[int(trial.shape)].name,
                    "failed": bool(bad[i]),
                }
                rows.append(row)
                if kept[i]:
                    states = trace.qpos[i, start:]
                    depth = {k: v[i, start:] for k, v in trace.forces.depth.items()}
                    pending.append((row, pool.submit(measure, scene, hand, trial, states, depth)))
            for row, depths in pending:
                row |= depths.result()
            print(f"{len(rows):,} of {total:,}", flush=True)
    return rows


def designs_of(path: Path) -> list[np.ndarray]:
    """Designs of a file or of run folders [SI units]."""
    if path.is_dir():
        from codesign_jax.runs import read_run, selection

        folders = sorted(p.parent for p in path.rglob("provenance.json"))
        return [selection.choose(read_run(p)[0], selection.read_record(p)).design for p in folders]
    if path.suffix == ".json":
        return [np.array(d["vector"]) for d in json.loads(path.read_text())["designs"]]
    return list(work.winners(path))


def main() -> None:
    """Command line."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--count", type=int, help="designs of each file; all without")
    parser.add_argument("--trials", type=int, default=3, help="of a design, objects in turn")
    parser.add_argument("--batch", type=int, default=96, help="worlds of a call")
    parser.add_argument("--workers", type=int, help="processes that measure")
    parser.add_argument("--preset", default="23d", help="the designs' parameters")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--commit", help="commit of the code where there is no repository to ask")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    scene = scenes.load("paper", overrides=keypaths.parse(args.set))
    designs = np.stack([v for path in args.files for v in designs_of(path)[: args.count]])
    rows = grasps(scene, designs, args)
    notes = provenance.results(args.commit)
    content = [{"vector": v.tolist()} for v in designs]
    for row in rows:
        content[row["design"]].setdefault("grasps", []).append(row)
    with files.atomically(args.out) as part:
        text = json.dumps({**notes, "summary": summary(rows), "designs": content}, indent=1)
        part.write_text(text + "\n")
    print(json.dumps(summary(rows), indent=1))


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
