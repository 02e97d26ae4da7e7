"""Results of a study in one file: a case is measured once, and again only if it broke off."""

import dataclasses
import json
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from codesign_jax.scene.schema import InputError
from scripts.accuracy.settings import Setting
from scripts.shared import output, provenance

ATTEMPTS = 2
"""Times that a case is begun before it counts as failed where it never ends."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One measurement.

    Attributes:
      part: Part of the study.
      setting: What is measured.
      more: Further words that name the case.
      run: Returns the measurement.
    """

    part: str
    setting: Setting
    more: tuple[str, ...]
    run: Callable[[], dict[str, Any]] = dataclasses.field(compare=False)

    @property
    def key(self) -> str:
        """Name of the case in the file."""
        return " | ".join([self.part, self.setting.engine, self.setting.label, *self.more])


class Store:
    """The records of a study, written after every case."""

    def __init__(self, path: Path, *, size: str, commit: str | None = None):
        """Opens or begins a file.

        Args:
          path: JSON file.
          size: Name of the study's size; a file holds one.
          commit: Commit of the code, for a machine without git.

        Raises:
          ValueError: If the file belongs to another size.
        """
        self.path = path
        self.data: dict[str, Any] = {"size": size, "runs": [], "attempts": {}, "records": {}}
        if path.exists():
            self.data = json.loads(path.read_text())
        if self.data["size"] != size:
            raise ValueError(f"{path} holds the size {self.data['size']!r}, not {size!r}")
        self.data["runs"].append(provenance.measurement(commit))

    def done(self, case: Case) -> bool:
        """Whether a case has its record, or broke off too often."""
        key = case.key
        if key not in self.data["records"] and self.data["attempts"].get(key, 0) >= ATTEMPTS:
            self._add(case, {"failed": "did not end in two runs: killed, or out of memory"})
        return key in self.data["records"]

    def measure(self, case: Case) -> dict[str, Any]:
        """Runs a case and keeps its record; an exception makes a record that says so."""
        attempts = self.data["attempts"]
        attempts[case.key] = attempts.get(case.key, 0) + 1
        self.write()
        start = time.perf_counter()
        try:
            record = case.run()
        except InputError as error:
            record = {"refused": "; ".join(error.problems)}
        except Exception as error:  # a setting that fails is a result of the study
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(last.filename).name}:{last.lineno}"
            record = {"failed": f"{type(error).__name__}: {str(error)[:300]} ({where})"}
        record["took_s"] = round(time.perf_counter() - start, 2)
        self._add(case, record)
        return record

    def _add(self, case: Case, record: dict[str, Any]) -> None:
        self.data["records"][case.key] = {
            "part": case.part,
            "setting": dataclasses.asdict(case.setting),
            "label": case.setting.label,
            "more": list(case.more),
            "run": len(self.data["runs"]) - 1,
            **record,
        }
        self.data["attempts"].pop(case.key, None)
        self.write()

    def write(self) -> None:
        """Writes the file as a whole or not at all."""
        output.write_json(self.path, self.data, indent=None)


def merge(files: Sequence[Path], path: Path) -> None:
    """Writes the records of several files, as processes with `--share` made them, into one.

    Args:
      files: JSON files of one size.
      path: The file.

    Raises:
      ValueError: If they are of several sizes.
    """
    every = [json.loads(file.read_text()) for file in files]
    sizes = {data["size"] for data in every}
    if len(sizes) != 1:
        raise ValueError(f"the files hold the sizes {', '.join(sorted(sizes))}, not one")
    runs: list[dict[str, Any]] = []
    records: dict[str, Any] = {}
    for data in every:
        kept: dict[int, int] = {}
        for key, record in data["records"].items():
            if record["run"] not in kept:  # a run that measured nothing says nothing
                kept[record["run"]] = len(runs)
                runs.append(data["runs"][record["run"]])
            records[key] = record | {"run": kept[record["run"]]}
    merged = {"size": sizes.pop(), "runs": runs, "attempts": {}, "records": records}
    output.write_json(path, merged, indent=None)
