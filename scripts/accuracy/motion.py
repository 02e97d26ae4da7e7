"""Accuracy of free motion: hands in the air, shaken and released, at every accuracy.

python -m scripts.accuracy.motion --out runs/motion                   # paths; again to go on
python -m scripts.accuracy.motion --out runs/motion --share 1/7       # beside 6 other processes
python -m scripts.accuracy.motion --out runs/motion --merge           # data and the page's table

Hands that searches recommended get two to four long, thin fingers, the softest that can
be built.  Nothing touches them.  They are inflated, shaken for a second, and emptied in 50 ms
(`energy.FREE`).  The tips' paths are compared with those of a finer step and more links; the energy
that no work accounts for is that of the audit.
"""

import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout, scene, use_compilation_cache
from codesign_jax.engines.structured import StructuredEngine, coordinates
from codesign_jax.engines.structured.laws import kinematics as kin
from codesign_jax.engines.structured.world_model import world_constants
from codesign_jax.model import joint_axes
from codesign_jax.scene import Scene, parameters
from scripts.shared import energy, output, provenance, work

DOCS = Path(__file__).parents[2] / "docs"
DATA = Path("data/free_motion.json")
HANDS = 60
SEED = 9
EVERY = 0.02
"""Time between compared states [s], a multiple of all steps."""
FINEST = "0.5 ms, 20 links"
SETTINGS: dict[str, tuple[str, dict]] = {
    "`fast`": ("fast", {}),
    "`standard`": ("standard", {}),
    "`fine`": ("fine", {}),
    "2 ms": ("standard", {"timestep": 0.002}),
    "`reference`": ("reference", {}),
    FINEST: ("reference", {"timestep": 0.0005}),
}
"""Accuracies, and the values of `discretization` that replace theirs, by their words."""


def free_scene(accuracy: str, changes: dict) -> Scene:
    """The default scene with a hand in the air."""
    numbers = {f"discretization.{name}": value for name, value in changes.items()}
    return scene.load("paper", accuracy=accuracy, overrides=energy.FREE | numbers)


def designs(the_scene: Scene, count: int = HANDS) -> tuple[np.ndarray, np.ndarray]:
    """Hands with thin fingers, shape (hand, 23), and which fingers are thin, (hand, finger)."""
    space = parameters.design_space(the_scene.hand)
    rng = np.random.default_rng(SEED)
    chosen = work.winners()[rng.integers(0, 100, count)].astype(float)
    place = {name: k for k, name in enumerate(space.names)}
    thin = np.zeros((count, 4), bool)
    for row, mask in zip(chosen, thin, strict=True):
        mask[rng.choice(4, rng.integers(2, 5), replace=False)] = True
        for f in np.flatnonzero(mask):
            row[place[f"length[{f}]"]] = rng.uniform(0.150, 0.180)
            row[place[f"height[{f}]"]] = rng.uniform(0.016, 0.017)
            row[place[f"wall[{f}]"]] = 0.002
            row[place[f"pressure[{f}]"]] = rng.uniform(40e3, 80e3)  # or the highest legal one
    return np.asarray(jax.vmap(space.project)(jnp.asarray(chosen, jnp.float32))), thin


def tips(the_scene: Scene, fields: Any, qpos: Any) -> jax.Array:
    """The ends of a world's fingers, shape (time, finger, 3)."""
    many = jax.tree.map(lambda v: jnp.repeat(v[None], len(qpos), 0), fields)
    hand = world_constants(the_scene, many)
    still = jnp.zeros((len(qpos), qpos.shape[1] - 1), qpos.dtype)
    state = coordinates.make(the_scene, qpos, still, still)
    k = kin.kinematics(hand, joint_axes(the_scene), state)
    along = hand.centre[-1, 0] * 2
    end = k.origin[:, -1] + k.link[0, :, -1] * along
    return jnp.moveaxis(end + state.position, (0, 1, 2), (2, 1, 0))


def simulate(name: str, file: Path, commit: str | None) -> None:
    """Writes the paths of the tips at a setting, (hand, time, finger, 3), and what was gained."""
    the_scene = free_scene(*SETTINGS[name])
    h = the_scene.discretization.timestep
    engine = StructuredEngine(the_scene)
    space = parameters.design_space(the_scene.hand)
    vectors, thin = designs(the_scene)
    params = jax.vmap(space.params)(jnp.asarray(vectors))
    trial = rollout.sample_trials(the_scene, jax.random.key(SEED), 1)
    trials = jax.tree.map(lambda v: jnp.repeat(v, HANDS, 0), trial)
    fields, ctrl = rollout.prepare(the_scene, params, trials, engine)
    series = jax.jit(lambda f, c: engine.states(f, c, trajectory=True)[1])(fields, ctrl)
    audit = energy.audit(the_scene, fields, ctrl, energy.Path(series["qpos"], series["qvel"]))
    first = round(the_scene.phases.disturb / h)
    run = jax.jit(partial(tips, the_scene))
    paths = []
    for k in range(HANDS):
        hand = jax.tree.map(lambda v, k=k: v[k], fields)
        paths.append(np.asarray(run(hand, series["qpos"][k, :: round(EVERY / h)])))
    arrays = {
        "tips": np.stack(paths),
        "thin": thin,
        "gained": audit.rise(first) / audit.stored[:, first],
        "fastest": np.abs(np.asarray(series["qvel"])[..., 6:-6]).max(),
        "made": np.array(json.dumps(provenance.measurement(commit))),
    }
    output.write_arrays(file, arrays)


def merge(folder: Path) -> dict:
    """Errors of every setting that was simulated against the finest, and what its hands gain."""
    files = {name: file_of(folder, name) for name in SETTINGS}
    stored = {name: np.load(file) for name, file in files.items() if file.exists()}
    phases = free_scene("standard", {}).phases
    ends = [round(t / EVERY) for t in (phases.lift, phases.disturb, phases.ungrasp)]
    windows = {"shaken": slice(*ends[:2]), "released": slice(*ends[1:])}
    rows = []
    for name, part in stored.items():
        away = 1e3 * np.linalg.norm(part["tips"] - stored[FINEST]["tips"], axis=-1)
        row = {"name": name, "fastest_rad_s": float(part["fastest"])}
        row["gained"] = float(part["gained"].max())
        for window, steps in windows.items():
            rms = np.sqrt((away[:, steps] ** 2).mean(1))[part["thin"]]
            row[f"{window}_median_mm"] = float(np.median(rms))
            row[f"{window}_worst_mm"] = float(rms.max())
        rows.append(row)
    thin = stored[FINEST]["thin"]
    made = json.loads(str(stored[FINEST]["made"]))
    return {"made": made, "hands": len(thin), "fingers": int(thin.sum()), "rows": rows}


def file_of(folder: Path, name: str) -> Path:
    words = "".join(c if c.isalnum() else "_" for c in name).strip("_")
    return folder / f"{words}.npz"


def table(data: dict) -> str:
    """The table of the page."""
    lines = [
        "| setting | shaken, median and worst | released, median and worst | energy gained |",
        "| --- | --- | --- | --- |",
    ]
    for row in data["rows"]:
        if row["name"] == FINEST:
            continue
        errors = [
            f"{row[f'{part}_median_mm']:.2g} and {row[f'{part}_worst_mm']:.2g} mm"
            for part in ("shaken", "released")
        ]
        lines.append(f"| {row['name']} | {' | '.join(errors)} | {100 * row['gained']:.1f} % |")
    return "\n".join(lines)


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/motion"), help="folder of the files")
    parser.add_argument("--share", default="1/1", metavar="I/N", help="every N-th setting")
    parser.add_argument("--merge", action="store_true", help="write data and table, and stop")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder that gets them")
    args = parser.parse_args()
    use_compilation_cache()
    if args.merge:
        data = merge(args.out)
        output.write_json(args.docs / DATA, data)
        print(table(data))
        output.fill(args.docs / "accuracy.md", table(data), "motion")
        return 0
    args.out.mkdir(parents=True, exist_ok=True)
    first, count = (int(n) for n in args.share.split("/"))
    for name in [*SETTINGS][first - 1 :: count]:
        if not file_of(args.out, name).exists():
            simulate(name, file_of(args.out, name), args.commit)
    return 0


if __name__ == "__main__":
    sys.exit(main())
