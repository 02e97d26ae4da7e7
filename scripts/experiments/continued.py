"""Goes on with an experiment of which only its published results are left, not its state file.

python -m scripts.experiments.continued start 23d docs/data/paper_fingers_switch runs/switch
python -m scripts.experiments 23d --strategies switch-1 --out runs/switch
python -m scripts.experiments.continued join 23d docs/data/paper_fingers_switch runs/switch

Results have the particles after the last episode, which is all that the next one needs, but no
single trial of the episodes before.  So `start` makes a state without those, and `join` replaces
what was then computed of these episodes by what had been published.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from codesign_jax import scene
from codesign_jax.scene import parameters
from scripts.experiments import Batch, plan, results, study
from scripts.experiments.study import Study
from scripts.shared import record
from scripts.shared.record import Arrays

BY_EPISODE = ("mean", "best", "quartiles", "mean_exclude", "mean_worst", "failed")
"""Results with the axes (strategy, run, episode, ...)."""
BEFORE = ("seeds", "seed_cost", "seed_candidates")


def start(earlier: Study) -> tuple[Arrays, dict[str, object]]:
    """A state from which an experiment goes on, and the settings that it belongs to.

    Args:
      earlier: The published results, of the last episode that was simulated.

    Raises:
      ValueError: If all episodes were simulated: the final test needs the last one's trials.
    """
    the_plan = plan.Strategies(**earlier.plan | {"strategies": tuple(earlier.strategies)})
    if earlier.episodes >= the_plan.episodes:
        raise ValueError("all episodes were simulated; their trials are only in the state file")
    settings = dict(earlier.notes["settings"])
    the_scene = scene.load(str(settings["scene"]))
    if record.scene_hash(the_scene) != settings["scene_sha256"]:
        raise ValueError(f"scene {settings['scene']} has changed since")
    space = parameters.design_space(the_scene.hand, the_plan.preset)
    state = Batch.blank_of(the_plan, space.num_parameters, earlier.data["final_particles"])
    state |= {name: earlier.data[name] for name in BEFORE}
    state |= {
        "step": np.int64(earlier.episodes),
        "screened": np.int64(earlier.notes["grasps_that_screened_seeds"]),
        "seconds": np.float64(earlier.notes["wall_seconds"]),
        "processes": np.int64(earlier.notes["processes"]),
    }
    return state, settings


def join(earlier: Study, later: Study) -> Arrays:
    """Later results, with the earlier ones' episodes as they were published."""
    done, joined = earlier.episodes, dict(later.data)
    for name in BY_EPISODE:
        joined[name] = np.concatenate([earlier.data[name], later.data[name][:, :, done:]], axis=2)
    name = "particle_cost"  # of one strategy: (run, episode, particle)
    joined[name] = np.concatenate([earlier.data[name], later.data[name][:, done:]], axis=1)
    return joined


def main() -> int:
    """Runs the command and returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("action", choices=["start", "join"])
    parser.add_argument("experiment", choices=["2d", "23d"])
    parser.add_argument("published", type=Path, help="folder of the earlier results")
    parser.add_argument("out", type=Path, help="folder of the state, or of the later results")
    args = parser.parse_args()
    earlier = study.load_study(args.published, args.experiment)
    if earlier is None:
        sys.exit(f"error: {args.published} has no results of {args.experiment}")
    if args.action == "start":
        try:
            state, settings = start(earlier)
        except ValueError as error:
            sys.exit(f"error: {error}")
        args.out.mkdir(parents=True, exist_ok=True)
        record.save(args.out / f"{args.experiment}.state.npz", state, settings)
        return 0
    later = study.load_study(args.out, args.experiment)
    if later is None:
        sys.exit(f"error: {args.out} has no results of {args.experiment}")
    kept = ("command", "commit", "device", "num_devices", "first_episodes")
    before = {k: earlier.notes[k] for k in kept if k in earlier.notes}
    notes = later.notes | {"first_episodes": before | {"episodes": earlier.episodes}}
    results.write(args.published, args.experiment, join(earlier, later), notes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
