"""Whole fingers in three dimensions, beside their sections and the law of the simulation.

python -m scripts.section.finger3d --out runs/finger3d                 # the fingers; again to go on
python -m scripts.section.finger3d --out runs/finger3d --share 1/2     # beside another process
python -m scripts.section.finger3d --out runs/finger3d --merge         # docs/data/finger3d.json
python -m scripts.section.finger3d --report                            # the table of the note

Needs NGSolve (`pip install '.[finger3d]'`), but for --merge and --report.  Two to four minutes of
one core for each finger.
"""

import dataclasses
import json
import time
from collections.abc import Mapping, Sequence
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codesign_jax.scene import section_numbers
from scripts.section import chain
from scripts.section.elements import Model, Section
from scripts.shared import output, provenance

DATA = Path("docs/data/finger3d.json")
NOTE = Path("docs/notes/section.md")
PRESSURES = (20e3, 50e3)
"""Pressures of a finger that is free [Pa]."""
SKIN = 1e-3
"""Silicone over the thread of a finger with a skin [m]."""
ELEMENT = 9e-3
"""Length of an element along the finger [m]."""
DRAWN = ("outside 5", "long 5", "chamber 5")
"""Fingers of the figure."""
BENT = 1.0
"""Curvature sideways of a finger without pressure [1/m]: its fabric is strained by 1 %."""
MIDDLE = 0.3
"""Share of the length, about its middle, that end walls do not reach [chosen]."""
SIDES = (4, 4, 4, 4)
"""Elements along the sides of a section."""


@dataclasses.dataclass(frozen=True)
class Shape:
    """A finger's section and its length [m]; its end walls are as thick as the others."""

    section: Section
    length: float = 0.08
    along: float = ELEMENT

    def elements(self) -> int:
        return round((self.length - 2 * self.section.wall) / self.along)


def fingers() -> dict[str, Shape]:
    """The fingers by name."""
    nominal = Section(sides=SIDES)
    share = SKIN / nominal.wall
    coated = {n: getattr(nominal, n) + 2 * SKIN for n in ("width", "height")}
    coated["wall"] = nominal.wall + SKIN
    sections = {
        "outside 5": nominal,
        "skin 5": dataclasses.replace(nominal, thread_depth=share),
        "chamber 5": dataclasses.replace(nominal, thread_depth=1.0),
        "outside 3.5": dataclasses.replace(nominal, wall=3.5e-3),
        "coated 5": dataclasses.replace(nominal, **coated, thread_depth=SKIN / coated["wall"]),
        "wide 4": dataclasses.replace(nominal, width=30e-3, height=22e-3, wall=4e-3),
        "coarse 5": dataclasses.replace(nominal, layers=1),
    }
    named = {name: Shape(section) for name, section in sections.items()}
    return named | {"long 5": Shape(nominal, length=0.14)}


# --- elements ----------------------------------------------------------------------------------


def _of_section(section: Section, pressure: float) -> dict[str, Any]:
    """Its bend and stiffness in free bend; without pressure, bent sideways by `BENT`."""
    model = Model(section)
    if not pressure:
        # The fabric is on the edge of slack when it is straight.
        moment = model.reach(0.0, twist=0.0, lateral=BENT)[2]
        return {"bend": 0.0, "twist": float(model.stiffness()[0, 0]), "lateral": moment / BENT}
    model.reach(pressure, steps=2, twist=0.0, lateral=0.0)
    stiffness = model.stiffness()
    names = {"twist": (0, 0), "lateral": (2, 2), "coupling": (0, 2)}
    values = {name: float(stiffness[place]) for name, place in names.items()}
    return {"bend": float(model.kappa[1])} | values


def _bends(finger: Any) -> np.ndarray:
    """Curvature between the sections of a finger [1/m]."""
    planes = finger.shape.planes
    reference = finger.shape.nodes[planes]
    positions = finger.positions()[planes]
    heights = reference[..., 2] - reference[..., 2].mean(1, keepdims=True)
    upright = np.einsum("kn,kni->ki", heights, positions)
    angle = np.unwrap(np.arctan2(upright[:, 0], upright[:, 2]))
    return np.diff(angle) / np.diff(reference[:, 0, 0])


def _state(finger: Any, shape: Shape, tip: np.ndarray) -> dict[str, Any]:
    """Numbers of an equilibrium; `tip` is what its tip does over small loads."""
    bends = _bends(finger)
    planes = finger.shape.nodes[finger.shape.planes][:, 0, 0]
    place = (planes[1:] + planes[:-1]) / 2
    middle = np.abs(place / shape.length - 0.5) < MIDDLE / 2
    corner = finger.shape.planes[-1, shape.section.sides[0] // 2]
    return {
        "pressure": finger.pressure,
        "angle": finger.angle(),
        "bend": float(bends[middle].mean()),
        "tip": finger.positions()[corner].tolist(),
        "places": place.tolist(),
        "bends": bends.tolist(),
        "compliance": tip.tolist(),
        "section": _of_section(shape.section, finger.pressure),
    }


def _without_pressure(finger: Any, shape: Shape) -> np.ndarray:
    """What the tip does over loads that bend or twist by about `BENT` [1/m]."""
    held = _of_section(shape.section, 0.0)
    force = held["lateral"] * BENT / shape.length
    columns = []
    for k, load in enumerate((force, held["twist"] * BENT, held["lateral"] * BENT)):
        finger.rest()
        finger.reach(0.0, np.eye(3)[k] * load)
        columns.append(finger.moved() / load)
    finger.rest()
    return np.transpose(columns)


def states(shape: Shape) -> list[dict[str, Any]]:
    """The finger without pressure and in free bend under each."""
    from scripts.section import solid

    finger = solid.Finger(shape.section, shape.length, shape.section.wall, shape.elements())
    results = [_state(finger, shape, _without_pressure(finger, shape))]
    print("without pressure", flush=True)
    for pressure in PRESSURES:
        finger.reach(pressure, steps=2)
        finger.aim()
        results.append(_state(finger, shape, finger.compliance()))
        print(f"{1e-3 * pressure:g} kPa", flush=True)
    return results


def compute(folder: Path, share: str) -> None:
    """Computes the fingers that the folder lacks; `share` I/N takes every N-th one."""
    first, count = (int(n) for n in share.split("/"))
    for name, shape in list(fingers().items())[first - 1 :: count]:
        path = folder / f"{name.replace(' ', '_')}.json"
        if path.exists():
            continue
        start = time.process_time()
        content = {"name": name, **dataclasses.asdict(shape), "states": states(shape)}
        seconds = time.process_time() - start
        output.write_json(path, content | {"cpu_seconds": round(seconds, 1)})
        print(f"{name}: {seconds:.0f} s", flush=True)


def merge(folder: Path, path: Path, commit: str | None) -> None:
    """Writes the folder's fingers into one file."""
    contents = [json.loads((folder / f"{n.replace(' ', '_')}.json").read_text()) for n in fingers()]
    named = {content.pop("name"): content for content in contents}
    solver = metadata.version("ngsolve") if find_spec("ngsolve") else None
    notes = provenance.results(commit) | {"ngsolve": solver}
    output.write_json(path, notes | {"fingers": named})


# --- beside the law ----------------------------------------------------------------------------


class Beside(NamedTuple):
    """A state of a finger in three dimensions, of its section, and of the law's chain.

    Angles are in degrees per 100 mm, lengths in mm, stiffness in N/m, N and mN m^2.
    """

    pressure: float  # [kPa]
    angle: float
    middle: float
    section: float
    law: float
    lost: float  # length that bends as the middle does, less the finger's
    tip: float  # distance of the chain's tip
    shortened: float  # the same of a chain with rigid end walls
    across: float  # force across the tip over its displacement
    chain: float  # the same of the chain
    rigid: float  # the same of a chain with rigid end walls
    shear: float  # G A_s
    law_shear: float
    axis: float  # height over the fabric about which a force across turns the tip
    lateral: float  # E I by a moment on the tip
    section_lateral: float
    law_lateral: float


def beside(content: Mapping[str, Any], state: Mapping[str, Any]) -> Beside:
    """A state of the data, with the law as it is."""
    section = Section(**content["section"] | {"sides": tuple(content["section"]["sides"])})
    length = content["length"]
    height = section.height
    end = section.wall
    pressure = round(state["pressure"], 3)
    sideways = 0.0 if pressure else BENT
    law = chain.by_law(section, length, pressure, sideways)
    unsheared = chain.by_law(section, np.inf, pressure, sideways)
    # Sideways, a finger without pressure also bends by itself; as a chain it stays straight.
    law_bend = law.bend if pressure else 0.0
    of_law = chain.arc(law_bend, length, height=height)
    sections = chain.Sections(**state["section"])
    bend = state["angle"] / (length - 2 * end)
    tip = np.array(state["compliance"])

    def turned(axis: float) -> np.ndarray:
        line = chain.arc(bend, length, height=height, end=end, axis=axis)
        return chain.tip_compliance(line, sections)[0, 1]

    axis = height * (tip[0, 1] - turned(0.0)) / (turned(height) - turned(0.0))
    line = chain.arc(bend, length, height=height, end=end, axis=axis)
    rigid = chain.arc(law_bend, length, height=height, end=end)
    area = section_numbers.shear_area(height, section.wall, section.width)
    shear = section.shear_modulus * float(area)
    ended = chain.tip_compliance(rigid, unsheared._replace(shear=shear))
    return Beside(
        pressure=1e-3 * pressure,
        angle=np.degrees(state["angle"]) / length / 10,
        middle=np.degrees(state["bend"]) / 10,
        section=np.degrees(sections.bend) / 10,
        law=np.degrees(law_bend) / 10,
        lost=1e3 * (length - state["angle"] / state["bend"]) if pressure else 0.0,
        tip=1e3 * float(np.linalg.norm(of_law.tip - state["tip"])),
        shortened=1e3 * float(np.linalg.norm(rigid.tip - state["tip"])),
        across=1 / tip[0, 0],
        chain=1 / chain.tip_compliance(of_law, law)[0, 0],
        rigid=1 / ended[0, 0],
        shear=chain.shear_stiffness(line, tip, sections),
        law_shear=shear,
        axis=1e3 * axis,
        lateral=1e3 * chain.of_moments(line, tip, bend).lateral,
        section_lateral=1e3 * sections.lateral,
        law_lateral=1e3 * unsheared.lateral,
    )


def all_beside(path: Path = DATA) -> dict[str, list[Beside]]:
    """Every state of the data by the finger's name."""
    named = json.loads(path.read_text(encoding="utf-8"))["fingers"]
    return {name: [beside(f, state) for state in f["states"]] for name, f in named.items()}


def bend_table(rows: Mapping[str, Sequence[Beside]]) -> str:
    """Free bends, and what the end walls take from them."""
    table = [
        [
            *("finger", "kPa", "whole finger °", "its middle °", "section °", "law °"),
            *("lost mm", "tip of the law's chain off by mm", "with rigid end walls mm"),
        ]
    ]
    for name, states in rows.items():
        for s in states:
            if s.pressure:
                angles = [f"{v:.1f}" for v in (s.angle, s.middle, s.section, s.law)]
                lengths = [f"{v:.1f}" for v in (s.lost, s.tip, s.shortened)]
                table.append([name, f"{s.pressure:g}", *angles, *lengths])
    return output.markdown(table)


def sideways_table(rows: Mapping[str, Sequence[Beside]]) -> str:
    """What a small force and a small moment sideways do to the tip."""
    table = [
        [
            *("finger", "kPa", "tip N/m", "chain N/m", "with rigid end walls N/m"),
            *("G·A_s N", "law N", "axis mm"),
            *("EI by a moment mN m²", "section", "law"),
        ]
    ]
    for name, states in rows.items():
        for s in states:
            tips = [f"{v:.0f}" for v in (s.across, s.chain, s.rigid)]
            shears = [f"{v:.1f}" for v in (s.shear, s.law_shear, s.axis)]
            bends = [f"{v:.0f}" for v in (s.lateral, s.section_lateral, s.law_lateral)]
            table.append([name, f"{s.pressure:g}", *tips, *shears, *bends])
    return output.markdown(table)


def draw(path: Path) -> Path:
    """Curvature along fingers."""
    named = json.loads(DATA.read_text(encoding="utf-8"))["fingers"]
    figure = output.new_figure(8, 2.8)
    axes = figure.subplots(1, len(PRESSURES))
    for axis, pressure in zip(axes, PRESSURES, strict=True):
        for name in DRAWN:
            [state] = [s for s in named[name]["states"] if round(s["pressure"]) == pressure]
            [line] = axis.plot(1e3 * np.array(state["places"]), state["bends"], label=name)
            law = np.radians(10 * beside(named[name], state).law)
            axis.axhline(law, color=line.get_color(), ls=":", lw=1)
        axis.set_title(f"{1e-3 * pressure:g} kPa; dotted: law")
        axis.set_xlabel("along the finger mm")
    axes[0].set_ylabel("bend 1/m")
    axes[0].legend()
    return output.save_figure(figure, path)


def fill(page: Path) -> None:
    rows = all_beside()
    draw(page.parent.parent / "figures" / "finger3d.png")
    output.fill(page, bend_table(rows), "finger3d_bend")
    output.fill(page, sideways_table(rows), "finger3d_sideways")


def main() -> None:
    parser = provenance.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/finger3d"), help="folder of files")
    parser.add_argument("--share", default="1/1", metavar="I/N", help="every N-th finger")
    parser.add_argument("--merge", action="store_true", help="write the files into the data")
    parser.add_argument("--report", action="store_true", help="fill the note")
    args = parser.parse_args()
    if args.merge:
        merge(args.out, DATA, args.commit)
    if args.report:
        fill(NOTE)
    if not (args.merge or args.report):
        compute(args.out, args.share)


if __name__ == "__main__":
    main()
