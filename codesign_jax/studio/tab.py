"""What one tab of `codesign studio` shows: grasps of a design, their verdict, a search from there.

A tab takes messages of its page at any time (`Tab.receive`), and simulates a step at a time when
it is told to (`Tab.step`): first the newest grasp that is asked for, and once the sliders rest,
trial by trial, what the verdict needs. What was asked for in between is dropped.
"""

import collections
import functools
import json
import os
import shlex
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from codesign_jax import codesign, files, runs
from codesign_jax.commands import common
from codesign_jax.judge import sentences, stress, verdict
from codesign_jax.judge.sentences import Judged
from codesign_jax.judge.verdict import VERDICTS
from codesign_jax.model import morphology, overlap
from codesign_jax.optimize import Screened
from codesign_jax.report import animation, bodies, viewer
from codesign_jax.runs import selection
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import fingers_of
from codesign_jax.scene.schema import InputError
from codesign_jax.studio import process
from codesign_jax.studio.desk import COUNTS, Bench, Desk, View
from codesign_jax.types import Outcome, failed

PARTICLES = 20
EPISODES = 15
SIGMA = 0.12
"""Of `improve`: designs of an episode, episodes, and how far the first ones lie from the design, as
a standard deviation in shares of the parameters' ranges."""
LOOKED_AT = 15
"""States of a grasp in which overlaps are sought: a tenth of a second."""


class ShownGrasp(NamedTuple):
    """What a tab shows: what was asked for, with a legal design, and the grasp that came of it."""

    view: View
    bench: Bench
    grasp: animation.Replay

    @property
    def forces(self) -> Any:
        """Contact forces, where they were recorded."""
        return self.grasp.trace and self.grasp.trace.forces


class Tab:
    """What one tab of a browser shows and asks for."""

    def __init__(self, desk: Desk, tell: Callable[[str, Any], None] | None = None) -> None:
        """Takes what all tabs share, and who sends what a command tells, which outlives a tab."""
        self._desk = desk
        self._tell = tell or self.send
        self._asked: collections.deque[View] = collections.deque(maxlen=1)  # the newest
        self._actions: collections.deque[Callable[[], None]] = collections.deque()
        self._shown: ShownGrasp | None = None
        self._looked = self._pictured = False
        self._outcomes: list[Outcome] = []  # of trials of the design that is shown
        self._search: tuple[Any, Any, int] | None = None  # optimiser, state, episodes done
        self._outbox: dict[str, Any] = {}
        self._filled = threading.Condition()
        self._closed = False

    # ---- messages: the newest one of each kind, so that a slow browser holds up nobody

    def send(self, kind: str, content: Any) -> None:
        """Puts a message in place of an older one of its kind that was not sent yet."""
        with self._filled:
            self._outbox.pop(kind, None)
            self._outbox[kind] = content
            self._filled.notify()

    def messages(self) -> dict[str, Any] | None:
        """Waits for messages, by kind; None once the tab is closed."""
        with self._filled:
            self._filled.wait_for(lambda: self._outbox or self._closed)
            messages = self._outbox
            self._outbox = {}
            return None if self._closed else messages

    def close(self) -> None:
        """There are no more messages."""
        with self._filled:
            self._closed = True
            self._filled.notify()

    def receive(self, text: str | bytes) -> None:
        """Takes a message of the page; what is none is answered by an error."""
        actions = {"improve": self._begin, "save": self._save, "export": self._export}
        actions |= {"page": self._page, "report": self._report}
        try:
            [(kind, content)] = json.loads(text).items()
            if kind == "show":
                self._asked.append(self._view(**content))
            elif kind == "run":
                numbers = content and [int(v) for v in content]
                self._actions.append(lambda: self._of_run(numbers))
            else:
                self._actions.append(actions[kind])
        except Exception as error:  # whatever is sent, the tab goes on
            self.send("error", f"not a message of this page: {error}"[:300])

    def _view(
        self,
        number: int,
        resting: bool,
        design: list[float],
        object: int,
        noise: int | None,
        accuracy: str,
        trials: int,
        pictures: bool = False,
    ) -> View:
        """What a message asks for; an error if there is no such thing."""
        space = self._desk.case.space
        values = np.array(design, float)
        if values.shape != space.low.shape or not np.isfinite(values).all():
            raise ValueError(f"a design has {space.num_parameters} numbers")
        shapes = range(len(self._desk.case.scene.objects.object))
        legal = np.clip(values * np.array(space.scale), space.low, space.high)
        return View(
            legal,
            _choice(accuracy, self._desk.accuracies),
            _choice(object, shapes),
            _choice(noise, (None, *range(max(COUNTS)))),
            _choice(trials, COUNTS),
            bool(resting),
            int(number),
            bool(pictures),
        )

    # ---- the worker's part

    def step(self) -> bool:
        """Does the next thing, if there is one; an error is shown and ends what it was about."""
        work, end = self._next()
        if work is None:
            return False
        try:
            work()
        except Exception as error:  # the studio goes on
            end()
            self.send("error", _words(error))
        return True

    def _next(self) -> tuple[Callable[[], None] | None, Callable[[], None]]:
        """What is to be done next, if anything is, and what ends if that fails."""
        if self._asked:
            return self._take, self._forget
        if self._actions:
            return self._actions.popleft(), lambda: None  # what is shown stays
        if (shown := self._shown) is None:
            return None, self._forget
        if self._search:
            return functools.partial(self._improve, shown, *self._search), self._end_search
        work = self._following(shown) if shown.view.resting else None
        return functools.partial(work, shown) if work else None, self._rest

    def _following(self, shown: ShownGrasp) -> Callable[[ShownGrasp], None] | None:
        """What is still to be told of a design whose sliders rest."""
        if shown.view.pictures and not self._pictured:
            return self._tell_pictures
        # Forces take as long as the grasp: they come after it, once the sliders rest.
        if shown.bench.recorder and not shown.forces:
            return self._tell_forces
        if self._total < shown.view.trials:
            return self._tell_trials
        return None if self._looked else self._tell_overlap

    def _take(self) -> None:
        view = self._asked.popleft()
        if view.number is not None:  # the page's: a slider was moved
            self._end_search()
        self._show(view)

    def _forget(self) -> None:
        """There is no grasp of the design that was asked for."""
        self._shown = None
        self._end_search()

    def _rest(self) -> None:
        """What is shown stays; nothing else is told of it."""
        if shown := self._shown:
            self._shown = shown._replace(view=shown.view._replace(resting=False))

    def _tell_pictures(self, shown: ShownGrasp) -> None:
        self._pictured = True
        self.send("pictures", viewer.strip(shown.bench.case.scene, shown.grasp))

    def _tell_forces(self, shown: ShownGrasp) -> None:
        self._compiling(shown.bench, "its forces")
        self._shown = shown._replace(grasp=shown.bench.grasp(shown.view, shown.bench.recorder))
        self.send("grasp", _grasp_message(self._shown))

    def _tell_trials(self, shown: ShownGrasp) -> None:
        self._compiling(shown.bench, "the verdict")
        remaining = shown.view.trials - self._total
        outcomes = shown.bench.outcomes(shown.view.design, self._total)
        self._outcomes.append(jax.tree.map(lambda v: v[:remaining], outcomes))
        self._tell_verdict(shown)

    def _tell_overlap(self, shown: ShownGrasp) -> None:
        self._looked = True
        self.send("overlap", deepest_overlap(shown.bench.case.scene, shown.grasp))

    @property
    def _total(self) -> int:
        return sum(len(part.cost) for part in self._outcomes)

    def _compiling(self, bench: Bench, name: str) -> None:
        """Says which program of an accuracy is compiled by what follows, if one is."""
        self.send("stage", bench.stage(name))

    def _show(self, view: View) -> None:
        bench = self._desk.bench(view.accuracy)
        before = self._shown
        space = bench.case.space.of_table
        view = view._replace(design=np.asarray(space.project(view.design), float))
        same = before and before.bench is bench and np.array_equal(before.view.design, view.design)
        if not (before and same):
            self._outcomes = []
            before = None
        if before and (before.view.shape, before.view.noise) == (view.shape, view.noise):
            shown = before._replace(view=view)  # a slider was let go where it has been seen
        else:
            self._compiling(bench, "the grasp")
            shown = ShownGrasp(view, bench, bench.grasp(view))
        self._shown = shown
        self._looked = False
        self._pictured = False
        self.send("grasp", _grasp_message(shown))
        if view.resting:
            self._tell_verdict(shown)

    def _tell_verdict(self, shown: ShownGrasp) -> None:
        view = shown.view
        scene = shown.bench.case.scene
        ends: list[int] = []
        sentence = "the verdict comes ..."
        word = ""
        cost = None
        if self._outcomes:
            outcomes = jax.tree.map(lambda *v: np.concatenate(v)[: view.trials], *self._outcomes)
            ends = verdict.verdicts(outcomes).tolist()
            judged = sentences.Judged(scene, outcomes, grasps="grasps")
            sentence = _sentence(judged)
            word = judged.verdict.word
            self.send("stage", None)
            if causes := str(verdict.losses(scene, outcomes)):
                sentence += f". Lost: {causes}"
            if not failed(outcomes.status).all():
                cost = float(codesign.particle_cost(scene, outcomes))
        design = common.shortest(shown.bench.case.space, view.design)
        message = {"number": view.number, "total": view.trials, "design": design}
        said = {"sentence": sentence, "word": word}
        self.send("verdict", message | said | {"ends": ends, "cost": cost})

    # ---- a search from here

    def _begin(self) -> None:
        shown = self._current()
        if self._search:
            self._end_search()
            self._asked.append(shown.view._replace(resting=True, number=None))
            return
        space = codesign.make_filter(shown.bench.case.space).space
        optimizer = Screened(space, screening=0, retests=0, sigma=SIGMA)
        state = optimizer.init(jax.random.key(0), shown.view.design, PARTICLES)
        self._search = optimizer, state, 0
        self.send("improving", True)
        self.send("state", f"improving: compiling, then {EPISODES} steps ...")

    def _end_search(self) -> None:
        if self._search:
            self._search = None
            self.send("improving", False)
            self.send("state", "")

    def _improve(self, shown: ShownGrasp, optimizer: Any, state: Any, done: int) -> None:
        """One episode, whose answer so far is shown."""
        state, info = shown.bench.task.episode(optimizer, state)
        ends = verdict.verdicts(jax.tree.map(np.asarray, info.outcomes))
        if self._asked:  # a slider was moved meanwhile
            return
        done += 1
        self._search = optimizer, state, done
        answer = np.asarray(state.particles, float)[0]
        resting = done == EPISODES
        self._asked.append(shown.view._replace(design=answer, resting=resting, number=None))
        share = 100 * (ends == VERDICTS.index("kept")).mean()
        self.send("state", f"improving: {done} of {EPISODES}, designs around it keep {share:.0f} %")
        if resting:
            self._end_search()

    # ---- the run, and what is written

    def _current(self) -> ShownGrasp:
        if self._shown is None:
            raise InputError.of("missing", "there is no grasp of this design; move a slider")
        return self._shown

    def _of_run(self, numbers: list[int] | None) -> None:
        """Shows a particle of an episode, counted from 1; the chosen design without a place."""
        design = self._desk.case.design
        desk = self._desk
        if numbers is not None and desk.record is not None:
            e, p = numbers
            design = selection.find_grasp(
                desk.case.scene, desk.record, episode=e, particle=p
            ).design
        view = self._current().view
        self._asked.append(view._replace(design=design, resting=True, number=None))

    def _save(self) -> None:
        words = ["codesign", "studio", *self._saved()]
        self.send("done", f"saved; to open it again:\n{shlex.join(words)}")

    def _saved(self) -> list[str]:
        """Saves the design that is shown; words that name it to another command."""
        view = self._current().view
        space = self._desk.case.space
        text = common.design_text(space, self._desk.file, view.design)
        with self._desk.reserved("design", ".toml") as path, files.atomically(path) as part:
            part.write_text(text, encoding="utf-8")
        return [str(path), *self._desk.flags(view.accuracy)]

    def _page(self) -> None:
        view, bench, grasp = self._current()
        space = bench.case.space
        lines = [runs.describe(space, view.design), verdict.ending(grasp.outcome)]
        with self._desk.reserved("grasp", ".html") as path:
            viewer.write(bench.case.scene, grasp, path, title="A grasp in 3D", text=lines)
        self.send("done", f"written: {path}, for any browser, offline")

    def _export(self) -> None:
        process.check()  # before anything is written for it
        with self._desk.reserved("export") as folder:
            self._command("export", *self._saved(), "--out", str(folder))

    def _report(self) -> None:
        if self._desk.options.run_folder is None:
            raise InputError.of("missing", "there is no run to report")
        self._command("report", str(self._desk.options.run_folder))

    def _command(self, *words: str) -> None:
        process.start(words, lambda text: self._tell("done", text))


def _choice(value: Any, known: Sequence[Any]) -> Any:
    """That one of the known values which equals a value of a message; ValueError without one."""
    if value not in known:
        raise ValueError(f"{value!r} is not one of the choices")
    return known[known.index(value)]  # of its own type: True and 1.0 equal 1


def _words(error: Exception) -> str:
    """What an error says on the page."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return f"{os.fsdecode(error.filename or 'a file')}: {error.strerror}"
    return f"{type(error).__name__}: {error}"[:1000]


def _sentence(judged: Judged) -> str:
    """The verdict, or what is known before it: the few trials of a page seldom decide."""
    if judged.verdict.word != verdict.OPEN:
        return str(judged)
    counts = verdict.tally(judged.outcomes)
    grasps = f"{counts.kept} of {counts.total} grasps kept of {sentences.objects(judged.scene)}"
    return f"{grasps}; {judged.verdict.further}"


def _grasp_message(shown: ShownGrasp) -> dict[str, Any]:
    view, bench, grasp = shown
    scene = bench.case.scene
    space = bench.case.space
    replay = viewer.data(scene, grasp) | {"loop": True}
    step = max(1, round(1 / (replay["rate"] * scene.discretization.timestep)))
    series: dict[str, Any] = {
        name: np.round(1e3 * np.asarray(getattr(grasp.trace, name))[::step], 1).tolist()
        for name in ("distance", "height")
    }
    if forces := shown.forces:
        series["grip"] = np.round(np.asarray(forces.grip)[::step].T, 2).tolist()
    caps = np.asarray(morphology.pressure_limits(scene.hand, grasp.params))
    limits: list[float | None] = []
    for name, scale in zip(space.names, space.scale, strict=True):
        row = name.partition("[")[0]
        cap = caps[fingers_of(name) or slice(None)].min()
        limits.append(float(cap / scale) if row == "pressure" else None)
    return {
        "number": view.number,
        "replay": replay,
        "design": common.shortest(space, view.design),
        "limits": limits,
        "ending": verdict.ending(grasp.outcome),
        "cost": float(grasp.outcome.cost),
        "warnings": stress.of_design(scene, grasp.params),
        "series": series | {"lost": 1e3 * scene.cost.lost_distance},
    }


def deepest_overlap(scene: Scene, grasp: animation.Replay) -> str:
    """How deep fingers stand in one another, in themselves and in the palm, in words."""
    end = min(scene.window[1], float(grasp.outcome.lost_time))
    times = np.linspace(min(scene.phases.approach, end), end, LOOKED_AT)
    steps = (times / scene.discretization.timestep).astype(int)
    pose, size = bodies.at_steps(scene, grasp, np.minimum(steps, len(grasp.qpos) - 1))
    turns = Rotation.from_quat(pose[..., 3:].reshape(-1, 4), scalar_first=True).as_matrix()
    turns = turns.reshape(*pose.shape[:2], 3, 3)
    overlaps = overlap.overlaps(scene, grasp.params, pose[..., :3], turns, size)
    fingers, palm = (1e3 * depth.max() for depth in overlaps)
    return f"Deepest overlap: {fingers:.1f} mm in fingers, {palm:.1f} mm in the palm"
