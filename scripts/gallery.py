"""Hands that searches found, as a page of moving pictures: docs/gallery.md.

    python -m scripts.gallery [NAME ...]

The hands are those of docs/gallery/hands.toml; `first` is the one of README's own command and
pictures.  The design of each is docs/gallery/NAME.toml; where that is not there, its search is run,
in runs/gallery/NAME, where an interrupted one goes on.  A design is judged at the accuracy of its
scene: in 100 fresh trials, in 48 with objects of each of some masses, and as 64 hands that are
cast with the usual tolerances.  Its grasp without noise is
drawn; look.png in runs/gallery/NAME shows it from two sides, to be looked at.  A hand that has a
warning of its design is refused.
"""

import dataclasses
import re
import shlex
import sys
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from codesign_jax import cli, rollout, runs, tolerances
from codesign_jax.commands import common
from codesign_jax.commands.flags import Evaluate
from codesign_jax.export import valves
from codesign_jax.judge import cases, stress, verdict, worth
from codesign_jax.judge.sentences import Judged
from codesign_jax.report import animation
from codesign_jax.report.replay import Camera
from codesign_jax.runs import selection
from codesign_jax.scene import design_files, draws
from scripts.shared import evidence

RUNS = Path("runs") / "gallery"
DOCS = Path("docs")
FOLDER = DOCS / "gallery"
RATE = 10.0
SIZE = (480, 480)
QUALITY = 45
"""Frames of a second, pixels, and WebP's quality."""
CLOSE = 0.36
"""Distance of the camera [m]."""
TRIALS = 100
SEED = 1000
MASSES = (0.1, 0.2, 0.3, 0.5)
HEAVY_TRIALS = 48
"""Masses of all objects [kg] in place of their own, and trials with each."""


@dataclasses.dataclass(frozen=True)
class Hand:
    """A hand of docs/gallery/hands.toml.

    Attributes:
      title: What the hand is called.
      names: Scene, hand, objects or control, where they are not the default ones.
      search: Flags that `codesign optimize` has beside these.
      sentence: What the hand does.
      shown: Objects that it is seen with.
      camera: What its camera has of its own.
    """

    name: str
    title: str
    search: str
    sentence: str
    shown: list[str]
    names: dict[str, str] = dataclasses.field(default_factory=dict)
    camera: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def command(self) -> str:
        """The search."""
        flags = {"control": "--set control="}
        named = [flags.get(key, f"--{key} ") + name for key, name in self.names.items()]
        return " ".join(["codesign optimize", *named, self.search])

    @property
    def design(self) -> Path:
        """The file of the design."""
        return FOLDER / f"{self.name}.toml"


def hands() -> list[Hand]:
    """Those of the page."""
    named = tomllib.loads((FOLDER / "hands.toml").read_text(encoding="utf-8"))
    return [Hand(name, **fields) for name, fields in named.items()]


def find(hand: Hand) -> None:
    """Runs the search, or what is left of it, and writes the design that it found."""
    folder = RUNS / hand.name
    words = [*shlex.split(hand.command)[1:], "--reference-trials", "0"]
    cli.main([*words, "--out", str(folder)])
    case = selection.case_of_run(folder)
    preset = runs.read_run(folder)[1].preset
    text = common.design_text(
        case.space, design_files.DesignFile(preset, {}, **hand.names), case.design
    )
    hand.design.write_text(text, encoding="utf-8")


def check(hand: Hand, case: cases.Case) -> None:
    """Refuses a hand whose design has a warning, as the page says that none has one.

    Raises:
      ValueError: With the warnings.
    """
    params = case.space.params(jnp.asarray(case.design, jnp.float32))
    warnings = stress.of_design(case.scene, jax.tree.map(np.asarray, params))
    if warnings:
        raise ValueError(f"{hand.design}: {'; '.join(warnings)}")


def judge(hand: Hand, case: cases.Case) -> None:
    """Writes verdict, masses, yield and fingers before the design, if they are not there."""
    text = hand.design.read_text(encoding="utf-8")
    if not text.startswith("# keeps"):
        judged = Judged(case.scene, case.simulate(TRIALS, jax.random.key(SEED)))
        text = f"# {judged}\n{text}"
    first, second, *rest = text.splitlines()
    if not second.startswith("# of heavier"):
        rest = [second, *rest]
        second = f"# of heavier objects {heavier(case)}; {cast(case)}"
    if not second.endswith("needed"):
        second = f"{second}; {needed(case)}"
    hand.design.write_text("\n".join([first, second, *rest, ""]), encoding="utf-8")


def heavier(case: cases.Case) -> str:
    """What the hand keeps of objects that all have one of `MASSES` above their own, in words."""
    shares = []
    heaviest = max(shape.mass for shape in case.scene.objects.object)
    for mass in (m for m in MASSES if m > heaviest):
        scene = draws.changed(case.scene, ("objects", "object", "mass"), lambda _, m=mass: m)
        outcome = case._replace(scene=scene).simulate(HEAVY_TRIALS, jax.random.key(SEED + 1))
        share = 100 * verdict.kept(outcome).mean()
        shares.append(f"{share:.0f} % at {1e3 * mass:.0f} g")
    return "it keeps " + ", ".join(shares)


def cast(case: cases.Case) -> str:
    """How many cast hands keep what is wanted, in words."""
    hands = tolerances.simulate(case, {}, jax.random.key(SEED + 2))
    good = int((hands.kept[1:] >= hands.needed).sum())
    return f"{good} of {len(hands.kept) - 1} cast hands keep {100 * verdict.WANTED:.0f} %"


def needed(case: cases.Case) -> str:
    """How many of its fingers the hand needs, in words; see `codesign_jax.judge.worth`."""
    params = case.space.params(jnp.asarray(case.design, jnp.float32))
    tried = worth.simulate(case.scene, case.make_engine(), params, jax.random.key(SEED + 3))
    count = case.scene.num_fingers
    return f"{count - len(tried.least)} of {count} fingers needed"


def draw(hand: Hand, case: cases.Case) -> None:
    """Simulates a grasp of each object without noise, and writes them as a film."""
    scene = case.scene
    params = case.space.params(jnp.asarray(case.design, jnp.float32))
    named = [rollout.nominal_trial(scene, name) for name in hand.shown]
    trials = jax.tree.map(lambda *v: jnp.stack(v), *named)
    shown = animation.replay(scene, case.make_engine(), params, trials)
    ends = [verdict.VERDICTS[int(verdict.verdicts(grasp.outcome))] for grasp in shown]
    print(hand.name, *zip(hand.shown, ends, strict=True))
    seen = animation.CAMERA._replace(**({"distance": CLOSE} | hand.camera))

    def row(times: np.ndarray, camera: Camera) -> list[np.ndarray]:
        parts = []
        for grasp in shown:
            moving = animation.following(scene, grasp, times, camera)
            parts.append(animation.frames(scene, grasp, times, size=SIZE, camera=moving))
        return [*np.concatenate(parts, axis=2)]

    frames = row(np.arange(0.0, scene.end_time, 1 / RATE), seen)
    first, *others = (Image.fromarray(frame) for frame in frames)
    options = {"duration": round(1e3 / RATE), "loop": 0, "quality": QUALITY, "method": 6}
    first.save(FOLDER / f"{hand.name}.webp", save_all=True, append_images=others, **options)
    times = np.array([2.0, 2.7, 3.5, 4.5, 6.0, 7.9, 8.9])
    turns = (seen.azimuth, seen.azimuth + 90)
    sides = [seen._replace(azimuth=turn, elevation=-8.0) for turn in turns]
    looks = [np.hstack(row(times, camera)) for camera in sides]
    (RUNS / hand.name).mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.vstack(looks)).save(RUNS / hand.name / "look.png")


def section(hand: Hand) -> str:
    """What the page shows and says of a hand."""
    judged = hand.design.read_text(encoding="utf-8").splitlines()
    words = f"{hand.sentence} The hand {judged[0][2:]}."
    picture = f"![{hand.title}](gallery/{hand.name}.webp)"
    command = f"```\n{hand.command}\n```"
    design = f"[Design](gallery/{hand.name}.toml)"
    return "\n\n".join([f"## {hand.title}", picture, f"{words} {design}", command])


def table() -> str:
    """All hands beside one another: what they keep, and what they need."""
    masses = [f"{1e3 * mass:.0f} g" for mass in MASSES]
    head = ("hand", "kept", *(f"kept at {mass}" for mass in masses), "cast hands that are good")
    head += ("fingers needed", "pressure lines")
    rows = [_row(hand, masses) for hand in hands() if hand.design.exists()]
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _row(hand: Hand, masses: list[str]) -> tuple[str, ...]:
    first, second = hand.design.read_text(encoding="utf-8").splitlines()[:2]
    kept = re.search(r"keeps (\S+ %)", first)
    shares = {mass: share for share, mass in re.findall(r"(\d+ %) at (\d+ g)", second)}
    cast_hands = re.search(r"(\d+ of \d+) cast hands", second)
    case = common.find_case(Evaluate(design=((str(hand.design),),)))
    params = jax.tree.map(np.asarray, case.space.params(jnp.asarray(case.design, jnp.float32)))
    fingers = re.search(r"(\d+ of \d+) fingers needed", second)
    link = f"[{hand.title}](#{re.sub(r'[^a-z0-9]+', '-', hand.title.lower()).strip('-')})"
    return (
        link,
        kept[1] if kept else "–",
        *(shares.get(mass, "–") for mass in masses),
        cast_hands[1] if cast_hands else "–",
        fingers[1] if fingers else "–",
        str(len(valves.lines(case.scene, params))),
    )


def main(names: list[str]) -> None:
    """Finds and draws the hands of these names, all without any, and writes the page."""
    for hand in hands():
        if not names or hand.name in names:
            if not hand.design.exists():
                find(hand)
            case = common.find_case(Evaluate(design=((str(hand.design),),)))
            check(hand, case)
            judge(hand, case)
            draw(hand, case)
    write_page()


def write_page() -> None:
    """Writes docs/gallery.md, which says which version its figures were measured with."""
    sections = [section(hand) for hand in hands() if hand.design.exists()]
    text = "\n\n".join([HEAD, table(), *sections])
    page = DOCS / "gallery.md"
    page.write_text(f"{text}\n", encoding="utf-8")
    evidence.write(page)


HEAD = """# Gallery

`codesign optimize` found these hands within the [limits](optimisers.md#what-can-be-built) of what
can be built, and none of these designs has a [warning](verdict.md#before-you-build). They are cast
in Dragon Skin 10. The command below each hand is its search; another machine may end with another
hand. Three of these hands are the best of searches with six seeds, which ended with 73 to 99 %
(three fingers), 92 to 100 % (tapered fingers) and 83 to 100 % (shelf). For the bin a default search
ended with 76 % (one seed), for household objects with 87 to 95 % (six seeds); these two hands are
from other searches, at the accuracy `standard` throughout. Searches in scenes with fixtures (plate,
bin, shelf) have [this accuracy](accuracy.md#search-coarse-judge-fine) in any case.

* **Verdict.** Each hand met 100 fresh trials at the accuracy `standard`. *Friction* is between
  object and hand. `codesign evaluate --design docs/gallery/shelf.toml --trials 100 --seed 1000`
  repeats the verdict of the hand *From a shelf*; the file names scene, hand, objects
  and control where they are not the default.
* **More trials.** *N more at this share would decide* means that N further trials would decide the
  verdict if the kept share stayed the same.
* **Heavier objects.** For each stated mass, all objects have this mass in 48 trials.
* **Cast hands.** We simulated 64 hands with the usual [tolerances](uncertainty.md#cast-hands) of
  casting, in 24 grasps each. The page states how many of these hands keep at least 95 %.

On the site a click on the head of a column sorts the table."""

if __name__ == "__main__":
    main(sys.argv[1:])
