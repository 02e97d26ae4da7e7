"""What moves a verdict in the default scene: numerics, models, constants; presets beside the truth.

python -m scripts.accuracy.budget --data runs/paper --out runs/budget              # again to resume
python -m scripts.accuracy.budget --data runs/paper --out runs/budget --share 1/8  # beside 7 others
python -m scripts.accuracy.budget --data runs/paper --out runs/budget --time  # then: rates, alone
python -m scripts.accuracy.budget --out runs/budget --tip              # errors of the finger tip
python -m scripts.accuracy.budget --out runs/budget --merge docs/data/budget.json
python -m scripts.accuracy.budget --merge docs/data/budget.json --report

With --page docs/accuracy.md and --figure docs/figures/budget.png the report fills in the page's
tables and draws that figure, and beside it accuracy_time.png.

All variants have the same designs, in which the concurrent runs of --data ended, one of each, and
the same trials.  The truth has the finer step, links and mesh; `finer` refines all three again.  A
variant has a file of its own, so that several processes share the work; each compiles its own
program, which is the host's work.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import rollout, scene, use_compilation_cache
from codesign_jax.engines import make_engine
from codesign_jax.scene import InputError, Scene, keypaths, parameters
from codesign_jax.types import Status, Trial, failed
from scripts.accuracy import decision, study, tip, worlds
from scripts.accuracy.settings import Setting
from scripts.shared import output, provenance, sets, work

DESIGNS, TRIALS, FEW = 30, 40, 16
"""Designs, trials of each, and trials of the dearest variants: the first ones."""
BITS = {str(b.name): b.value for b in Status if b.value}
CALIBRATED = Path("docs/data/calibration/palm_scores.npz")
"""Sets of constants, of which those that no target ruled out are drawn."""


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
    """

    accuracy: str = "standard"
    changes: tuple[str, ...] = ()
    moved: bool = False
    drawn: bool = False
    few: bool = False
    engine: str = "structured"

    def scene(self, more: tuple[str, ...] = ()) -> Scene:
        """The default scene so changed."""
        overrides = keypaths.parse([*self.changes, *more])
        return scene.load("paper", accuracy=self.accuracy, overrides=overrides)

    def in_the_air(self) -> Setting:
        """Step, links and damping; without contact skin, solver and engine do not matter."""
        found = self.scene().discretization
        step = round(1e3 * found.timestep, 6)
        return Setting(timestep=step, links=found.links, damping=found.spring_damping)


def discretized(step: float, links: int, rings: int, points: int) -> tuple[str, ...]:
    """Changes to a time step [ms], links of a finger and the mesh of a link, springs damped least.

    Args:
      step: Time step [ms].
      links: Links of a finger.
      rings: Rings of vertices a link.
      points: Vertices of a ring.
    """
    table = {"timestep": step * 1e-3, "links": links, "hull_rings": rings, "hull_points": points}
    found = [f"discretization.{key}={value:g}" for key, value in table.items()]
    return (*found, "discretization.spring_damping=least")


TRUTH, FINER = discretized(2, 20, 4, 16), discretized(1, 30, 5, 20)
LOOSE = ("newton.decrement=1e-3", "newton.iterations=24")
"""A looser tolerance of the contact solver, in place of fewer iterations."""
LEAST = "discretization.spring_damping=least"
SPHERES = "effects.surface=spheres"
VARIANTS: dict[str, Variant] = {
    # The dearest first: the last process ends early.
    "truth": Variant(changes=TRUTH),
    "finer": Variant(changes=FINER, few=True),
    "reference": Variant("reference"),
    "truth, moved": Variant(changes=TRUTH, moved=True, few=True),
    "fine": Variant("fine"),
    "standard": Variant(),
    "fast": Variant("fast"),
    "fine, moved": Variant("fine", moved=True),
    "standard, moved": Variant(moved=True),
    "fast, moved": Variant("fast", moved=True),
    # Beside a GPU's: what rounding otherwise flips, and the base of variants that CPUs ran.
    "standard, on CPUs": Variant(),
    "2 ms": Variant(changes=("discretization.timestep=0.002",)),
    "5 ms": Variant(changes=("discretization.timestep=0.005",)),
    "20 links": Variant(changes=("discretization.links=20",)),
    "4 x 16": Variant(changes=("discretization.hull_rings=4", "discretization.hull_points=16")),
    "neo-Hookean": Variant(changes=("effects.neo_hookean=true",)),
    "lateral threshold": Variant(changes=("effects.lateral_threshold=true",)),
    "soft touch": Variant(changes=("effects.soft_touch=true",)),
    "spheres": Variant(changes=(SPHERES,)),
    "spheres, MuJoCo C": Variant(changes=(SPHERES,), few=True, engine="mujoco"),
    "fingers pass each other": Variant(changes=("effects.finger_finger=false",)),
    "fingers pass the palm": Variant(changes=("effects.finger_palm=false",)),
    "fingers creep": Variant(changes=("effects.friction_memory=false",)),
    "palm once inside": Variant(changes=("effects.speculative_palm=false",)),
    "constants": Variant(drawn=True),
    "4 iterations": Variant(changes=("newton.iterations=4",)),
    "1e-3": Variant(changes=LOOSE),
    "least, 1e-3": Variant(changes=(LEAST, *LOOSE)),
    "5 ms, least, 1e-3": Variant("fine", changes=LOOSE),
    "least": Variant(changes=(LEAST,)),
    "4 x 16, least, 1e-3": Variant(changes=(*discretized(10, 10, 4, 16), *LOOSE)),
    "5 ms, 3 x 12, least, 1e-3": Variant(changes=(*discretized(5, 10, 3, 12), *LOOSE)),
}
TIMED = (
    *("fast", "standard", "fine", "reference", "least, 1e-3", "5 ms, least, 1e-3"),
    *("4 x 16, least, 1e-3", "spheres", "spheres, MuJoCo C"),
)
"""Variants whose rate is measured, one after another."""
DEAR = ("reference", "spheres, MuJoCo C")
"""Those of which one call is timed."""


class Study:
    """Designs and trials, and what variants make of them."""

    def __init__(self, args: argparse.Namespace):
        """Reads the designs."""
        self.args, self.more = args, tuple(args.set)
        self.designs = decision.populations(args.data, args.designs)["late"]
        self.compiled: dict[str, Any] = {}

    def run(self, name: str) -> dict[str, Any]:
        """Simulates a variant; what its file holds."""
        variant = VARIANTS[name]
        the_scene = variant.scene(self.more)
        call, took = self._call(name, variant, the_scene)
        start = time.perf_counter()
        outcome = jax.tree.map(np.asarray, call())
        seconds = time.perf_counter() - start
        shape = len(self.designs), self._trials(variant)
        lost, status = outcome.lost_time.reshape(shape), outcome.status.reshape(shape)
        bits = {n: int((status & b != 0).sum()) for n, b in BITS.items()}
        return {
            "variant": dataclasses.asdict(variant),
            "particles": shape[0],
            "trials": shape[1],
            "lost": decision.encode(lost, failed(status), the_scene.window),
            "status": {n: count for n, count in bits.items() if count},
            "residual_quantiles": np.quantile(outcome.residual, [0.5, 0.9, 0.99]).tolist(),
            "compile_seconds": round(took, 1),
            "seconds": round(seconds, 2),
            "made": provenance.measurement(self.args.commit),
        }

    def rate(self, name: str) -> dict[str, float]:
        """Grasps a second of a variant, the best of some calls, compiled before."""
        variant = VARIANTS[name]
        call, _ = self._call(name, variant, variant.scene(self.more))
        seconds = []
        for _ in range(1 if name in DEAR else 3):
            start = time.perf_counter()
            jax.block_until_ready(call())
            seconds.append(time.perf_counter() - start)
        count = len(self.designs) * self._trials(variant)
        return {"grasps": count, "seconds": min(seconds), "grasps_per_s": count / min(seconds)}

    def _trials(self, variant: Variant) -> int:
        return min(FEW, self.args.trials) if variant.few else self.args.trials

    def _call(self, name: str, variant: Variant, the_scene: Scene) -> tuple[Any, float]:
        """A function that simulates, compiled, and the time that this took [s]."""
        space = parameters.design_space(the_scene.hand)
        engine, count = make_engine(variant.engine, the_scene), self._trials(variant)
        drawn = worlds.trials(the_scene, count, seed=decision.SEED)
        drawn = work.nudged(drawn) if variant.moved else drawn
        designs, trials = crossed(self.designs, drawn)
        constants = calibrated(the_scene, count, len(self.designs)) if variant.drawn else None

        @jax.jit
        def run(designs: jax.Array, trials: Trial, constants: Any) -> Any:
            params = jax.vmap(space.params)(designs)
            return rollout.simulate(the_scene, engine, params, trials, constants=constants)[0]

        arguments = jnp.asarray(designs, jnp.float32), trials, constants
        start = time.perf_counter()
        program = run.lower(*arguments).compile()
        return lambda: program(*arguments), time.perf_counter() - start


def crossed(designs: np.ndarray, drawn: Trial) -> tuple[np.ndarray, Trial]:
    """Every design in every trial, design by design."""
    count = drawn.yaw.shape[0]
    index = np.arange(len(designs) * count)
    return designs[index // count], jax.tree.map(lambda x: x[index % count], drawn)


def calibrated(the_scene: Scene, trials: int, designs: int) -> Any:
    """Constants of each world: a set for each trial, drawn from those that no target ruled out.

    Args:
      the_scene: The scene, which has the other numbers.
      trials: Trials of a design.
      designs: Designs, which meet the same sets.
    """
    with np.load(CALIBRATED) as file:
        left = file["units"][sets.plausible(file["distances"])]
    rows = np.random.default_rng(decision.SEED).permutation(len(left))[
        np.arange(trials) % len(left)
    ]
    numbers = sets.numbers(the_scene, sets.values(left[rows]))
    index = np.tile(np.arange(trials), designs)
    return jax.tree.map(lambda v: jnp.asarray(v[index] if np.ndim(v) else v, jnp.float32), numbers)


def path_of(folder: Path, name: str) -> Path:
    """File of a variant."""
    words = "".join(c if c.isalnum() or c in ".-" else "_" for c in name)
    return folder / f"{words}.json"


def simulate(args: argparse.Namespace) -> None:
    """Simulates the variants of this process that have no file yet."""
    first, count = (int(n) for n in args.share.split("/"))
    names = [n for n in VARIANTS if not args.only or n in args.only.split(";")][first - 1 :: count]
    left, the_study = [n for n in names if not path_of(args.out, n).exists()], None
    for name in left:
        the_study = the_study or Study(args)
        try:
            found = the_study.run(name)
        except InputError as error:  # an effect that the surface does not have: a result as well
            found = {"variant": dataclasses.asdict(VARIANTS[name]), "refused": str(error)}
        output.write_json(path_of(args.out, name), {"name": name, **found})
        print(f"{name}: {found.get('seconds', found.get('refused'))} s, ", end="")
        print(f"compiled in {found.get('compile_seconds', 0)} s", flush=True)
        jax.clear_caches()


def measure(args: argparse.Namespace) -> None:
    """Measures rates, one variant after another; a machine has a file of its own."""
    the_study, name = Study(args), jax.devices()[0].platform
    path = args.out / f"times_{name}.json"
    found = json.loads(path.read_text()) if path.exists() else {"rates": {}}
    for variant in args.only.split(";") if args.only else TIMED:
        if variant not in found["rates"]:
            found["rates"][variant] = the_study.rate(variant)
            found["made"] = provenance.measurement(args.commit)
            output.write_json(path, found)
            print(f"{variant}: {found['rates'][variant]['grasps_per_s']:.0f} grasps/s", flush=True)


def measure_tips(args: argparse.Namespace) -> None:
    """Measures errors of the finger tip in a fast motion in the air, against MuJoCo C."""
    size, settings = study.SIZES["full"], {n: v.in_the_air() for n, v in VARIANTS.items()}
    exact = tip.motion(study.reference(size), size.hands, size.seconds)
    found = {s: tip.motion(s, size.hands, size.seconds) for s in dict.fromkeys(settings.values())}
    errors = {s: tip.compare(tips, exact)["tip_rms_mm"] for s, tips in found.items()}
    named = {name: errors[setting] for name, setting in settings.items()}
    made = provenance.measurement(args.commit)
    output.write_json(args.out / "tips.json", {"tip_rms_mm": named, "made": made})


def merged(folder: Path) -> dict[str, Any]:
    """The files of all variants in one."""
    every = {name: path_of(folder, name) for name in VARIANTS}
    found: dict[str, Any] = {
        "variants": {n: json.loads(p.read_text()) for n, p in every.items() if p.exists()},
        "rates": {
            p.stem.split("_")[1]: json.loads(p.read_text()) for p in folder.glob("times_*.json")
        },
    }
    if (path := folder / "tips.json").exists():
        found["tips"] = json.loads(path.read_text())
    return found


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = provenance.parser(__doc__)
    parser.add_argument("--data", type=Path, default=Path("docs/data/experiments"))
    parser.add_argument("--out", type=Path, default=Path("runs/budget"), help="folder of the files")
    parser.add_argument("--designs", type=int, default=DESIGNS)
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--share", default="1/1", metavar="I/N", help="every N-th variant")
    parser.add_argument("--only", default="", help="these variants, with ; between")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--time", action="store_true", help="measure rates")
    parser.add_argument("--tip", action="store_true", help="measure errors of the finger tip")
    parser.add_argument("--merge", type=Path, help="write the files into this one and stop")
    parser.add_argument("--report", action="store_true", help="show the tables of --merge and stop")
    parser.add_argument("--page", type=Path, help="page whose tables are filled in")
    parser.add_argument("--figure", type=Path, help="file of the first figure")
    args = parser.parse_args()
    use_compilation_cache()
    if args.report:
        from scripts.accuracy import against_time, budget_report

        found = budget_report.Budget(json.loads(args.merge.read_text()))
        if args.figure:
            print(against_time.make(found, args.figure.with_name("accuracy_time.png")))
        return budget_report.make(found, args.page, args.figure)
    if args.merge:
        output.write_json(args.merge, merged(args.out), indent=None)
        return 0
    args.out.mkdir(parents=True, exist_ok=True)
    (measure_tips if args.tip else measure if args.time else simulate)(args)
    return 0


if __name__ == "__main__":
    sys.exit(main())
