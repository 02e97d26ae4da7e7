"""The flags of all commands.  This module imports nothing heavy, so that `--help` is fast."""

import dataclasses
import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codesign_jax import sizes


def _set(name: str, text: str) -> Any:
    """A flag of values by key path."""
    return tyro.conf.arg(name=name, metavar="KEY=VALUE ...", help=text, help_behavior_hint="")


Pairs = tuple[tuple[str, ...], ...]
"""Words of a flag that may be repeated, which adds to its earlier values."""
_SET = _set(
    "set",
    "Replace values of the scene, hand and objects files, by key path: gravity=3.7 "
    "discretization.links=5 hand.material=dragon_skin_10 objects.object.sphere.mass=0.2, or "
    "objects.object.mass=0.2 for all objects",
)
_SET_A = _set("set-a", "As --set, for the first of the two designs alone.")
_SET_B = _set(
    "set-b",
    "As --set, for the second of the two designs alone; or for one that is named once, such as the "
    "same hand in another silicone: --set-b hand.material=ecoflex_00_50.",
)
Overrides = Annotated[Pairs, tyro.conf.UseAppendAction, _SET]
# Without a default of its own: the help text says which value is used instead.
Text = Annotated[str | None, tyro.conf.arg(metavar="STR", help_behavior_hint="")]
Count = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="")]
ENGINE = tyro.conf.arg(
    metavar="STR",
    help="Simulation engine: structured (ours); or, for scenes with contact spheres such as "
    "paper_spheres, but not for the default scene, mujoco (C, float64) or mjx (stock). Default: "
    "structured, or the run's engine.",
    help_behavior_hint="",
)
Engine = Annotated[str | None, ENGINE]
Tolerances = Annotated[
    tuple[str, ...], tyro.conf.arg(metavar="[NAME=VALUE ...]", help_behavior_hint="")
]
File = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
WITHOUT = tyro.conf.arg(
    metavar="FINGER ...",
    help="Leave out fingers, counted from 0: the hand that has the others, counted anew "
    "(docs/verdict.md).",
    help_behavior_hint="",
)
Without = Annotated[tuple[int, ...], WITHOUT]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]


def is_design(path: Path) -> bool:
    """Whether a path means a design file rather than a run folder."""
    return path.suffix == ".toml" and not path.is_dir()


@dataclasses.dataclass
class TrialFlags:
    """Objects, and accuracy of their simulation."""

    objects: Text = None
    """Object set: a built-in name or a .toml file; default: the scene's."""
    accuracy: Text = None
    """Accuracy in place of the scene's discretization and solver: fast, standard, fine or reference
    (docs/accuracy.md compares their errors and run times), or a .toml file."""
    overrides: Overrides = ()
    constants: Text = None
    """Draw constants for every trial from a table of what is known of them: a .toml that `codesign
    finger --posterior` wrote, or unmeasured for those of a hand of which nothing was measured; none
    for those of the scene or run alone (docs/uncertainty.md)."""
    rigid_mount: Flag = False
    """Bolt the palm to the arm, as a gripper on an industrial robot, in place of the paper's
    compliant wrist (effects.wrist = false)."""
    robust: Flag = False
    """Vary friction, mass, size, stiffness and placement more widely between trials, for a hand
    that depends on none of them (docs/optimisers.md). --set objects.noise... overrides this."""


@dataclasses.dataclass
class SceneFlags(TrialFlags):
    """The simulated scene."""

    scene: Text = None
    """Scene: a built-in name or a .toml file; default: the run's, or paper."""
    hand: Text = None
    """Hand: a built-in name or a .toml file; default: the scene's."""


@dataclasses.dataclass
class Subject(SceneFlags):
    """The design, its scene and the engine."""

    design: Annotated[
        tuple[tuple[str, ...], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(metavar="FILE NAME=VALUE ...", help_behavior_hint=""),
    ] = ()
    """The design: a .toml file saved by `codesign studio`, with the names of scene and hand, or
    numbers in the hand file's units, e.g. length=148 arm_z=-59, which replace the file's."""
    run_folder: Annotated[
        Path | None, tyro.conf.arg(name="run", metavar="PATH", help_behavior_hint="")
    ] = None
    """Run folder that provides scene, design space and best particle; --accuracy, --objects, --set
    and --engine replace the run's values."""
    preset: Text = None
    """Design space of the names; default: the run's, the design file's, or 2d."""
    engine: Engine = None
    policy: Text = None
    """MODULE:CLASS, your own policy that commands the hand (docs/control.md); with --run the policy
    of the run."""


@dataclasses.dataclass
class RunOrDesign(Subject):
    """Like `Subject`; a run or design file may be the first argument, as in `codesign replay RUN`.

    Once it is made, `run_folder` or `design` has it, and `first` is None.
    """

    first: Annotated[
        Path | None,
        tyro.conf.Positional,
        tyro.conf.arg(metavar="[RUN|FILE]", help_behavior_hint=""),
    ] = None
    """A run folder (as --run), or a design file, .toml (as --design)."""

    def __post_init__(self) -> None:
        if self.first is not None and self.run_folder is not None:
            raise ValueError(f"{self.first} and --run {self.run_folder}: give one of them")
        self.run_folder = self.first or self.run_folder
        self.first = None
        if self.run_folder is not None and is_design(self.run_folder):
            self.design = ((str(self.run_folder),), *self.design)
            self.run_folder = None


@dataclasses.dataclass
class GraspFlags(Subject):
    """The grasp to show."""

    object: Text = None
    """Object to grasp, without noise; default: the set's first, or the trial of the run."""
    episode: Count = None
    """With --run: number of an episode, as in trials.csv; default: the last."""
    particle: Count = None
    """With --run: index of a particle; default: the chosen design's, or the episode's best."""
    trial: Count = None
    """With --run: index of a trial; default: the particle's best."""


def _size(name: str, meaning: str) -> Any:
    """A flag for a size of a run; its help text names the default."""
    text = f"{meaning}; default: {sizes.text(name)}."
    return tyro.conf.arg(metavar="INT", help=text, help_behavior_hint="")


class Command:
    """A command: its fields are flags, and `main` of the module of its name implements it."""

    package = "commands"
    words: Sequence[str] = ()
    """The command line behind `codesign`, as it was given; nothing if a program made the flags."""

    def run(self) -> int:
        """Runs the command and returns the exit status."""
        name = f"{self.package}.{type(self).__name__.lower()}"
        return importlib.import_module(f"codesign_jax.{name}").main(self)


@dataclasses.dataclass
class Optimize(Command, SceneFlags):
    """Co-design morphology and control of a hand.

    Repeat the command to resume the run in its folder; increase --episodes to extend it.  The
    default sizes depend on the optimiser: all except the default optimiser use the paper's.
    """

    preset: str = "2d"
    """Design space: 2d, full (the whole table, 23d of the default hand) or another preset."""
    schedule: str = "concurrent"
    """Strategy: concurrent, single, switch-K (K switches), morphology or control. Several,
    such as single,switch-4,concurrent, run in one batch and are compared."""
    first: Literal["morphology", "control", "alternate"] = "morphology"
    """Domain of the first episode with single and switch-K; alternate: morphology for even seeds,
    control for odd ones, as in the paper's experiments."""
    optimizer: Text = None
    """Optimiser: screened-es, the default of a new run, particle-filter (the paper's),
    cma-es, open-es, pso or random (docs/optimisers.md); or MODULE:CLASS, your
    own optimiser. A resumed run keeps its optimiser."""
    cost: Text = None
    """MODULE:FUNCTION, your own cost instead of the scene's: a function of scene, trace and
    controls of a grasp (docs/optimisers.md)."""
    policy: Text = None
    """MODULE:CLASS, your own policy that observes the grasp and commands the hand; its parameters
    are searched too (docs/control.md)."""
    engine: Engine = None
    search_accuracy: Text = None
    """Accuracy of the episodes, as of --accuracy, which is that of the final test; scene: the same
    for both. Default: fast for more than three parameters, where --accuracy is not given, the scene
    has the accuracy standard, and all else is the default (docs/accuracy.md)."""
    particles: Annotated[int | None, _size("particles", "Particles")] = None
    trials: Annotated[
        int | None,
        _size("trials", "Trials per particle and episode, preferably a multiple of the objects"),
    ] = None
    episodes: Annotated[int | None, _size("episodes", "Episodes")] = None
    test_trials: Annotated[
        int | None,
        _size("test_trials", "Additional trials of each particle in the final test; 0: none"),
    ] = None
    reference_trials: Count = None
    """Maximum number of fresh trials, at accuracy reference, of the particle that tested best;
    they end when the verdict is decided. Default: 600 with engine structured; 0: none."""
    seed: int = 0
    """Seed of all random numbers."""
    seeds: Text = None
    """Several seeds, such as 0-9 or 1,3,5: one run for each, simulated in one batch, and a
    comparison. Each run draws the same random numbers as alone."""
    devices: Count = None
    """Devices that share the batch; default: every GPU of this host. Results may differ in
    their last bits."""
    chunk: Count = None
    """Most grasps that a device simulates in one call; default: 16384. Runs that have no
    room go on when the others have ended. Larger calls are faster on a GPU that has memory
    for them (docs/performance.md)."""
    out: File = None
    """Run folder; default: runs/HAND-PRESET-SCHEDULE-SEED, with the optimiser before the seed if
    it is another. With --seeds or several --schedule a folder of run folders."""
    fresh: Flag = False
    """Delete an earlier run in the folder and start again."""
    dry_run: Flag = False
    """Print the resolved scene and the number of grasps; write nothing."""


@dataclasses.dataclass(kw_only=True)
class Compare(Command, TrialFlags):
    """Compare runs: one row for each, and the share of runs that found a good design.

    With --trials, the designs of two runs are simulated in the same trials, and their difference is
    given with its 95 % interval. Two design files can be compared in the same way; one design with
    and without a policy; and, with --set-a and --set-b, one design in two settings.
    """

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER ...")]
    """Run folders, or folders of run folders; or one or two design files (.toml)."""
    trials: Count = None
    """Trials for comparing two designs; default: 150 for design files, none for runs, whose
    results are listed instead."""
    seed: int = 0
    """Seed of the trials' noise."""
    set_a: Annotated[Pairs, tyro.conf.UseAppendAction, _SET_A] = ()
    set_b: Annotated[Pairs, tyro.conf.UseAppendAction, _SET_B] = ()
    engine: Text = None
    """Simulation engine; default: the runs' engine."""
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="STR ...", help_behavior_hint="")] = ()
    """MODULE:CLASS, the policy of runs that were made with one, to simulate their designs; with a
    single design, the policy to compare with no policy."""
    out: File = None
    """Write a table of the runs (.csv, docs/files.md)."""


@dataclasses.dataclass
class Evaluate(Command, RunOrDesign):
    """Evaluate one design: costs and kept grasps by object, with intervals, and the verdict."""

    trials: Count = None
    """Trials; the objects take turns. Default: as many as decide the verdict, at most 600
    (docs/verdict.md)."""
    seed: int = 0
    """Seed of the trials' noise."""
    particle: Count = None
    """With a run: a final particle, numbered as in its tests.csv; default: the one that tested
    best."""
    out: File = None
    """Write a table of the trials with their noise and outcomes (.csv)."""
    stress: Flag = False
    """Also simulate heavier objects, less friction, the other bending law and other constants, 12
    grasps (or --trials) for each, and check the design for warnings (docs/verdict.md)."""
    tolerances: Tolerances = ("off",)
    """Then hands as they are cast, each with deviations of its own: what share of them keeps 95 %,
    and which tolerance to tighten. Without values wall=0.3 mm length=1 mm modulus=10 % mount=2 deg;
    two standard deviations each (docs/uncertainty.md)."""
    hands: int = 64
    """With --tolerances: hands that are cast, with 24 grasps each or --trials."""
    without: Without = ()
    forces: File = None
    """Write contact forces and depths of the first trial of each object, one row per time step
    (.csv, docs/files.md), and print the grip forces of the fingers."""
    pull: Annotated[Text, tyro.conf.arg(metavar="down|x|y|z|X,Y,Z")] = None
    """Also find the force [N] that pulls each object out of the resting hand, in a direction of the
    world frame."""
    render: File = None
    """Draw the first trial of each object as a film (.gif, .mp4) or a strip of pictures (.png)."""
    dry_run: Flag = False
    """Print the number of grasps; simulate nothing."""


@dataclasses.dataclass
class Check(Command, RunOrDesign):
    """Measure speed and accuracy of a scene on this machine, in about a minute.

    Simulates a batch of grasps at the scene's accuracy, at that of a search, and as many of them at
    accuracy reference as time allows. Prints grasps per second, the share of verdicts that differ,
    and the duration of a search. The designs are the last ones of a run, a given one, or a mixture
    of random and better ones.
    """

    presets: Flag = False
    """Print a table of all accuracies as well: time of a grasp, kept share, verdicts that differ
    from those at reference and, for several designs, what is lost by choosing between them
    (docs/accuracy.md). Compiles each of them."""
    grasps: Count = None
    """Grasps in the batch; default: the size of an episode, or 360 with --presets."""
    seconds: float = 30.0
    """Approximate time for the grasps at accuracy reference [s]."""


@dataclasses.dataclass(kw_only=True)
class Export(Command, RunOrDesign):
    """Export a design: MuJoCo models with a player, commands, parts to cast, a build sheet.

    The folder is there once all of it is done. docs/export.md has every file.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder to write to."""
    trials: int = 0
    """Grasps with noise to export as models, beside one without noise for each object."""
    seed: int = 0
    """Seed of the trials' noise."""
    without: Without = ()
    no_parts: Flag = False
    """Leave out the fingers and their moulds."""
    end_wall: float = 0.0
    """Walls that close the chamber at base and tip [mm]; 0: as thick as the finger's others."""
    root: float = 10.0
    """Solid end of a finger behind its base, which the palm's seat holds [mm]."""
    inlet: float = 2.0
    """Diameter of the air tube's hole through the base [mm]; 0: none."""
    mould_wall: float = 4.0
    """Thickness of the moulds' walls and floors [mm]."""
    clearance: float = 0.2
    """Gap between parts that are set into one another [mm]."""
    draft: float = 0.0
    """Slope of the moulds' side faces [deg]."""
    no_sheet: Flag = False
    """Leave out the build sheet."""
    tolerances: Tolerances = ("off",)
    """Simulate hands as they are cast: the sheet says what share of them keeps 95 %, and which
    tolerance to tighten, as of `codesign evaluate --tolerances`."""
    hands: int = 64
    """With --tolerances: hands that are cast, with 24 grasps each."""
    overwrite: Flag = False
    """Write into a folder that has files already."""


@dataclasses.dataclass
class Landscape(Command, RunOrDesign):
    """Draw the mean cost over a grid of two numbers: a figure, a table and arrays.

    Each number is a parameter of the design, or any number of the scene by its key path. With
    --run and two parameters the files go to the run folder, and its report shows them.
    """

    parameters: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="NAME KEY=LOW:HIGH", help_behavior_hint="")
    ] = ()
    """The two parameters, such as length arm_z=20:60 (in the hand file's units), or keys with their
    ranges, such as objects.object.friction=0.2:1 objects.object.mass=0.05:0.5; a key without the
    name of an entry sets all entries of a list. Default: the parameters of a design space of two.
    All other numbers stay fixed, unless --search adapts them."""
    search: int = 0
    """Episodes of a search of all other parameters at each point, 12 designs each by CMA-ES: what
    is best there if everything else may adapt. Its trials are others than those of the point. 0:
    the other parameters stay fixed."""
    points: int = 20
    """Points along each range, including its ends."""
    trials: int = 6
    """Trials of each point; the objects take turns, and all points have the same trials."""
    seed: int = 0
    """Seed of the trials' noise."""
    out: File = None
    """Folder of the files; default: the run folder, or landscape."""
    dry_run: Flag = False
    """Print the number of grasps; simulate and write nothing."""


@dataclasses.dataclass
class Render(Command, GraspFlags, RunOrDesign):
    """Draw one grasp of a design or run as a film (.gif, .mp4) or a strip of pictures (.png)."""

    out: Path = Path("grasp.gif")
    """The film or strip: .gif, .mp4 or .png."""
    times: Annotated[
        tuple[float, ...], tyro.conf.arg(metavar="SECONDS ...", help_behavior_hint="")
    ] = ()
    """Times of the pictures in a strip [s]; default: the end of each phase."""
    size: int = 320
    """Width and height of a picture in pixels."""
    camera: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="VIEW NAME=NUMBER ...", help_behavior_hint="")
    ] = ()
    """View (front, side or top) and numbers of MuJoCo's free camera: azimuth=125 elevation=-20
    [degrees] distance=0.62 [m] x=0 y=0 z=0.15 [m, the point that it looks at]."""


@dataclasses.dataclass
class Report(Command):
    """Write the report of a run: one HTML file with the best grasp in 3D, which works offline.

    The report shows the chosen design and its success, cost and parameters over the episodes, the
    landscape (after `codesign landscape --run`), failures by cause, and provenance. Of a design
    file it shows the verdict by fresh trials, as `codesign evaluate` has it, and a grasp.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """The run folder, or a design file (.toml)."""
    out: File = None
    """The file; default: report.html in the run folder, or beside the design file as .html."""
    engine: Text = None
    """Engine for the grasp in 3D, and of a design's trials; default: the run's, or structured."""
    policy: Text = None
    """MODULE:CLASS, the policy of the run, if it was made with one, or of the design."""
    no_replay: Flag = False
    """Omit the grasp in 3D; of a run, simulate nothing."""


@dataclasses.dataclass(kw_only=True)
class Sample(Command, SceneFlags):
    """Make a data set: simulate random designs and write a Parquet file with one row per grasp.

    Designs are uniform between their bounds, with pressures lowered to the limit of their walls.
    Repeat the command to continue after an interruption.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="PATH")]
    """The file, .parquet; a folder beside it keeps partial results until it is finished."""
    designs: int = 1000
    """Number of designs."""
    trials: int = 3
    """Trials of each design, each with its own noise; the objects take turns."""
    preset: str = "2d"
    """Design space: 2d, full (the whole table, 23d of the default hand) or another preset."""
    engine: Annotated[str, ENGINE] = "structured"
    seed: int = 0
    """Seed of designs and noise."""
    chunk: Count = None
    """Maximum number of grasps per call; outcomes are saved after each call. Default: 512 on CPUs,
    16384 on a GPU. The choice changes the last bits of results only."""
    dry_run: Flag = False
    """Print the number of grasps; simulate and write nothing."""


@dataclasses.dataclass
class Scenes(Command):
    """List built-in scenes, hands, object sets and controls, or the effects of one scene."""

    name: Annotated[
        str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[NAME]", help_behavior_hint="")
    ] = None
    """Scene: a built-in name or a .toml file; default: list the names of all built-in files."""
    engine: Text = None
    """Show the effects in this engine only."""


@dataclasses.dataclass
class Replay(Command, GraspFlags, RunOrDesign):
    """Show one grasp in 3D in a browser, or explain how a world of a run failed.

    Writes a page that works offline, with the best grasp of a run, any row of its trials.csv, or a
    grasp of a design. A failed world (RUN: a file in a run folder's failures/) is simulated again.
    """

    out: File = None
    """The page; default: replay.html in the run folder or the working directory."""
    open: Flag = False
    """Open the page in the browser."""


@dataclasses.dataclass
class Studio(Command, RunOrDesign):
    """Open a page with the hand in 3D and a slider for each parameter of its design.

    The page simulates a moved slider at once; trials and the verdict follow. It can save a design,
    export it, improve it by a short search, and browse the designs of a run. It is served on
    localhost only, to browsers that open the printed address. Without a run, a design, a scene and
    a hand it shows the hand to build, of the scene `build`.
    """

    package = "studio"

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("studio")
    """Folder for designs and exports saved from the page."""
    open: Flag = False
    """Open the page in the browser."""
    port: int = 0
    """Port of the page; 0: a free one."""
    host: Annotated[str, tyro.conf.arg(metavar="HOST")] = "127.0.0.1"
    """Host name or address to serve on. Any but loopback can be reached by other machines that
    have the token."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.run_folder or self.design or self.scene or self.hand):
            self.scene = "build"


@dataclasses.dataclass
class Finger(Command, Subject):
    """Predict one finger's bending and forces, and fit its constants to measurements.

    A file of measurements is a CSV whose head names columns and their units: angle_deg, tip_x_mm,
    tip_y_mm, tip_force_N and blocked_force_N stand beside pressure_kPa, deflection_mm and
    sideways_mm beside load_N, and drop_mm beside time_s (docs/measurements.md).

    The model's finger bends over its whole length, but a real one not in its end walls: measure the
    angle between two marks that are 15 mm from its ends, and give that angle times the finger's
    length over the distance of the marks along it.
    """

    measured: Annotated[
        Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[CSV]", help_behavior_hint="")
    ] = None
    """The measurements; default: a curve up to the design's pressure."""
    finger: int = 0
    """Which finger of the hand."""
    fit: Flag = False
    """Fit the constants that the measurements tell, with their intervals, and say which further
    measurement would narrow them most."""
    posterior: File = None
    """With --fit: write the constants' distribution (.toml), for --constants."""
    out: File = None
    """Write what is printed, measured and predicted, as a table (.csv)."""
