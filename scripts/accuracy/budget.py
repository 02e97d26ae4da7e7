"""The same designs in the same trials by every variant of the default scene: verdicts and rates.

And finger tips in a fast motion in the air, against MuJoCo C with a short step and many links.
"""

import base64
import dataclasses
import json
import os
import time
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from codesign_jax import model, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.engines.mujoco import world_model
from codesign_jax.scene import InputError, Scene, keypaths, parameters, silicones
from codesign_jax.types import Status, Trial, failed
from scripts import calibration
from scripts.shared import output, provenance, work

DESIGNS = 30
TRIALS = 40
FEW = 16
"""Designs, trials of each, and trials of the dearest variants: the first ones."""
BITS = {str(b.name): b.value for b in Status if b.value}
SEED = 5
"""Seed of the trials; no search tested on it."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """One way to simulate the trials.

    Attributes:
      accuracy: Preset.
      changes: Further values, "table.key=value".
      moved: Whether the objects are displaced by a micrometre.
      drawn: Whether each trial has constants of its own, drawn from their calibrated range.
      few: Whether it is so dear that it has `FEW` trials.
      engine: Name of the engine.
      platform: The only platform of JAX that simulates it, such as "cpu"; empty for any.
    """

    accuracy: str = "standard"
    changes: tuple[str, ...] = ()
    moved: bool = False
    drawn: bool = False
    few: bool = False
    engine: str = "structured"
    platform: str = ""

    def scene(self) -> Scene:
        overrides = keypaths.parse(self.changes)
        return scene.load("paper", accuracy=self.accuracy, overrides=overrides)


def discretized(step: float, links: int, rings: int) -> tuple[str, ...]:
    """Changes to a time step [ms], links of a finger and rings of a link."""
    table = {"timestep": step * 1e-3, "links": links, "hull_rings": rings}
    return tuple(f"discretization.{key}={value:g}" for key, value in table.items())


TRUTH = discretized(2, 20, 4)
FINER = discretized(1, 30, 5)
SPHERES = "effects.surface=spheres"


def converged(*changes: str, **options: Any) -> Variant:
    """The paper's step and links with the solver's tolerance of 1e-6, and further changes."""
    return Variant(changes=(*changes, "newton.decrement=1e-6"), **options)


VARIANTS: dict[str, Variant] = {
    # The dearest first: the last process ends early.
    "truth": converged(*TRUTH),
    "finer": converged(*FINER, few=True),
    "reference": Variant("reference"),
    "truth, moved": converged(*TRUTH, moved=True, few=True),
    "fine": Variant("fine"),
    "standard": Variant(),
    "fast": Variant("fast"),
    "fast, moved": Variant("fast", moved=True),
    "1e-6": converged(),
    "1e-6, moved": converged(moved=True),
    # Beside a GPU's: what rounding otherwise flips, and the base of variants that CPUs ran.
    "1e-6, on CPUs": converged(platform="cpu"),
    "2 ms": converged("discretization.timestep=0.002"),
    "5 ms": converged("discretization.timestep=0.005"),
    "20 ms": converged("discretization.timestep=0.020"),
    "6 links": converged("discretization.links=6"),
    "20 links": converged("discretization.links=20"),
    "4 rings": converged("discretization.hull_rings=4"),
    "twice the stiffness": converged("contact.normal_stiffness=8000"),
    "half the dissipation": converged("contact.dissipation_time=0.003"),
    "air mass": converged("effects.air_mass=true"),
    "linear law": converged("hand.material.law=linear", "hand.material.shear_modulus=49.5e3"),
    # The end of the interval of Dragon Skin 10's modulus.
    "101 kPa": converged("hand.material.law=neo_hookean", "hand.material.shear_modulus=101e3"),
    "lateral threshold": converged("effects.lateral_threshold=true"),
    "spheres": converged(SPHERES),
    # On a machine with a GPU, MuJoCo C would be measured on the host's cores.
    "spheres, MuJoCo C": Variant(changes=(SPHERES,), few=True, engine="mujoco", platform="cpu"),
    "fingers pass each other": converged("effects.finger_finger=false"),
    "fingers pass the palm": converged("effects.finger_palm=false"),
    "fingers creep": converged("effects.friction_memory=false"),
    "fingers pass themselves": converged("effects.finger_itself=false"),
    "constants": converged(drawn=True),
    "4 iterations": converged("newton.iterations=4"),
    "Euler": converged("discretization.integrator=euler"),
    "4 rings, 1e-3": Variant(changes=discretized(10, 10, 4)),
    "5 ms, 3 rings, 1e-3": Variant(changes=discretized(5, 10, 3)),
}
TIMED = ("fast", "standard", "fine", "reference", "1e-6", "4 rings, 1e-3")
"""Variants whose time is measured, one after another."""
DEAR = ("reference",)
"""Those of which one call is timed."""


class Study:
    """Designs and trials, and what variants make of them."""

    def __init__(self, designs: np.ndarray, trials: int):
        """Keeps the designs, shape (design, 23), and the count of their trials."""
        self.trials = trials
        self.designs = designs

    def run(self, name: str, commit: str | None = None) -> dict[str, Any]:
        """Simulates a variant; what its file holds."""
        variant = VARIANTS[name]
        the_scene = variant.scene()
        call, took = self._call(variant, the_scene)
        start = time.perf_counter()
        outcome = jax.tree.map(np.asarray, call())
        seconds = time.perf_counter() - start
        shape = len(self.designs), self._trials(variant)
        lost = outcome.lost_time.reshape(shape)
        status = outcome.status.reshape(shape)
        bits = {n: int((status & b != 0).sum()) for n, b in BITS.items()}
        return {
            "variant": dataclasses.asdict(variant),
            "particles": shape[0],
            "trials": shape[1],
            "lost": encode(lost, failed(status), the_scene.window),
            "status": {n: count for n, count in bits.items() if count},
            "residual_quantiles": np.quantile(outcome.residual, [0.5, 0.9, 0.99]).tolist(),
            "compile_seconds": round(took, 1),
            "seconds": round(seconds, 2),
            "made": provenance.measurement(commit),
        }

    def rate(self, name: str) -> dict[str, float]:
        """Time of a variant's batch, the least of some calls, compiled before.

        Processor seconds are those of all threads: on a CPU they do not depend on what else the
        machine does.
        """
        variant = VARIANTS[name]
        call, _ = self._call(variant, variant.scene())
        seconds = []
        processor = []
        for _ in range(1 if name in DEAR else 3):
            start = time.perf_counter()
            spent = time.process_time()
            jax.block_until_ready(call())
            seconds.append(time.perf_counter() - start)
            processor.append(time.process_time() - spent)
        count = len(self.designs) * self._trials(variant)
        return {
            "grasps": count,
            "seconds": min(seconds),
            "grasps_per_s": count / min(seconds),
            "processor_seconds": min(processor),
        }

    def _trials(self, variant: Variant) -> int:
        return min(FEW, self.trials) if variant.few else self.trials

    def _call(self, variant: Variant, the_scene: Scene) -> tuple[Callable[[], Any], float]:
        """A function that simulates, compiled, and the time that this took [s]."""
        space = parameters.design_space(the_scene.hand)
        engine = make_engine(variant.engine, the_scene)
        count = self._trials(variant)
        drawn = rollout.sample_trials(the_scene, jax.random.key(SEED), count)
        drawn = work.nudged(drawn) if variant.moved else drawn
        designs, trials = crossed(self.designs, drawn)
        if variant.drawn:
            the_scene = calibrated(the_scene, count, len(self.designs))

        @jax.jit
        def run(designs: jax.Array, trials: Trial, numbers: Scene) -> Any:
            return rollout.simulate(numbers, engine, jax.vmap(space.params)(designs), trials)[0]

        arguments = jnp.asarray(designs, jnp.float32), trials, the_scene
        start = time.perf_counter()
        program = run.lower(*arguments).compile()
        return lambda: program(*arguments), time.perf_counter() - start


def crossed(designs: np.ndarray, drawn: Trial) -> tuple[np.ndarray, Trial]:
    """Every design in every trial, design by design."""
    count = drawn.yaw.shape[0]
    index = np.arange(len(designs) * count)
    return designs[index // count], jax.tree.map(lambda x: np.asarray(x)[index % count], drawn)


def calibrated(the_scene: Scene, trials: int, designs: int) -> Scene:
    """A scene with numbers of each world: a set for each trial, of those that are not ruled out."""
    sets = calibration.remaining_sets()
    rows = np.random.default_rng(SEED).permutation(len(sets))[np.arange(trials) % len(sets)]
    numbers = calibration.numbers(the_scene, calibration.values(sets[rows]))
    index = np.tile(np.arange(trials), designs)
    return jax.tree.map(lambda v: jnp.asarray(v[index] if np.ndim(v) else v, jnp.float32), numbers)


KEPT = 255
FAILED = 254
_PARTS = 250
"""Marks in place of the time of loss: kept to the end, and failed; parts of the time."""


def encode(lost: np.ndarray, bad: np.ndarray, window: tuple[float, float]) -> str:
    """Times of loss as text: a byte a trial, compressed, in base 64."""
    start, end = window
    share = np.clip((np.where(np.isfinite(lost), lost, end) - start) / (end - start), 0, 1)
    code = np.where(np.isfinite(lost), np.round(_PARTS * share), KEPT)
    code = np.where(bad, FAILED, code).astype(np.uint8)
    return base64.b64encode(zlib.compress(code.tobytes(), 9)).decode()


def costs(the_scene: Scene, record: dict[str, Any]) -> np.ndarray:
    """Costs of a record's trials, shape (design, trial); NaN where a trial failed."""
    code = np.frombuffer(zlib.decompress(base64.b64decode(record["lost"])), np.uint8)
    code = code.reshape(record["particles"], record["trials"])
    cost = np.where(code == KEPT, 0.0, the_scene.cost.maximum * (1 - code / _PARTS))
    return np.where(code == FAILED, np.nan, cost)


def path_of(folder: Path, name: str) -> Path:
    return folder / f"{''.join(c if c.isalnum() or c in '.-' else '_' for c in name)}.json"


def of_platform(names: list[str]) -> list[str]:
    """The variants that this platform simulates; says which ones it leaves out."""
    here = jax.devices()[0].platform
    kept = [n for n in names if VARIANTS[n].platform in ("", here)]
    for name in names:
        if name not in kept:
            print(f"{name}: only with JAX_PLATFORMS={VARIANTS[name].platform}", flush=True)
    return kept


def simulate(study: Study, names: list[str], folder: Path, commit: str | None) -> None:
    """Simulates the variants of this platform that have no file yet."""
    missing = [n for n in of_platform(names) if not path_of(folder, n).exists()]
    for name in missing:
        try:
            record = study.run(name, commit)
        except InputError as error:  # an effect that the surface does not have: a result as well
            record = {"variant": dataclasses.asdict(VARIANTS[name]), "refused": str(error)}
        output.write_json(path_of(folder, name), {"name": name, **record})
        print(f"{name}: {record.get('seconds', record.get('refused'))} s", flush=True)
        jax.clear_caches()


def measure(study: Study, names: list[str], folder: Path, commit: str | None) -> None:
    """Measures rates, one variant after another; a kind of device has a file of its own."""
    path = folder / f"times_{jax.devices()[0].platform}.json"
    measured = json.loads(path.read_text()) if path.exists() else {"rates": {}}
    missing = [n for n in of_platform(names) if n not in measured["rates"]]
    for name in missing:
        measured["rates"][name] = study.rate(name)
        measured["made"] = provenance.measurement(commit)
        output.write_json(path, measured)
        print(f"{name}: {measured['rates'][name]['grasps_per_s']:.0f} grasps/s", flush=True)


def merge(folder: Path) -> dict[str, Any]:
    every = {name: path_of(folder, name) for name in VARIANTS}
    times = {p.stem.split("_")[1]: json.loads(p.read_text()) for p in folder.glob("times_*.json")}
    content: dict[str, Any] = {
        "variants": {n: json.loads(p.read_text()) for n, p in every.items() if p.exists()},
        "rates": times,
    }
    if (path := folder / "tips.json").exists():
        content["tips"] = json.loads(path.read_text())
    return content


# --- finger tips in the air -----------------------------------------------------------------------

# A quick grasp in the air: the arm comes down in 0.3 s, the fingers are inflated in the next 0.3 s,
# and the hand is shaken. Nothing touches, and no world ends early.
IN_THE_AIR = {
    "effects": {
        **dict.fromkeys(("finger_finger", "finger_itself", "finger_palm"), False),
        **dict.fromkeys(("finger_object", "finger_table"), False),
        **dict.fromkeys(("palm_object", "palm_table", "ungrasp"), False),
    },
    "phases": {"approach": 0.3, "inflate": 0.6, "lift": 0.9, "disturb": 2.4, "ungrasp": 3.0},
    "cost": {"lost_distance": 1.0},
}
EVERY = 0.02
"""Time between compared states [s]: a multiple of every time step."""
HANDS = 12
SECONDS = 2.4
REFERENCE = (1e-4, 40, "newmark")
"""Time step [s], links and integrator of the motion that stands for the truth, by MuJoCo C."""


def motion(
    setting: tuple[float, int, str], engine: str = "structured", hands: int = HANDS,
    seconds: float = SECONDS,
) -> np.ndarray:  # fmt: skip
    """Tips of hands in the air [m], shape (hand, time, finger, 3), every `EVERY` from the start."""
    step, links, integrator = setting
    sizes = {"timestep": step, "links": links, "integrator": integrator}
    # MuJoCo C has no softening wall: under the linear law both engines solve the same equations.
    the_scene = silicones.under(
        scene.load("paper", overrides={**IN_THE_AIR, "discretization": sizes}), neo_hookean=False
    )
    stride = round(EVERY / step)
    count = round(seconds / step)
    params = work.hands(the_scene, hands)
    drawn = rollout.sample_trials(the_scene, jax.random.key(work.SEED), work.TRIALS)
    with jax.enable_x64(engine == "mujoco"):
        float_type = np.float64 if engine == "mujoco" else np.float32
        trials = jax.tree.map(lambda x: np.asarray(x)[np.arange(hands) % work.TRIALS], drawn)
        cast = lambda x: np.asarray(x).astype(float_type) if x.dtype.kind == "f" else x  # noqa: E731
        inputs = work.inputs(the_scene, work.Worlds(*jax.tree.map(cast, (params, trials))))
        fields, ctrl = jax.tree.map(np.asarray, inputs)
        ctrl = ctrl[:, :count]
        if engine != "mujoco":
            run = jax.jit(
                lambda f, c: make_engine(engine, the_scene).rollout(f, c, trajectory=True).qpos
            )
            qpos = np.asarray(run(fields, ctrl)[:, ::stride], np.float64)

    def of_world(world: int) -> np.ndarray:
        compiled = world_model(the_scene, jax.tree.map(lambda x: x[world], fields))
        if engine != "mujoco":
            return np.array([tips(the_scene, compiled, state) for state in qpos[world]])
        # The object on the table is the only contact: without it there is nothing to solve.
        compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data = mujoco.MjData(compiled)
        positions = []
        data.qpos[:] = fields.start[world]
        for k in range(ctrl.shape[1]):
            if k % stride == 0:
                positions.append(tips(the_scene, compiled, data.qpos))
            data.ctrl[:] = ctrl[world, k]
            mujoco.mj_step(compiled, data)
        return np.array(positions)

    return np.array(_each(of_world, hands))


def _each(function: Callable[[int], Any], count: int) -> list[Any]:
    """Results of worlds in threads: MuJoCo frees Python's lock."""
    with ThreadPoolExecutor(min(len(os.sched_getaffinity(0)), count)) as pool:
        return list(pool.map(function, range(count)))


def tips(the_scene: Scene, compiled: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Finger tips of a state [m], shape (finger, 3), on the bottom layer."""
    data = mujoco.MjData(compiled)
    last = model.layout(the_scene).bodies[:, -1]
    data.qpos[:] = qpos
    mujoco.mj_kinematics(compiled, data)
    # A half segment follows the last joint; its centre of mass lies halfway along it.
    along = 2 * compiled.body_ipos[last, 0]
    return data.xpos[last] + data.xmat[last].reshape(-1, 3, 3)[:, :, 0] * along[:, None]


def error(simulated: np.ndarray, exact: np.ndarray) -> float:
    """Root mean square distance of tips [mm]."""
    return float(1e3 * np.sqrt((np.linalg.norm(simulated - exact, axis=-1) ** 2).mean()))


def measure_tips(folder: Path, commit: str | None) -> None:
    """Writes the error of every variant's step, links and damping to tips.json."""
    named = {}
    for name, variant in VARIANTS.items():
        settings = variant.scene().discretization
        named[name] = (settings.timestep, settings.links, settings.integrator)
    exact = motion(REFERENCE, "mujoco")
    errors = {s: error(motion(s), exact) for s in dict.fromkeys(named.values())}
    content = {"tip_rms_mm": {n: errors[s] for n, s in named.items()}}
    output.write_json(folder / "tips.json", content | {"made": provenance.measurement(commit)})
