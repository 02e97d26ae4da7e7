"""Flags that commands share.  Nothing heavy is imported here: `--help` is to be quick."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

# A flag given twice adds to what was given before.
Overrides = Annotated[
    tuple[tuple[str, ...], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(
        name="set",
        metavar="KEY=VALUE ...",
        help="Values that replace those of the scene, hand and objects files, by key path: "
        "gravity=3.7 discretization.links=5 hand.material.shear_modulus=60e3 "
        "objects.object.sphere.mass=0.2",
        help_behavior_hint="",
    ),
]

# Without a default of its own: the help text says what takes its place.
Text = Annotated[str | None, tyro.conf.arg(metavar="STR", help_behavior_hint="")]
Count = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")]
ENGINE = tyro.conf.arg(
    metavar="STR",
    help="Engine that simulates: structured (ours); or, of scenes with contact spheres such as "
    "paper_spheres and not of the default one, mujoco (C, float64) and mjx (stock). Default: "
    "structured, or the run's own.",
    help_behavior_hint="",
)
Engine = Annotated[str | None, ENGINE]
File = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]


@dataclasses.dataclass
class TrialFlags:
    """What is grasped, and how exactly that is simulated."""

    objects: Text = None
    """Object set: a built-in name or a .toml file; default: the scene's."""
    accuracy: Text = None
    """Instead of the scene's discretization and solver: fast, standard, fine or reference (errors
    and costs: docs/accuracy.md), or a .toml."""
    overrides: Overrides = ()
    robust: Flag = False
    """Draw friction, mass, size, stiffness and placement more widely for every trial: a hand that
    does not depend on one of them (docs/command_line.md). --set objects.noise... still holds."""


@dataclasses.dataclass
class SceneFlags(TrialFlags):
    """The scene that is simulated."""

    scene: Text = None
    """Scene: a built-in name or a .toml file; default: the run's, or paper."""
    hand: Text = None
    """Hand: a built-in name or a .toml file; default: the scene's."""


@dataclasses.dataclass
class Subject(SceneFlags):
    """Which design, of what scene, simulated by which engine."""

    design: Annotated[
        tuple[tuple[str, ...], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(metavar="FILE NAME=VALUE ...", help_behavior_hint=""),
    ] = ()
    """The design: a .toml file that `codesign studio` saved, or numbers in the hand file's units,
    e.g. length=148 arm_z=-59, which replace the file's; the rest is the default."""
    run_folder: Annotated[
        Path | None, tyro.conf.arg(name="run", metavar="PATH", help_behavior_hint="")
    ] = None
    """Take scene, design space and best particle from this run folder; --accuracy, --objects, --set
    and --engine then replace the run's."""
    preset: Text = None
    """Design space that the names belong to; default: the run's, the design file's, or 2d."""
    engine: Engine = None
    policy: Text = None
    """MODULE:CLASS, a policy of your own that commands the hand (docs/control.md); with --run that
    of the run."""


@dataclasses.dataclass
class RunOrDesign(Subject):
    """As `Subject`, where the run may also come first, as in `codesign report RUN`."""

    first: Annotated[
        Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[RUN]", help_behavior_hint="")
    ] = None
    """A run folder (as --run)."""

    def __post_init__(self) -> None:
        if self.first is not None and self.run_folder is not None:
            raise ValueError(f"{self.first} and --run {self.run_folder}: give one of them")
        self.run_folder = self.first or self.run_folder


@dataclasses.dataclass
class Shown(Subject):
    """Which one grasp to show."""

    object: Text = None
    """Object to grasp, without noise; default: the set's first, or the trial of the run."""
    episode: Count = None
    """With --run: number of an episode, as in trials.csv; default: the last."""
    particle: Count = None
    """With --run: index of a particle; default: the chosen design's, or the episode's best."""
    trial: Count = None
    """With --run: index of a trial; default: the particle's best."""
