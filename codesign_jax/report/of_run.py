"""What a report is made from."""

from pathlib import Path
from typing import Any, NamedTuple

from codesign_jax import types
from codesign_jax.runs import Settings
from codesign_jax.runs.choice import Chosen
from codesign_jax.runs.record import History, Record
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space


class Run(NamedTuple):
    """A run to report on.

    Attributes:
      folder: Its folder.
      scene: Its scene.
      settings: Its settings.
      record: Its episodes, at least one.
      chosen: The design it found.
      provenance: Content of its provenance.json.
      reference: Outcomes of the design's fresh trials at the end of the run, every array of shape
        (trial,); None without them.
      notes: What is amiss with the run, in sentences.
    """

    folder: Path
    scene: Scene
    settings: Settings
    record: Record
    chosen: Chosen
    provenance: dict[str, Any]
    reference: types.Outcome | None = None
    notes: tuple[str, ...] = ()

    @property
    def space(self) -> DesignSpace:
        """The design space."""
        return design_space(self.scene.hand, self.settings.preset)

    @property
    def history(self) -> History:
        """Reports of the finished episodes."""
        h, done = self.record.history, self.record.done
        trials = types.Outcome(*(v[:done] for v in h.trials))
        return History(h.population[:done], trials, *(v[:done] for v in h[2:]))
