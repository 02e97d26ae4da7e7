"""The inputs of a report."""

from pathlib import Path
from typing import Any, NamedTuple

import jax

from codesign_jax.judge.sentences import Judged
from codesign_jax.judge.stress import Stress
from codesign_jax.judge.worth import Worth
from codesign_jax.runs import Settings, read_search_scene
from codesign_jax.runs.record import History, Record
from codesign_jax.runs.selection import Chosen
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space


class Run(NamedTuple):
    """A run to report on."""

    folder: Path
    scene: Scene
    settings: Settings
    record: Record  # its episodes, at least one
    chosen: Chosen  # the design it found
    provenance: dict[str, Any]  # content of its provenance.json
    # The design's fresh trials at the end of the run; None without them
    reference: Judged | None = None
    notes: tuple[str, ...] = ()  # what is amiss with the run, in sentences
    stress: Stress | None = None  # the design's grasps under other conditions; None without them
    worth: Worth | None = None  # its grasps without some of its fingers; None without them

    @property
    def judged(self) -> Judged:
        """The trials that judge the design: the fresh ones, or else those that chose it."""
        scene = self.scene if self.chosen.tested else self.search_scene
        return self.reference or self.chosen.judged(scene, self.stress)

    @property
    def search_scene(self) -> Scene:
        """The scene that the episodes simulated."""
        return read_search_scene(self.folder)

    @property
    def space(self) -> DesignSpace:
        return design_space(self.scene.hand, self.settings.preset)

    @property
    def history(self) -> History:
        """Reports of the finished episodes."""
        h = self.record.history
        done = self.record.done
        trials = jax.tree.map(lambda v: v[:done], h.outcomes)
        return History(h.population[:done], trials, *(v[:done] for v in h[2:]))
