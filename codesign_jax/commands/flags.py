"""The flags of all commands.  Nothing heavy is imported here: `--help` is to be quick."""

import dataclasses
import importlib
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codesign_jax import sizes

# A flag given twice adds to what was given before.
Overrides = Annotated[
    tuple[tuple[str, ...], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(
        name="set",
        metavar="KEY=VALUE ...",
        help="Values that replace those of the scene, hand and objects files, by key path: "
        "gravity=3.7 discretization.links=5 hand.material=dragon_skin_10 "
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
    """The design: a .toml file that `codesign studio` saved, with the names of scene and hand, or
    numbers in the hand file's units, e.g. length=148 arm_z=-59, which replace the file's."""
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
class GraspFlags(Subject):
    """Which one grasp to show."""

    object: Text = None
    """Object to grasp, without noise; default: the set's first, or the trial of the run."""
    episode: Count = None
    """With --run: number of an episode, as in trials.csv; default: the last."""
    particle: Count = None
    """With --run: index of a particle; default: the chosen design's, or the episode's best."""
    trial: Count = None
    """With --run: index of a trial; default: the particle's best."""


def _size(name: str, meaning: str) -> Any:
    """A flag of a run's size, whose help says the default."""
    text = f"{meaning}; default: {sizes.text(name)}."
    return tyro.conf.arg(metavar="INT", help=text, help_behavior_hint="")


class Command:
    """A command: its flags are fields, its work is `main` of the module of its name."""

    package = "commands"

    def run(self) -> int:
        """Runs the command and returns the exit status."""
        name = f"{self.package}.{type(self).__name__.lower()}"
        return importlib.import_module(f"codesign_jax.{name}").main(self)


@dataclasses.dataclass
class Optimize(Command, SceneFlags):
    """Co-design morphology and control of a hand.

    The same command again resumes the run in its folder, and more --episodes extend it.  Sizes that
    are not given depend on the optimiser: those of all but the default are the paper's.
    """

    preset: str = "2d"
    """Design space: 2d, full (the whole table, 23d of the default hand) or another preset."""
    schedule: str = "concurrent"
    """Strategy: concurrent, single, switch-K (K switches), morphology or control. Several, such as
    single,switch-4,concurrent: runs of each, simulated in one batch, and a comparison."""
    first: Literal["morphology", "control", "alternate"] = "morphology"
    """Domain of the first episode with single and switch-K; alternate: morphology for even seeds,
    control for odd ones, as in the paper's experiments."""
    optimizer: Text = None
    """Optimiser: screened-es, the default of a new run, particle-filter (the paper's),
    cma-es, open-es, pso or random (docs/command_line.md); or MODULE:CLASS, one of
    your own. A run goes on with its own."""
    cost: Text = None
    """MODULE:FUNCTION, a cost of your own instead of the scene's: a number from scene, trace and
    controls of a grasp (docs/command_line.md)."""
    policy: Text = None
    """MODULE:CLASS, a policy of your own that commands the hand by what it observes; its parameters
    are searched too (docs/control.md)."""
    engine: Engine = None
    particles: Annotated[int | None, _size("particles", "Particles")] = None
    trials: Annotated[
        int | None,
        _size("trials", "Trials of a particle in an episode, best a multiple of the objects"),
    ] = None
    episodes: Annotated[int | None, _size("episodes", "Episodes")] = None
    test_trials: Annotated[
        int | None,
        _size("test_trials", "Further trials of each particle of the final test; 0: none"),
    ] = None
    reference_trials: Count = None
    """Most fresh trials at accuracy reference of the particle that tested best, which go on until
    they decide its verdict; default: 600 with engine structured; 0: none."""
    seed: int = 0
    """Root of all random numbers."""
    seeds: Text = None
    """Several seeds, such as 0-9 or 1,3,5: a run of each, simulated in one batch, and a
    comparison. Each draws the random numbers that it would draw alone."""
    devices: Count = None
    """Devices that share the batch; default: every GPU of this host. Results may differ in
    their last bits."""
    chunk: Count = None
    """Most grasps that a device simulates in one call; default: 16384. Runs that have no
    room go on when the others have ended. Larger calls are faster on a GPU that has memory
    for them (docs/performance.md)."""
    distributed: Text = None
    """With --seeds, one process on each of several hosts, which share the seeds: auto under SLURM
    or MPI, or ADDRESS:PORT,PROCESSES,INDEX. The folder must be one that all see."""
    out: File = None
    """Run folder; default: runs/HAND-PRESET-SCHEDULE-SEED, with the optimiser before the seed if
    it is another. With --seeds or several --schedule a folder of run folders."""
    fresh: Flag = False
    """Delete an earlier run in the folder and start anew."""
    dry_run: Flag = False
    """Print the resolved scene and the number of grasps; write nothing."""


@dataclasses.dataclass(kw_only=True)
class Compare(Command, TrialFlags):
    """Compare runs: a row for each, and how many of each kind found a good design.

    With --trials the designs of two runs are simulated in the same trials, and their difference
    comes with its 95 % interval; so are two design files, and one design with a policy and without.
    """

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER ...")]
    """Run folders, or folders of run folders; or one or two design files (.toml)."""
    trials: Count = None
    """Trials in which the two designs are compared; default: none of runs, only what they found,
    and 150 of design files."""
    seed: int = 0
    """Root of these trials' noise."""
    engine: Text = None
    """Engine that simulates them; default: the runs'."""
    policy: Annotated[tuple[str, ...], tyro.conf.arg(metavar="STR ...", help_behavior_hint="")] = ()
    """MODULE:CLASS of the runs that were made with a policy, to simulate their designs; with one
    design alone, the policy that is compared with none."""
    out: File = None
    """Write a table of the runs (.csv, docs/files.md)."""


@dataclasses.dataclass
class Evaluate(Command, RunOrDesign):
    """Evaluate one design: costs of each object, how sure they are, an animation if asked for."""

    trials: Count = None
    """Trials, taking turns between the objects; default: as many as decide the verdict, at most 600
    (docs/command_line.md)."""
    seed: int = 0
    """Root of the trials' noise."""
    particle: Count = None
    """With a run: a final particle, as in its tests.csv, instead of the one that tested best."""
    out: File = None
    """Write a table of the trials, with their noise and how they ended (.csv)."""
    stress: Flag = False
    """Then grasps with heavier objects, less friction, the other bending law and other constants,
    12 of each or --trials, and warnings of the design itself (docs/command_line.md)."""
    forces: File = None
    """Write contact forces and depths of the first trial of each object, a row for each time step
    (.csv, docs/files.md), and say how hard the fingers grip."""
    pull: Annotated[Text, tyro.conf.arg(metavar="down|x|y|z|X,Y,Z")] = None
    """Then say how hard each object can be pulled in a direction of the world frame before it
    leaves the hand, which stands still [N]."""
    render: File = None
    """Draw the first trial of each object: a film (.gif, .mp4) or a strip of pictures (.png)."""
    dry_run: Flag = False
    """Print the number of grasps; simulate nothing."""


@dataclasses.dataclass
class Check(Command, RunOrDesign):
    """Measure on this machine, in about a minute, how fast and how exact a scene is.

    Simulates a batch of grasps at the scene's accuracy, and as many of them at accuracy reference
    as there is time for: grasps a second, verdicts that differ, and how long a search takes. The
    designs are those that a run ended with, one that is given, or a mixture of random and better
    ones.
    """

    grasps: Count = None
    """Grasps of the batch; default: those of an episode of a search."""
    seconds: float = 30.0
    """Time for the grasps at accuracy reference, as far as it can be known before [s]."""


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
    """Root of the trials' noise."""
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
    tolerance: Literal["off", "free", "all"] = "off"
    """Simulate how far which parameters may drift: none, the design space's free ones (in 2d at
    most 756 grasps, in 23d 8,316) or those of the hand's whole table (at most 8,316). The command
    tells the number first, and the time as soon as it has measured its rate."""
    tolerance_steps: int = 5
    """Values of a parameter to try on each side, until one fails."""
    tolerance_trials: int = 36
    """Grasps of each value; at 36 a value without a failure is above 90 % with 95 % confidence."""
    overwrite: Flag = False
    """Write into a folder that has files already."""


@dataclasses.dataclass
class Landscape(Command, RunOrDesign):
    """Draw the mean cost over a grid of two numbers: a figure, a table and arrays.

    The numbers are parameters of the design, or any of the scene by their key paths. With --run and
    two parameters the files go to the run folder, and its report shows them.
    """

    parameters: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="NAME KEY=LOW:HIGH", help_behavior_hint="")
    ] = ()
    """The two parameters, such as length arm_z=20:60 (in the hand file's units), or keys with their
    ranges, such as objects.object.friction=0.2:1 objects.object.mass=0.05:0.5, which without an
    entry's name mean all of a list; default: those of a design space of two. The rest stays as it
    is."""
    points: int = 20
    """Points along each parameter's range, its ends included."""
    trials: int = 6
    """Trials of each point, taking turns between the objects; all points have the same ones."""
    seed: int = 0
    """Root of the trials' noise."""
    out: File = None
    """Folder of the files; default: the run folder, or landscape."""
    dry_run: Flag = False
    """Print the number of grasps; simulate and write nothing."""


@dataclasses.dataclass
class Render(Command, GraspFlags, RunOrDesign):
    """Draw one grasp of a design or of a run: a film (.gif, .mp4) or a strip of pictures (.png)."""

    out: Path = Path("grasp.gif")
    """The film or strip: .gif, .mp4 or .png."""
    times: Annotated[
        tuple[float, ...], tyro.conf.arg(metavar="SECONDS ...", help_behavior_hint="")
    ] = ()
    """Times of a strip's pictures [s]; default: the end of each phase."""
    size: int = 320
    """Width and height of a picture in pixels."""
    camera: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="VIEW NAME=NUMBER ...", help_behavior_hint="")
    ] = ()
    """Where it is seen from: front, side or top, and any of azimuth=125 elevation=-20 [degrees]
    distance=0.62 [m] x=0 y=0 z=0.15 [m, the point looked at], as of MuJoCo's free camera."""


@dataclasses.dataclass
class Report(Command):
    """Write the report of a run: one HTML file, with the best grasp in 3D, that works offline.

    It has the chosen design and its success, the evolution of cost and parameters, the landscape
    (where `codesign landscape --run` was there before), failures by cause, and provenance.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run folder."""
    out: File = None
    """The file; default: report.html in the run folder."""
    engine: Text = None
    """Engine that simulates the best grasp again; default: the run's."""
    policy: Text = None
    """MODULE:CLASS, the policy of a run that has one, to simulate it again."""
    no_replay: Flag = False
    """Leave the grasp in 3D out: nothing is simulated."""


@dataclasses.dataclass(kw_only=True)
class Sample(Command, SceneFlags):
    """Simulate random designs, one row a grasp of a Parquet file: a data set.

    Designs are uniform between their bounds, with pressures lowered under the limit of their
    walls. The same command again goes on where it was stopped.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="PATH")]
    """The file, .parquet; what is done of it is kept in a folder beside it until it is finished."""
    designs: int = 1000
    """Number of designs."""
    trials: int = 3
    """Trials of each design, each with noise of its own; objects take turns."""
    preset: str = "2d"
    """Design space: 2d, full (the whole table, 23d of the default hand) or another preset."""
    engine: Annotated[str, ENGINE] = "structured"
    seed: int = 0
    """Root of designs and noise."""
    chunk: Count = None
    """Most grasps of a call, after each of which the outcomes are saved; default: 512 on CPUs,
    16384 on a GPU. Results depend on it in the last bits only."""
    dry_run: Flag = False
    """Print the number of grasps; simulate and write nothing."""


@dataclasses.dataclass
class Scenes(Command):
    """List what is built in; of a scene its effects: on, off, or unsupported by an engine."""

    name: Annotated[
        str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[NAME]", help_behavior_hint="")
    ] = None
    """Scene: a built-in name or a .toml file; default: names of all that is built in."""
    engine: Text = None
    """Show the effects in this engine only."""


@dataclasses.dataclass
class Replay(Command, GraspFlags, RunOrDesign):
    """Show one grasp in 3D in a browser, or say how a failed world of a run failed.

    A page of its own that works offline: the best grasp of a run, any row of its trials.csv, or a
    design. A failed world (RUN is a file of a run folder's failures/) is simulated again.
    """

    out: File = None
    """The page; default: replay.html in the run folder, or here."""
    open: Flag = False
    """Open it in the browser."""


@dataclasses.dataclass
class Studio(Command, RunOrDesign):
    """Open a page with the hand in 3D and a slider for each parameter of its design.

    A moved slider is simulated at once; trials and the verdict follow. Designs can be saved,
    exported, improved by a short search, and those of a run looked through. The page is served on
    this machine alone, to the browser that opens the printed address.
    """

    package = "studio"

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("studio")
    """Folder of what is saved from the page."""
    open: Flag = False
    """Open the page in the browser."""
    port: int = 0
    """Port of the page; 0: one that is free."""
    host: Annotated[str, tyro.conf.arg(metavar="HOST")] = "127.0.0.1"
    """Name or address to serve at; other machines reach any but loopback, with the token."""


@dataclasses.dataclass
class Finger(Command, Subject):
    """Predict one finger's bending and forces, and fit its constants to measurements.

    A file of measurements is a CSV whose head names columns and their units: angle_deg, tip_x_mm,
    tip_y_mm, tip_force_N and blocked_force_N stand beside pressure_kPa, deflection_mm and
    sideways_mm beside load_N, and drop_mm beside time_s (docs/measurements.md).
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
