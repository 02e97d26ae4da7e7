"""The paper's experiments: every strategy and run of one in a single batch of worlds."""

from scripts.experiments.batch import Batch
from scripts.experiments.landscape import Grid
from scripts.experiments.plan import PAPER, TOTAL_GRASPS, Landscape, Strategies
from scripts.experiments.worlds import Worlds
from scripts.shared.driver import Stop, drive

__all__ = [
    "PAPER",
    "TOTAL_GRASPS",
    "Batch",
    "Grid",
    "Landscape",
    "Stop",
    "Strategies",
    "Worlds",
    "drive",
]
