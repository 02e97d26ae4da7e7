"""How the arm moves: the tables of its commands, its peak speeds, and the room behind the palm."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from codesign_jax.export import grasps, play_hand, pose, tables, valves
from codesign_jax.export.sheet import SheetSection
from codesign_jax.model.layout import WRIST
from codesign_jax.scene import Scene
from codesign_jax.types import Params, Trial

PLAYER = Path(__file__).with_name("play_hand.py")
CLEAR = 5.0
"""Room that is kept to the table [mm] [chosen]."""
BEHIND = (0.0, 50.0, 100.0, 200.0)
"""Distances behind the palm's upper side for which the room is given [mm]."""
LAST_LINK = 60.0
"""Radius of an arm's last link, about, which has to find room behind the palm [mm] [chosen]."""
LEAST_UP = 0.05
"""Upward part of the palm's axis below which a spacer gains no room [chosen]."""

Peaks = Mapping[str, float]
"""Largest speeds and accelerations by the names of `play_hand.LIMITS`."""


def still(scene: Scene) -> Scene:
    """The scene without the shaking that tests a grasp; its phases stay."""
    return dataclasses.replace(scene, arm=dataclasses.replace(scene.arm, shake_amplitude=0.0))


def write(folder: Path, scene: Scene, params: Params, trial: Trial) -> dict[str, Peaks]:
    """Writes the arm's two tables and the player; returns the peaks of each as it is played."""
    peaks_by_table = {}
    for name, variant in ((tables.STILL, still(scene)), (tables.COMMANDS, scene)):
        schedule = grasps.timed_controls(variant, params, trial)
        tables.write_commands(folder, scene, schedule, name)
        peaks_by_table[name] = peaks(schedule)
    (folder / PLAYER.name).write_text(PLAYER.read_text(encoding="utf-8"), encoding="utf-8")
    return peaks_by_table


def arm_rows(schedule: np.ndarray) -> list[list[float]]:
    """Rows of `play_hand.read` of a schedule of controls, see `grasps.timed_controls`."""
    arm = pose.of_controls(schedule[:, 1 : 1 + len(WRIST)])
    turns = pose.quaternion(*arm[:, 3:].T)
    rows: list[list[float]] = np.column_stack([schedule[:, 0], arm[:, :3], turns]).tolist()
    return rows


def peaks(schedule: np.ndarray) -> Peaks:
    """Peaks of a schedule of controls as the player sends it, with its defaults.

    They have the least factor by which the player must slow it down, by the name "slow": 1 if it
    need not, infinite if none is enough.
    """
    rows = arm_rows(schedule)
    values = play_hand.peaks(play_hand.prepared(rows, 1.0, play_hand.SMOOTH, play_hand.PERIOD))
    limits = {name: most for name, (most, _) in play_hand.LIMITS.items()}
    slow = play_hand.least_slow(rows, limits, 1.0, play_hand.SMOOTH, play_hand.PERIOD)
    return {**values, "slow": slow or np.inf}


def warnings(
    peaks_by_table: Mapping[str, Peaks], names: Sequence[str] = (tables.STILL,)
) -> list[str]:
    """Peaks above the player's limits, a sentence for each of the tables."""
    limits = {name: most for name, (most, _) in play_hand.LIMITS.items()}
    sentences = []
    for name in names:
        words = play_hand.excess(peaks_by_table[name], limits)
        if words:
            slow = peaks_by_table[name]["slow"]
            remedy = f"with --slow {slow:g}" if np.isfinite(slow) else "with a longer --smooth"
            sentences.append(
                f"the arm would reach {words} with {name}: {PLAYER.name} plays it {remedy}, or "
                "with the limits of your arm"
            )
    return sentences


def section(
    scene: Scene, params: Params, trial: Trial, peaks_by_table: Mapping[str, Peaks]
) -> SheetSection:
    """Peak speeds and accelerations; arguments as `write`, and what it returned."""
    raw = {
        f"{tables.STILL}, jumps within a time step": play_hand.peaks(
            arm_rows(grasps.timed_controls(still(scene), params, trial))
        )
    }
    limits = {"limit of the player": {name: most for name, (most, _) in play_hand.LIMITS.items()}}
    rows = [
        (name, *(f"{values[key]:.0f}" for key in play_hand.LIMITS))
        for name, values in (raw | dict(peaks_by_table) | limits).items()
    ]
    units = [unit for _, unit in play_hand.LIMITS.values()]
    head = ("table", f"speed {units[0]}", f"acceleration {units[1]}")
    head += (f"turning {units[2]}", f"its acceleration {units[3]}")
    notes = [
        f"The arm's tables are straight between key frames: its speed jumps there. {PLAYER.name} "
        f"sends the mean over {play_hand.SMOOTH:g} s (--smooth), which makes accelerations of the "
        "jumps and moves a corner of the path by at most an eighth of the jump times that; it "
        "refuses a path above its limits, 250 mm/s and those of a Franka Emika Panda. Give those "
        "of your arm (--help), or --slow 1.5 and the like, by which all takes longer. If your "
        "arm's own controller plays the table, give it a blend and these limits.",
        "250 mm/s is no permission to stand by: ISO 10218-1 has that speed for manual mode, with "
        "an enabling device in the hand of the person inside. An arm that this player drives runs "
        "by itself: nobody within its reach.",
        f"{tables.COMMANDS} is {tables.STILL} with the shaking that tests the grasp in the "
        f"simulation, by up to {scene.arm.shake_amplitude:g}° of roll and pitch at "
        f"{scene.arm.shake_frequency:g} Hz, from the lift until the chambers are empty. A hand "
        "that only grasps has no need of it.",
        *(
            f"{words[0].upper()}{words[1:]}."
            for words in warnings(peaks_by_table, [tables.COMMANDS])
        ),
    ]
    return SheetSection("Arm: speeds", head, rows, notes)


def room(scene: Scene, params: Params) -> np.ndarray:
    """Radius of the cylinder behind the palm that stays clear of the table, at `BEHIND` [mm].

    The cylinder is coaxial with the palm.  A point s behind the palm's underside and r from its
    axis is at least z + s u - r sqrt(1 - u^2) above the table, with u the upward part of the axis
    and z the height of the frame; the smallest radius over the key frames is returned, infinite
    where the palm stays level.
    """
    keys = valves.key_poses(scene, params)
    turns = pose.rotation(roll=keys[:, 4], yaw=keys[:, 6], pitch=keys[:, 5])
    up = turns.as_matrix()[:, 2, 2]
    behind = np.array(BEHIND) + 1e3 * scene.hand.palm.thickness
    height = keys[:, 3, None] + behind * up[:, None] - CLEAR
    across = np.sqrt(np.maximum(0.0, 1.0 - up**2))[:, None]
    with np.errstate(divide="ignore"):
        radius = np.where(across > 1e-3, height / np.maximum(across, 1e-3), np.inf)
    radius = np.where((across <= 1e-3) & (height < 0), 0.0, radius)
    return np.maximum(0.0, radius.min(0))


def spacer(scene: Scene, params: Params) -> float | None:
    """Length of the rod behind the palm from which on an arm's last link has room [mm].

    Returns:
      0 if none is needed, None if the palm's back points down, so that none helps.
    """
    keys = valves.key_poses(scene, params)
    thick = 1e3 * scene.hand.palm.thickness
    needed = 0.0
    for _, _, _, z, roll, pitch, yaw in keys:
        turn: Rotation = pose.rotation(roll=roll, yaw=yaw, pitch=pitch)
        up = float(turn.as_matrix()[2, 2])
        lacking = LAST_LINK * np.sqrt(max(0.0, 1.0 - up**2)) + CLEAR - z - thick * up
        if up < LEAST_UP:
            if max(lacking, lacking - BEHIND[-1] * up) > 0:
                return None
            continue
        needed = max(needed, lacking / up)
    return float(needed)


def room_section(scene: Scene, params: Params, sag: float) -> SheetSection:
    """The room behind the palm for a wrist and an arm.

    Args:
      sag: How far the hand's weight lowers a compliant wrist [mm].
    """
    radii = room(scene, params)
    cells = ["any" if np.isinf(r) else f"{r:.0f}" for r in radii]
    head = ("behind the palm's upper side mm", *(f"{v:g}" for v in BEHIND))
    length = spacer(scene, params)
    if length is None:
        words = "The palm's back points to the table: no spacer helps, turn the hand otherwise."
    elif length == 0:
        words = f"An arm whose last link has a radius of {LAST_LINK:.0f} mm fits."
    else:
        words = (
            f"An arm whose last link has a radius of {LAST_LINK:.0f} mm [chosen] needs a spacer of "
            f"{5 * np.ceil(length / 5):.0f} mm between palm and flange: a tube with both circles "
            "of screws. Shift the arm's tool centre point by its length, so that the commands "
            "stay those of the palm's underside. With buffers below a built wrist the spacer "
            "stands above them."
        )
    notes = [
        "At the lowest key frame, as commanded, parts within this radius around the palm's axis "
        f"stay {CLEAR:g} mm above the table. {words}",
    ]
    if scene.effects.wrist:
        notes.append(
            f"What hangs below the wrist's springs is lower by the sag of {sag:.0f} mm, and the "
            "table may push it up; what is above them, guides and arm, is not."
        )
    return SheetSection("Room behind the palm", head, [("radius mm", *cells)], notes)


def room_warnings(scene: Scene, params: Params) -> list[str]:
    """What of an arm has no room, a sentence each."""
    length = spacer(scene, params)
    if length == 0:
        return []
    need = "turn the hand otherwise"
    if length is not None:
        need = f"a spacer of {5 * np.ceil(length / 5):.0f} mm makes room for it"
    return [
        f"an arm's last link of {LAST_LINK:.0f} mm radius right behind the palm would stand in "
        f"the table at the lowest key frame: {need}"
    ]
