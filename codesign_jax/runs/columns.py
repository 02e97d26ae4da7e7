"""What is in a run folder: every file, and every column of its tables with unit and meaning.

`runs.tables` writes these columns and no others; `scripts/files_page.py` writes docs/files.md.
"""

import dataclasses

from codesign_jax.codesign import CONVERGED_COST, SUCCESS_COST
from codesign_jax.types import WARNINGS, Status


@dataclasses.dataclass(frozen=True)
class CsvTable:
    """A table of results.

    Attributes:
      rows: What a row is.
      columns: Meaning of each column, by its name, in the file's order.
      designs: What precedes the names of the design's columns, which come last; None without them.
      design: What design they hold.
    """

    rows: str
    columns: dict[str, str]
    designs: str | None = None
    design: str = ""

    def head(self, designs: list[str]) -> list[str]:
        """Names of all columns."""
        own = [*self.columns]
        return own if self.designs is None else own + [self.designs + name for name in designs]


_EPISODE = "number of the episode, from 1, as on the console"
_PARTICLE = "index of the particle, from 0"
_FAILED = "trials that failed, which count neither as kept nor as lost (see `status`)"

TABLES = {
    "episodes.csv": CsvTable(
        "an episode",
        {
            "episode": _EPISODE,
            "mean_cost": "mean of the particles' costs",
            "best_cost": "lowest of the particles' costs",
            "failed_trials": _FAILED,
            "effective_sample_size": "1 / sum of the squared weights: particles that resampling "
            "could keep, from 1 to all; all where `--optimizer` is not the particle filter",
        },
        "best_",
        "the particle of the lowest cost, as simulated",
    ),
    "particles.csv": CsvTable(
        "a particle of an episode",
        {
            "episode": _EPISODE,
            "particle": _PARTICLE,
            "cost": "mean cost of its trials by the scene's rule for failed ones (`cost.failure`): "
            "left out, or counted with `cost.maximum`",
            "weight": "its weight in the resampling; the weights of an episode sum to 1, and are "
            "equal where `--optimizer` is not the particle filter",
            "next_copies_particle": "the particle of this episode that the next episode's particle "
            "of this index is copied from, before it moves; with another `--optimizer` the one "
            "that has this index among the best of the run so far, -1: one of an earlier episode",
        },
        "",
        "the particle as simulated",
    ),
    "trials.csv": CsvTable(
        "a trial of a particle of an episode",
        {
            "episode": _EPISODE,
            "particle": _PARTICLE,
            "trial": "index of the trial, from 0; trial t is the same object and noise for every "
            "particle of the episode",
            "object": "name of the object",
            "cost": "`cost.maximum` * (t_end - t_lost) / (t_end - t_0): 0 if kept, the maximum if "
            "lost as the lift begins or if the trial failed. t_0 is the end of inflation, t_end "
            "that of the disturbance, t_lost `lost_time_s`",
            "lost_time_s": "first time from t_0 to t_end at which the object's centre is "
            "`cost.lost_distance` or more from the hand's, the mean position of its finger "
            "segments [s]; inf if it was kept",
            "status": "OK, or the bits of `codesign_jax.types.Status` joined by +; "
            f"{Status(WARNINGS).name} is a warning, every other bit makes the trial a failed one",
            "first_bad_step": "time step at which the trial failed, from 0; empty if it did "
            "not fail, and for STUCK, which is told by the end of the grasp",
            "steps_at_limit": "share of the steps up to the verdict in which the solver stopped at "
            "its limit of iterations; empty if it is not known, as of engine mjx",
            "residual": "largest residual of such a step: the forces that its last iteration found "
            "unbalanced, in weights of palm and object (`Outcome.residual`), 0 without such a "
            "step; empty if it is not known, as of engines mujoco and mjx",
        },
    ),
    "tests.csv": CsvTable(
        "a final particle in the final test",
        {
            "particle": _PARTICLE,
            "test_cost": "mean cost of its trials by the scene's rule for failed ones",
            "trials": "its trials: the last episode's and the test's; with another `--optimizer` "
            "than the particle filter the test's alone, as a particle among the best so far was "
            "chosen by its earlier ones",
            "failed_trials": _FAILED,
            "paper_success": "by the paper's rule: 1 if the test's cost is below "
            f"{SUCCESS_COST}, else 0; `success` in older runs",
        },
        "",
        "the particle",
    ),
}

SEEDS, LANDSCAPE, REFERENCE = "seeds.csv", "landscape.csv", "reference.csv"

MORE = {
    SEEDS: CsvTable(
        "a run of `codesign optimize` with several seeds or strategies, in the folder of the runs",
        {
            "seed": "the run's seed",
            "schedule": "its strategy",
            "first": "domain in which it begins, with `single` and `switch-K`",
            "finished": "1 if the run ended without an error, else 0",
            "converged_episode": "number of the episode, from 1, from which on the mean cost stays "
            f"below {CONVERGED_COST:g}; empty if there is none",
            "best_test_cost": "lowest test cost of its final particles; this and the next four "
            "are empty without a final test",
            "kept_trials": "trials of that particle's test that kept the object",
            "trials": "trials of that test",
            "paper_successes": "final particles with a test cost below "
            f"{SUCCESS_COST}, the paper's rule; copies count once",
            "particles": "final particles; copies count once",
            "verdict": "good, not good, or not enough trials, of the best particle's fresh trials, "
            "or without them of its final test",
            "fresh_kept_trials": "of the best particle's fresh trials at accuracy `reference`, had "
            "no part in the choice, those that kept the object; empty without them",
            "fresh_lost_trials": "those that lost it",
            "fresh_stuck_trials": "those in which the hand did not let go of it",
            "fresh_failed_trials": "those that failed otherwise",
            "fresh_cost": "mean cost of these trials by the scene's rule for failed ones",
            "run": "the run's folder, from that of the table",
        },
    ),
    LANDSCAPE: CsvTable(
        "a point of the grid of `codesign landscape`; its first two columns are the two parameters "
        "in the hand file's units, such as `length_mm` and `arm_z_mm`",
        {
            "mean_cost": "mean cost of its trials by the scene's rule for failed ones",
            "kept_trials": "trials that did not fail, nor lose the object",
            "counted_trials": "trials that did not fail",
            "trials": "trials; all points have the same ones",
        },
    ),
}
"""Tables that are not of a run alone."""

DESIGNS = "the design"
GRASPS = {
    "design": ("int32", "", "index of the design, from 0"),
    "trial": ("int32", "", "index of the design's trial, from 0"),
    "object": ("name", "", "name of the object"),
    "noise_x_m": ("float32", "m", "offset of the object on the table, x"),
    "noise_y_m": ("float32", "m", "offset of the object on the table, y"),
    "noise_yaw_rad": ("float32", "rad", "rotation of the object about the vertical"),
    "noise_arm_roll_rad": ("float32", "rad", "rotation of the arm frame, roll"),
    "noise_arm_pitch_rad": ("float32", "rad", "rotation of the arm frame, pitch"),
    "noise_mass_factor": ("float32", "", "factor on the object's mass"),
    "noise_size_factor": ("float32", "", "factor on the object's size"),
    "noise_friction_factor": ("float32", "", "factor on the friction of all contacts"),
    "noise_stiffness_factor": ("float32", "", "factor on the fingers' shear modulus"),
    "noise_hand_mass_factor": ("float32", "", "factor on the masses of fingers and palm"),
    "verdict": (
        "name",
        "",
        "kept, lost (`lost_time_s`), stuck (it failed: the hand did not let go), or failed in "
        "another way, see `status`",
    ),
    "cost": ("float32", "", TABLES["trials.csv"].columns["cost"]),
    "lost_time_s": ("float32", "s", TABLES["trials.csv"].columns["lost_time_s"]),
    "status": ("name", "", TABLES["trials.csv"].columns["status"]),
    "first_bad_step": ("int32", "", TABLES["trials.csv"].columns["first_bad_step"]),
    "steps_at_limit": ("float32", "", TABLES["trials.csv"].columns["steps_at_limit"]),
    "residual": ("float32", "", TABLES["trials.csv"].columns["residual"]),
}
"""Columns of the Parquet file of `codesign sample`: type, unit and meaning, by name; those of the
design follow."""
MAY_BE_EMPTY = ("first_bad_step", "steps_at_limit", "residual")
"""Those of `GRASPS` whose values may be missing."""

MORE[REFERENCE] = CsvTable(
    "a fresh trial of the chosen design at accuracy `reference`; `codesign evaluate --out` writes "
    "the same columns of its trials",
    {
        name: text + (f" [{unit}]" if unit and f"[{unit}]" not in text else "")
        for name, (_, unit, text) in GRASPS.items()
        if name != "design"
    }
    | {"trial": "index of the trial, from 0"},
)

FILES = {
    "scene.toml": "the scene as simulated, every value with its unit; it names the two files below",
    "hand.toml": "the hand",
    "objects.toml": "the objects",
    "meshes": "mesh files of the objects, if there are any",
    "code": "modules of the user's own optimiser and cost (`--optimizer`, `--cost`), if any",
    "provenance.json": "the run's identity, settings, command lines of start, resumptions and "
    "extensions, versions of code and packages, machine, SHA-256 digests of the files above",
    "checkpoints": "state after each of the last episodes, with SHA-256 digests and the run's "
    "identity",
    "events.log": "what happened when, with the wall time of each episode",
    "failures": "worlds that failed, at most ten an episode, for `codesign replay`",
    "figures": "pictures",
    "landscape.npz": "the cost over a grid of two parameters, of `codesign landscape --run`, as "
    "arrays (`codesign_jax.report.landscape.Landscape`)",
    LANDSCAPE: "the same as a table, see below",
    "landscape.part": "what is done of a landscape that was interrupted; the same command goes on",
    "reference.npz": "outcomes of the chosen design's fresh trials at accuracy `reference`, arrays "
    "of shape (trial,), and the digest of what determines them",
    REFERENCE: "the same trials as a table, with their noise, see below",
    "stress.npz": "what the design keeps under other conditions, and warnings of it",
    "replay.html": "a grasp in 3D, of `codesign replay`: opens in any browser, without a network",
    "report.html": "the report of `codesign report`: opens in any browser, without a network",
}


_TYPES = {"name": "text (dictionary)"}


def page() -> str:
    """The reference page, Markdown."""
    lines = [
        "# Files of a run",
        "",
        "Generated from `codesign_jax/runs/columns.py`; do not edit.",
        "",
    ]
    lines += [
        "`codesign optimize` writes a folder. Its tables are CSV in UTF-8: a line of names, numbers"
    ]
    lines += ["with nine significant digits, which name a float32 exactly. Costs have no unit."]
    lines += [
        "`codesign export` writes a folder of its own: [export.md](export.md) has its files.",
        "",
    ]
    lines += ["| file | content |", "| --- | --- |"]
    lines += [f"| `{name}` | {text} |" for name, text in FILES.items()]
    lines += [f"| `{name}` | a row for {table.rows} |" for name, table in TABLES.items()]
    for name, table in (TABLES | MORE).items():
        lines += ["", f"## {name}", "", f"A row for {table.rows}.", ""]
        lines += ["| column | meaning |", "| --- | --- |"]
        lines += [f"| `{column}` | {text} |" for column, text in table.columns.items()]
        if table.designs is not None:
            example = f"`{table.designs}length_mm`, `{table.designs}pressure_0_kPa`"
            lines += [
                f"| {example}, ... | {table.design}: a column for each free parameter of the "
            ]
            lines[-1] += (
                "design space, its name and the hand file's unit; numbers are finger indices |"
            )
    lines += ["", "## The Parquet file of `codesign sample`", "", "A row for a grasp.", ""]
    lines += ["| column | type | unit | meaning |", "| --- | --- | --- | --- |"]
    for column, (kind, unit, text) in GRASPS.items():
        lines.append(f"| `{column}` | {_TYPES.get(kind, kind)} | {unit} | {text} |")
    lines.append(
        f"| `length_0_mm`, `pressure_0_kPa`, ... | float32 | the hand file's | {DESIGNS}: a column "
        "for each free parameter of the design space |"
    )
    return "\n".join(lines) + "\n"
