"""The paper's experiments: every strategy and run of one in a single batch of worlds."""

from codesign_jax.experiments.batch import Batch
from codesign_jax.experiments.driver import Stop, drive
from codesign_jax.experiments.landscape import Grid
from codesign_jax.experiments.plan import PAPER, TOTAL_GRASPS, Landscape, Strategies
from codesign_jax.experiments.worlds import Worlds

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
