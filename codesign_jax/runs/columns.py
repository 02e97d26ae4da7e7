"""The files of a run folder and the columns of its tables; docs/files.md says what each means."""

from typing import NamedTuple


class CsvTable(NamedTuple):
    """Columns of a table, in the file's order."""

    columns: tuple[str, ...]  # names of its own columns
    # What precedes the names of the design's columns, which come last; None without them
    designs: str | None = None

    def head(self, designs: list[str]) -> list[str]:
        columns = [] if self.designs is None else [self.designs + name for name in designs]
        return [*self.columns, *columns]


_OUTCOME = "cost", "lost_time_s", "status", "first_bad_step", "steps_at_limit", "residual"
ENDS = (
    *("kept_trials", "unmoved_trials", "slipped_trials", "thrown_trials"),
    *("not_released_trials", "fault_trials"),
)
"""Numbers of trials by how they ended: kept, the three causes of a loss, and the failed ones."""
TABLES = {
    "episodes.csv": CsvTable(
        ("episode", "mean_cost", "best_cost", "failed_trials", "effective_sample_size"), "best_"
    ),
    "particles.csv": CsvTable(
        ("episode", "particle", "cost", "weight", "next_copies_particle"), ""
    ),
    "trials.csv": CsvTable(("episode", "particle", "trial", "object", *_OUTCOME)),
    "tests.csv": CsvTable(
        (
            *("particle", "test_cost", "trials", "failed_trials", "paper_success", *ENDS),
            "search_kept_trials",
        ),
        "",
    ),
}

GRASPS = {
    "design": ("int32", "", "index of the design, from 0"),
    "trial": ("int32", "", "index of the design's trial, from 0"),
    "object": ("name", "", "name of the object"),
    "noise_x_m": ("float32", "m", "offset of the object on the table, x"),
    "noise_y_m": ("float32", "m", "offset of the object on the table, y"),
    "noise_yaw_rad": ("float32", "rad", "rotation of the object about the vertical"),
    "noise_roll_rad": ("float32", "rad", "rotation of the object about x, before pitch and yaw"),
    "noise_pitch_rad": ("float32", "rad", "rotation of the object about y, after roll, before yaw"),
    "noise_arm_roll_rad": ("float32", "rad", "rotation of the arm frame, roll"),
    "noise_arm_pitch_rad": ("float32", "rad", "rotation of the arm frame, pitch"),
    "noise_mass_factor": ("float32", "", "factor on the object's mass"),
    "noise_size_factor": ("float32", "", "factor on the object's size"),
    "noise_friction_factor": ("float32", "", "factor on the friction of all contacts"),
    "noise_stiffness_factor": ("float32", "", "factor on the fingers' shear modulus"),
    "noise_hand_mass_factor": ("float32", "", "factor on the masses of fingers and palm"),
    "verdict": ("name", "", "kept, lost, not_released (the hand did not let go), or fault"),
    "cost": ("float32", "", "0 if kept, cost.maximum if lost as the lift begins or fault"),
    "lost_time_s": ("float32", "s", "when the object was lost; inf if it was kept"),
    "status": ("name", "", "OK, or the bits of codesign_jax.types.Status joined by +"),
    "first_bad_step": ("int32", "", "time step at which the trial failed; missing if none did"),
    "steps_at_limit": ("float32", "", "share of the steps in which the solver did not converge"),
    "residual": ("float32", "", "largest residual of such a step, in weights of palm and object"),
}
"""Columns of the Parquet file of `codesign sample`: type, unit and meaning, by name; those of the
design follow."""
OF_DESIGNS = {"chamber_volume_cm3": ("float32", "cm^3", "air in all unloaded chambers")}
"""Columns of that file that follow the design's."""
MAY_BE_EMPTY = ("first_bad_step", "steps_at_limit", "residual")
"""Those of `GRASPS` whose values may be missing."""

SEEDS = "seeds.csv"
LANDSCAPE = "landscape.csv"
REFERENCE = "reference.csv"
MORE = {
    SEEDS: CsvTable(
        (
            *("seed", "schedule", "first", "finished", "converged_episode", "best_test_cost"),
            *("kept_trials", "trials", "paper_successes", "particles"),
            *("chamber_volume_cm3", "verdict"),
            "other_conditions",
            *("fresh_kept_trials", "fresh_lost_trials", "fresh_not_released_trials"),
            *("fresh_fault_trials", "fresh_cost", "run"),
        )
    ),
    LANDSCAPE: CsvTable(
        ("mean_cost", "kept_trials", "counted_trials", "trials", "chamber_volume_cm3")
    ),
    REFERENCE: CsvTable(tuple(name for name in GRASPS if name != "design")),
}
"""Tables that are not of a run alone."""

FILES = {
    *("scene.toml", "hand.toml", "objects.toml", "control.toml", "search.toml"),
    *("meshes", "code", "checkpoints"),
    *("provenance.json", "events.log", "failures", "figures", "landscape.npz", LANDSCAPE),
    *("reference.npz", REFERENCE, "stress.npz", "fingers.npz", "replay.html", "report.html"),
}
"""Names at the top of a run folder, beside those of `TABLES`."""
