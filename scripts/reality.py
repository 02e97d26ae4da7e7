"""The simulation beside published measurements: python -m scripts.reality [--set KEY=VALUE ...].

Releases the Dragon Skin 10 beam of docs/data/measured.toml in engine structured at three time
steps, bends walls by both laws beside measured silicones, and presses on the default finger's tip;
prints the tables of docs/reality.md and docs/measurements.md and draws docs/figures/reality_*.png.
--set changes values of the beam's scene, such as discretization.integrator=euler; --pages
fills the tables into the pages.  A minute of one core.
"""

import dataclasses
import math
import sys
import tomllib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import finger as fingers
from codesign_jax import model, rollout, scene
from codesign_jax.engines import make_engine
from codesign_jax.scene import InputError, Scene, beams, hand, keypaths, parameters, silicones
from codesign_jax.types import Params
from scripts.shared import output, provenance

DOCS = Path(__file__).parents[1] / "docs"
MEASURED = DOCS / "data" / "measured.toml"
TENSION = DOCS / "data" / "silicones.csv"
STEPS = (0.010, 0.005, 0.001)
"""Time steps at which the beam is released [s]."""
DURATION = 2.6
"""Time that the beam swings, as measured [s]."""
BARE = "finger_object palm_object finger_table palm_table lateral_bending twist wrist ungrasp"
BARE += " finger_finger finger_palm finger_itself friction_memory disturb"
"""Effects without which a finger is a beam in the air on a fixed base."""


def measurements() -> dict[str, Any]:
    """The tables of docs/data/measured.toml."""
    return tomllib.loads(MEASURED.read_text(encoding="utf-8"))


# --- a beam that is released ----------------------------------------------------------------------


def beam_scene(beam: Mapping[str, Any], timestep: float, changes: Mapping[Any, Any]) -> Scene:
    """A scene in which a finger is the beam: horizontal, on a fixed base, and touching nothing.

    A finger's section is hollow and bends about its bottom layer.  The walls leave a chamber of
    0.02 mm; the modulus is the one with which this finger has the beam's E I, so that the law is
    linear.  Shear, which a chain of hinges lacks, lowers that E I by the share that it has in the
    beam's deflection by a load at its tip.
    """
    overrides = {"effects.surface": "spheres", "discretization.timestep": timestep}
    overrides |= {f"effects.{name}": False for name in BARE.split()}
    overrides |= {"phases.approach": 0.1, "phases.inflate": 0.2, "phases.lift": DURATION}
    base = scene.load(
        "paper", overrides={**overrides, "hand.material": "dragon_skin_10", **changes}
    )
    rubber = base.hand.material
    height = beam["height"]
    slender = beam["height"] / beam["length"]
    bending = 3 * rubber.shear_modulus * beam["width"] * height**3 / 12 / (1 + 0.9 * slender**2)
    solid = beams.beam(height, wall(beam), width=beam["width"], shear_modulus=1.0, density=1.0)
    material = dataclasses.replace(
        rubber,
        shear_modulus=bending / float(solid.bending),
        density=beam["density"],
        law="linear",
        silicone=None,
    )
    mount = hand.Finger(azimuth=0.0, spread=0.0, tilt=0.0, radius=0.0)
    section = hand.Section(width=beam["width"])
    beam_hand = dataclasses.replace(base.hand, finger=(mount,), section=section, material=material)
    effects = dataclasses.replace(base.effects, neo_hookean=False)
    return dataclasses.replace(base, hand=beam_hand, effects=effects)


def wall(beam: Mapping[str, Any]) -> float:
    """Wall of a finger that is as good as solid [m]."""
    return beam["height"] / 2 - 1e-5


def released(beam: Mapping[str, Any], beam_scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Times [s], shape (time,), and drops of the tip with each weight [m], shape (weight, time).

    The weight is a point mass at the tip face, added to the chain's last body; the masses of all
    bodies lie on the line of the hinges, which stands for the beam's middle.
    """
    ones = np.ones(1)
    params = Params(
        beam["length"] * ones, height=beam["height"] * ones, wall=wall(beam) * ones,
        spread=np.zeros(()), arm=np.zeros(6), pressure=0 * ones,
    )  # fmt: skip
    trial = rollout.nominal_trial(beam_scene)
    fields = jax.jit(model.model_fields, static_argnums=0)(beam_scene, params, trial)
    lay = model.layout(beam_scene)
    worlds = jax.tree.map(lambda v: jnp.stack([v] * len(beam["weight"])), fields)
    loads = np.array(beam["weight"]) / beam_scene.gravity
    worlds = _weighted(worlds, beam["length"] / lay.links / 2, loads)
    steps = round(DURATION / beam_scene.discretization.timestep)
    ctrl = np.zeros((len(loads), steps, 7), np.float32)
    ctrl[:, :, 2] = beam_scene.arm.start_height
    engine = make_engine("structured", beam_scene)
    trace = jax.jit(partial(engine.rollout, trajectory=True))(worlds, jnp.asarray(ctrl))
    start = np.asarray(fields.qpos)
    bends = np.asarray(trace.qpos)[..., np.flatnonzero(_finger_joints(start, lay))]
    direction = np.cumsum(bends, -1)
    reach = beam["length"] / lay.links * np.append(np.ones(lay.links - 1), 0.5)
    time = (np.arange(steps) + 1) * beam_scene.discretization.timestep
    return time, np.abs((reach * np.sin(direction)).sum(-1))


def _finger_joints(start: np.ndarray, lay: Any) -> np.ndarray:
    """Which numbers of qpos are bends of the finger."""
    bends = np.zeros(len(start), bool)
    bends[np.asarray(lay.dofs).ravel()] = True
    return bends


def _weighted(fields: Any, extent: float, loads: np.ndarray) -> Any:
    """Fields with point masses [kg] at the end of the last body, `extent` [m] from its joint."""
    centres = np.array(fields.centre)
    centres[..., 1] = 0.0
    mass = np.array(fields.mass)
    inertia = np.array(fields.inertia)
    link_mass = mass[:, 0, -1].copy()
    along = centres[:, 0, -1, 0]
    centre = (link_mass * along + loads * extent) / (link_mass + loads)
    more = link_mass * (centre - along) ** 2 + loads * (extent - centre) ** 2
    inertia[:, 0, -1, 1:] += more[:, None]
    mass[:, 0, -1] += loads
    centres[:, 0, -1, 0] = centre
    return fields._replace(mass=mass, inertia=inertia, centre=centres)


class Ring(NamedTuple):
    """How a beam swings about its rest: drop [m], period [s] and logarithmic decrement."""

    drop: float
    period: float
    decrement: float

    @classmethod
    def of(cls, time: np.ndarray, drop: np.ndarray) -> "Ring":
        """From peaks 1 to 4 about the rest of the last half second, by parabolas.

        With fewer peaks by those that there are; period and decrement are NaN with one or none.
        """
        rest = drop[time > time[-1] - 0.5].mean()
        x = drop - rest
        h = time[1] - time[0]
        inner = np.flatnonzero((x[1:-1] > x[:-2]) & (x[1:-1] >= x[2:]) & (x[1:-1] > 0)) + 1
        inner = inner[x[inner] > 1e-3 * x.max()][:4]
        if len(inner) < 2:
            return cls(float(rest), math.nan, math.nan)
        second = (x[inner - 1] - 2 * x[inner] + x[inner + 1]) / 2
        slope = (x[inner + 1] - x[inner - 1]) / 2
        at = time[inner] - slope / (2 * second) * h
        peak = x[inner] - slope**2 / (4 * second)
        count = len(inner) - 1
        return cls(float(rest), (at[-1] - at[0]) / count, float(np.log(peak[0] / peak[-1])) / count)


def beam_rows(rings: Mapping[str, Sequence[Ring]], beam: Mapping[str, Any]) -> list[list[str]]:
    """The table of a beam's rests and swings: what was measured, then what was simulated."""
    columns = [
        "drop mm",
        "drop / drop without weight",
        "period s",
        "period / period without weight",
        "decrement",
    ]
    rows = [["", *columns]]
    measured_rings = [
        Ring(1e-3 * d, p, q) for d, p, q in zip(*(beam[k] for k in Ring._fields), strict=True)
    ]
    for name, each in {"measured": measured_rings, **rings}.items():
        cells = [name]
        for values, form in (
            ([1e3 * r.drop for r in each], "{:.1f}"),
            ([r.drop / each[0].drop for r in each], "{:.2f}"),
            ([r.period for r in each], "{:.3f}"),
            ([r.period / each[0].period for r in each], "{:.2f}"),
            ([r.decrement for r in each], "{:.2f}"),
        ):
            cells.append(", ".join("–" if math.isnan(v) else form.format(v) for v in values))
        rows.append(cells)
    return rows


# --- bending laws and silicones -------------------------------------------------------------------

HEIGHT = 20.0
WIDTH = 24.0
WALL = 5.0
"""Section of the default finger [mm]."""
STRAINS = np.array([0.25, 0.5, 0.75, 1.0, 1.25, 1.5])


def moment(stress: Any, strain: float) -> float:
    """Moment of the section about its bottom layer, up to a factor, from a stress of a strain."""
    height = (np.arange(2000) + 0.5) / 2000 * HEIGHT
    edge = (height < WALL) | (height > HEIGHT - WALL)
    breadth = np.where(edge, WIDTH, 2 * WALL)
    return float((stress(strain * height / HEIGHT) * breadth * height).mean())


def linear(strain: Any) -> Any:
    """Stress in plane strain over G."""
    return 4 * strain


def neo_hookean(strain: Any) -> Any:
    """Stress in plane strain over G."""
    return (1 + strain) - (1 + strain) ** -3


LAWS = {silicones.LINEAR: linear, silicones.NEO_HOOKEAN: neo_hookean}


def fitted_law(stress: Any, law: Any, strains: np.ndarray) -> tuple[float, np.ndarray]:
    """Modulus with which a law's moments fit best those of a stress, and what the law errs by.

    Moments fit by the mean of their logarithms, so that the ratio of two laws' moduli is the same
    for every material: `silicones.EQUAL_BEND` over all of `STRAINS`.  The errors are those of the
    curvature under the same moment, at the outermost fibre's strains.
    """
    stress_moments = np.array([moment(stress, e) for e in strains])
    grid = np.linspace(0.01, 4, 600)
    moments = np.array([moment(law, e) for e in strains])
    modulus = float(np.exp(np.log(stress_moments / moments).mean()))
    bent = np.interp(stress_moments, modulus * np.array([moment(law, e) for e in grid]), grid)
    return modulus, bent / strains - 1


def tension() -> dict[str, Any]:
    """Stress in plane strain [kPa] as a function of strain, of the silicones that were pulled.

    Of a strain energy that depends on I1 alone: w' = tension/(2 (l - l^-2)) at the stretch l that
    has the I1 of a fibre of the wall, whose stress is 2 w' (s - s^-3) at its own stretch s.
    """
    text = [line for line in TENSION.read_text().splitlines() if not line.startswith("#")]
    names = text[0].split(",")[1:]
    table = np.array([r.split(",") for r in text[1:]], float)
    stretch = np.linspace(1.0, 3.0, 2001)[1:]
    first = stretch**2 + 2 / stretch
    stresses = {}
    for k, name in enumerate(names):
        pulled = np.interp(stretch - 1, [0, *table[:, 0]], [0, *table[:, k + 1]])
        slope = pulled / (stretch - stretch**-2)

        def stress(strain: Any, slope: np.ndarray = slope) -> Any:
            s = 1 + strain
            return np.interp(s**2 + 1 + s**-2, first, slope) * (s - s**-3)

        stresses[name] = stress
    return stresses


def plane_strain() -> Any:
    """Measured stress in plane strain [kPa] of Ecoflex 00-30 as a function of strain."""
    table = measurements()["plane_strain"]
    return lambda strain: np.interp(strain, [0, *table["strain"]], [0, *table["stress"]])


def law_rows() -> list[list[str]]:
    """The table of both laws' errors beside each measured silicone."""
    rows = [["silicone", "law", "G kPa", *(f"{100 * e:.0f} %" for e in STRAINS)]]
    curves = {f"{name}, tension": (stress, STRAINS) for name, stress in tension().items()}
    curves["**Ecoflex 00-30, plane strain**"] = (plane_strain(), STRAINS[:-1])
    for name, (stress, strains) in curves.items():
        for law, of in LAWS.items():
            modulus, errors = fitted_law(stress, of, strains)
            cells = [f"{100 * e:+.0f}".replace("-", "−") for e in errors]
            words = law.replace("neo_hookean", "neo-Hookean")
            rows.append([name, words, f"{modulus:.3g}", *cells, *["–"] * (6 - len(cells))])
    return rows


def silicone_rows() -> list[list[str]]:
    """The table of the silicones that `material` of a hand file may name."""
    head = ["`material`", "G kPa", "interval kPa", "crosshead, data sheet kPa", "kg/m³"]
    rows = [[*head, "damping ms", "source of G and interval"]]
    for key, s in silicones.SILICONES.items():
        span = s.damping_interval
        damping = f"{1e3 * s.damping_time:g}, {s.damping_kind}"
        if span:
            damping += f" {1e3 * span[0]:.1f} to {1e3 * span[1]:.1f}"
        low, high = (1e-3 * v for v in s.interval)
        others = f"{1e-3 * s.crosshead_modulus:.3g}, {1e-3 * s.sheet_modulus:.3g}"
        cells = [f"`{key}`", f"{1e-3 * s.shear_modulus:.3g}", f"{low:.3g} to {high:.3g}", others]
        rows.append([*cells, f"{s.density:g}", damping, s.source])
    return rows


# --- the default finger's tip ---------------------------------------------------------------------


def tip_stiffness(pressures: Sequence[float]) -> list[list[str]]:
    """The table of the default finger's force on a plate at its tip, and of its fall with a gap.

    The tip is held at the height of its base, across the finger; then the plate gives way a little.
    """
    default = scene.load("paper")
    space = parameters.design_space(default.hand)
    mine = fingers.of_design(default, space.params(np.asarray(space.default())), 0)
    rows = [
        ["pressure kPa", "free bend °", "force on the plate N", "loss of force per opening N/m"]
    ]
    blocked = fingers.Rest(np.zeros(mine.links), 0.0, 0.0)
    for pressure in pressures:
        free = fingers.Rest.of(mine, 1e3 * pressure)
        blocked = fingers.Rest.of(mine, 1e3 * pressure, held=True, start=blocked)
        less = fingers.Rest.of(mine, 1e3 * pressure, 0.99 * blocked.force, start=blocked)
        numbers = math.degrees(free.angles.sum()), blocked.force, 0.01 * blocked.force / less.height
        forms = ("{:.0f}", "{:.2f}", "{:.0f}")
        cells = [form.format(v) for form, v in zip(forms, numbers, strict=True)]
        rows.append([f"{pressure:g}", *cells])
    return rows


# --- figures and pages ----------------------------------------------------------------------------


def draw_beam(curves: Mapping[str, tuple], beam: Mapping[str, Any], folder: Path) -> Path:
    """Simulated drops over time, and the measured rests, envelopes and periods."""
    figure = output.new_figure(8.4, 3.0)
    for k, axes in enumerate(figure.subplots(1, 3, sharey=True)):
        drop, period, decrement = (beam[n][k] for n in Ring._fields)
        for name, (time, drops) in curves.items():
            axes.plot(time, 1e3 * drops[k], label=name, lw=1)
        time = np.linspace(0, 1, 200)
        for side in (-1, 1):
            shown = "measured: rest, envelope" if side > 0 else None
            fall = side * np.exp(-decrement * time / period)
            axes.plot(time, drop * (1 + fall), "k:", lw=1, label=shown)
        axes.axhline(drop, color="k", ls=":", lw=1)
        axes.plot(period * (np.arange(3) + 1), [drop] * 3, "k|", ms=9)
        axes.set(xlim=(0, 1), xlabel="time [s]", title=f"{beam['weight'][k]:.2f} N at the tip")
        axes.invert_yaxis()
    figure.axes[0].set_ylabel("drop of the tip [mm]")
    figure.axes[2].legend(fontsize=7)
    return output.save_figure(figure, folder / "reality_beam.png")


def draw_laws(folder: Path) -> Path:
    """Measured plane strain beside both laws, each with the modulus that bends walls best."""
    figure = output.new_figure(8.4, 3.0)
    left, right = figure.subplots(1, 2)
    table = measurements()["plane_strain"]
    stress = plane_strain()
    strains = STRAINS[:-1]
    strain = np.linspace(0, 1.25, 100)
    left.plot(100 * np.array(table["strain"]), table["stress"], "ko", ms=4, label="measured")
    for law, of in LAWS.items():
        modulus, errors = fitted_law(stress, of, strains)
        words = f"{law.replace('neo_hookean', 'neo-Hookean')}, G = {modulus:.1f} kPa"
        left.plot(100 * strain, modulus * of(strain), label=words)
        right.plot(100 * strains, 100 * errors, "o-", ms=4, label=words)
    right.axhline(0, color="k", lw=0.5)
    left.set(xlabel="strain [%]", ylabel="stress in plane strain [kPa]")
    right.set(xlabel="strain of the outermost fibre [%]", ylabel="error of the curvature [%]")
    left.legend(fontsize=8)
    return output.save_figure(figure, folder / "reality_laws.png")


def main() -> int:
    parser = provenance.parser(__doc__)
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", dest="changes")
    parser.add_argument("--figures", type=Path, default=DOCS / "figures", metavar="FOLDER")
    parser.add_argument("--pages", action="store_true", help="fill the tables into the pages")
    args = parser.parse_args()
    beam = measurements()["beam"]
    rings = {}
    curves = {}
    try:
        changes = keypaths.parse(args.changes)
        for step in STEPS:
            bare = beam_scene(beam, step, changes)
            time, drops = curve = released(beam, bare)
            name = f"{1e3 * bare.discretization.timestep:g} ms"
            curves[name] = curve
            rings[name] = [Ring.of(time, d) for d in drops]
    except InputError as error:
        parser.error(str(error))
    tables = {
        "beam": beam_rows(rings, beam),
        "tip": tip_stiffness((40, 80, 113)),
        "laws": law_rows(),
        "silicones": silicone_rows(),
    }
    pages = {"beam": "reality", "tip": "reality", "laws": "measurements"}
    for name, rows in tables.items():
        text = output.markdown(rows)
        print(f"{text}\n")
        if args.pages:
            output.fill(DOCS / f"{pages.get(name, 'measurements')}.md", text, name)
    print(draw_beam(curves, beam, args.figures))
    print(draw_laws(args.figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
