"""What all tabs of `codesign studio` share: a scene with its programs, a run, and a folder."""

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import Task, files, rollout, runs
from codesign_jax.commands import common
from codesign_jax.commands.flags import Studio as Options
from codesign_jax.engines import Engine
from codesign_jax.engines.base import recording, tells_forces
from codesign_jax.judge.cases import Case
from codesign_jax.judge.sentences import Judged
from codesign_jax.report import animation
from codesign_jax.runs import reference, selection
from codesign_jax.scene import Scene, accuracy_name, library
from codesign_jax.scene.loading import with_accuracy
from codesign_jax.types import Outcome, Params, Trial

COUNTS = (24, 48, 96, 240)
"""Numbers of trials that a verdict may have."""
BATCH = 3
"""Trials of one step: more would keep the next grasp waiting."""


class View(NamedTuple):
    """What a tab asks to be shown."""

    design: np.ndarray  # the design [SI units], shape (parameter,)
    accuracy: str  # name of an accuracy; empty for the scene's own
    shape: int  # index of the object, where there is no noise
    # Which of the trials of the verdict it is, with its object; None without noise
    noise: int | None
    trials: int  # number of trials of the verdict
    resting: bool  # whether the sliders rest, so that the verdict may follow
    # The tab's own number of the request; None for a design that the studio puts there
    number: int | None
    pictures: bool = False  # whether the page draws nothing itself, and shows pictures


class Bench:
    """A scene at one accuracy, with the programs that simulate it."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.engine = case.make_engine()
        self.recorder = recording(self.engine, touch=True) if tells_forces(self.engine) else None
        self.objects = len(case.scene.objects.object)
        self.stages = ("the grasp", *(["its forces"] if self.recorder else []), "the verdict")
        self._compiled: set[str] = set()

    def stage(self, name: str) -> dict[str, Any] | None:
        """What is compiled now if a stage is simulated; None if it was simulated before."""
        if name in self._compiled:
            return None
        self._compiled.add(name)
        return {"name": name, "number": self.stages.index(name) + 1, "of": len(self.stages)}

    @functools.cached_property
    def trials(self) -> Trial:
        """The first trials of `codesign evaluate --seed 0`."""
        drawn = rollout.sample_trials(self.case.scene, jax.random.key(0), max(COUNTS) + BATCH)
        return jax.tree.map(np.asarray, drawn)

    @functools.cached_property
    def task(self) -> Task:
        """What `improve` searches by."""
        return Task(self.case.scene, self.case.space, max(self.objects, BATCH), self.engine)

    def params(self, design: np.ndarray) -> Params:
        """Parameters of a design as they are simulated."""
        return self.case.space.params(jnp.asarray(design, jnp.float32))

    def grasp(self, view: View, engine: Engine | None = None) -> animation.Replay:
        """Simulates what is shown, with forces if the engine is the recorder."""
        trial = rollout.nominal_trial(self.case.scene, view.shape)
        if view.noise is not None:
            trial = jax.tree.map(lambda v: v[view.noise], self.trials)
        trials = jax.tree.map(lambda v: jnp.asarray(v)[None], trial)
        params = self.params(view.design)
        return animation.replay(self.case.scene, engine or self.engine, params, trials)[0]

    def outcomes(self, design: np.ndarray, first: int) -> Outcome:
        """Outcomes of the next `BATCH` trials, arrays of shape (trial,)."""
        trials = jax.tree.map(lambda v: v[first : first + BATCH], self.trials)
        outcomes = _outcomes(self.case.scene, self.engine, self.params(design), trials)
        return jax.tree.map(np.asarray, outcomes)

    def warm(self, design: np.ndarray, tell: Callable[[dict[str, Any] | None], None]) -> None:
        """Compiles what a moved slider needs; tells each stage, and None at the end."""
        view = View(design, "", 0, None, 0, False, None)
        work = {
            "the grasp": lambda: self.grasp(view),
            "its forces": lambda: self.grasp(view, self.recorder),
            "the verdict": lambda: self.outcomes(design, 0),
        }
        for name in self.stages:
            tell(self.stage(name))
            work[name]()
        tell(None)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _outcomes(scene: Scene, engine: Engine, params: Params, trials: Trial) -> Outcome:
    hands = jax.tree.map(lambda v: v[None], params)
    return jax.tree.map(lambda v: v[0], rollout.evaluate(scene, engine, hands, trials))


class Desk:
    """What all tabs share: a case with its programs, its run, and where files go."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.case = common.find_case(options)
        common.refuse(common.engine_problems(self.case.engine))
        self.file = common.design_file(options)
        self.record = None
        if folder := options.run_folder:
            fields = {
                "preset": runs.read_run(folder)[1].preset,
                "scene": str(folder / "scene.toml"),
            }
            self.file = dataclasses.replace(self.file, **fields)
            self.record = selection.read_record(
                folder, tell=lambda text: None
            )  # `find_case` said it
        self.accuracies = ("", *library.available("accuracy"))
        self.benches: dict[str, Bench] = {}

    def bench(self, accuracy: str) -> Bench:
        """The programs of an accuracy."""
        if accuracy not in self.benches:
            case = self.case
            if accuracy:
                case = case._replace(scene=with_accuracy(case.scene, accuracy))
            self.benches[accuracy] = Bench(case)
        return self.benches[accuracy]

    @functools.cached_property
    def judged(self) -> Judged | None:
        """The trials that judge the run's recommended design; None without a run.

        A page says what it simulates itself: other trials, at the accuracy that is chosen there.
        """
        folder = self.options.run_folder
        if folder is None or self.record is None:
            return None
        scene, settings = runs.read_run(folder)
        kept = reference.kept(folder, scene, settings)
        chosen = selection.choose(scene, self.record)
        if not chosen.tested:
            scene = runs.read_search_scene(folder)
        return kept.fresh or chosen.judged(scene, kept.stress)

    @property
    def accuracy(self) -> str:
        """The scene's own accuracy in words, by the name of the one that it equals."""
        name = accuracy_name(self.case.scene)
        return f"{name} (the scene's)" if name else "the scene's own"

    def flags(self, accuracy: str) -> list[str]:
        """Flags that name to another command what a design's file does not."""
        options = self.options
        named = {"accuracy": accuracy or self.options.accuracy}
        named |= {"engine": self.case.engine, "policy": options.policy}
        named |= {"constants": options.constants}
        flags = [word for k, v in named.items() if v is not None for word in (f"--{k}", v)]
        for words in options.overrides:
            flags += ["--set", *words]
        flags += ["--rigid-mount"] * options.rigid_mount
        return flags + ["--robust"] * options.robust

    @contextlib.contextmanager
    def reserved(self, stem: str, ending: str = "") -> Iterator[Path]:
        """A new file in the folder of what is saved, or without an ending a new folder.

        It is made at once, so that nobody else gets its name, and removed after an error.
        """
        self.options.out.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            path = self.options.out / f"{stem}-{number}{ending}"
            try:
                path.touch(exist_ok=False) if ending else path.mkdir()
            except FileExistsError:
                continue
            break
        try:
            yield path
        except BaseException:
            files.remove(path)
            raise
