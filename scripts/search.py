"""Which optimiser finds a good hand in the fewest grasps: many seeds of each, in lock step.

python -m scripts.search --out runs/search                      # again to go on where it stopped
python -m scripts.search --robust --masses 0.05 0.2 0.5         # what its winners keep at 500 g
python -m scripts.search --report docs/data/search              # tables of the note

At every mark the optimiser's best particles meet fresh trials, and the one that costs least in
these is what it recommends there: 25 particles in 12 trials each, or the final test of an optimiser
that says how many finalists it has.  These trials count as the search's; those by which the
recommended design is judged do not.  100 seeds with two marks take five minutes of an H200.
"""

import argparse
import dataclasses
import json
import re
import sys
import time
import zlib
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from codesign_jax import codesign, optimize, rollout, runs, use_compilation_cache
from codesign_jax import scene as scenes
from codesign_jax.batch import in_chunks
from codesign_jax.codesign import SUCCESS_COST
from codesign_jax.commands.common import changes
from codesign_jax.cost import particle_cost
from codesign_jax.engines import Engine, make_engine
from codesign_jax.optimize import NAMES, Optimizer, OptimizerState
from codesign_jax.reuse import SceneProgram
from codesign_jax.runs.progress import duration
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import DesignSpace, design_space
from codesign_jax.statistics import wilson
from codesign_jax.types import Outcome, Trial, failed
from codesign_jax.verdict import WANTED
from scripts.shared import output, provenance, work

CANDIDATES = 25
ROUNDS = 12
"""Most particles that are tested at a mark, and trials of each, but for whole turns of the objects;
an optimiser with `finalists` has its runs' final test."""
STREAM_JUDGE = 0x6A756467
"""Stream of the trials that judge a recommended design ("judg")."""
LONGEST_STEM = 100
"""Longest name of a study's files that says all of its changes."""
PAGE = Path("docs/notes/search.md")
LIMITED = "23d"
"""Preset of the whole table within the scene's limits."""
TABLE = "paper-23d"
"""Preset of the whole table without them."""


@dataclasses.dataclass(frozen=True)
class Case:
    """An optimiser with its sizes, by a name such as `screened-es:sigma=0.2,particles=12,tests=0`.

    Attributes:
      name: The name.
      optimizer: The optimiser.
      particles: Its particles.
      trials: Trials of each in an episode.
      tests: Trials of each finalist that choose at a mark; 0 recommends the state's first particle.
      finalists: Particles that these choose from.
    """

    name: str
    optimizer: Optimizer
    particles: int
    trials: int
    tests: int = ROUNDS
    finalists: int = CANDIDATES

    @property
    def worlds(self) -> int:
        return self.particles * self.trials


def make_case(name: str, space: DesignSpace, preset: str, objects: int = 3) -> Case:
    """A case by its name; what the name does not change has the command's defaults."""
    kind, _, changes = name.partition(":")
    given = dict(pair.split("=") for pair in changes.split(",") if pair)
    sizes = {n: int(given.pop(n)) for n in ("particles", "trials") if n in given}
    choices = preset, "concurrent", "morphology", "structured", 0
    usual = runs.make_settings(*choices, optimizer=kind, objects=objects, **sizes)
    made: Any = codesign.make_optimizer(kind, space)
    own_test = getattr(made, "finalists", None)
    tests = int(given.pop("tests", usual.test_trials if own_test else ROUNDS))
    finalists = min(own_test or CANDIDATES, usual.particles)
    if tests == 0 and not made.keeps_best:
        raise ValueError(f"{name}: tests=0 is for optimisers whose first particle is the best")
    options = {n: _as(type(getattr(made, n)), v) for n, v in given.items()}
    optimizer = dataclasses.replace(made, **options)
    return Case(name, optimizer, usual.particles, usual.trials, tests, finalists)


def _as(kind: type, text: str) -> Any:
    """A field's value from its text; "4.0" is a whole number too."""
    return text if kind is str else kind(float(text))


class Study:
    """The episodes of one case over many seeds, from a file and back to it."""

    def __init__(
        self,
        case: Case,
        scene: Scene,
        engine: Engine,
        space: DesignSpace,
        *,
        seeds: int,
        budget: int,
        tests: int,
        marks: int = 9,
        at: Sequence[int] = (),
        chunk: int,
        path: Path,
    ):
        self.case = case
        self.scene = scene
        self.engine = engine
        self.space = space
        self.tests = tests
        self.chunk = chunk
        self.path = path
        self.keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
        self.mask = jnp.ones(space.num_parameters, bool)
        objects = len(scene.objects.object)
        self.rounds = -(-case.tests // objects) * objects
        self.batch = min(chunk, seeds * case.worlds)
        self.simulate = SceneProgram(scene, jax.jit(self._simulate))
        task = codesign.Task(scene, space, case.trials, engine)
        self.episode = task.side_by_side(case.optimizer)
        episodes = self._episodes(budget)
        first = getattr(case.optimizer, "screening", 0) + getattr(case.optimizer, "retests", 0) + 1
        self.marks = sorted(
            {*map(self._episodes, at)}
            # Backwards, so that a single mark is the last one.
            or {*np.geomspace(episodes, min(first, episodes), marks).round().astype(int)}
        )
        self.kept: dict[int, np.ndarray] = {}
        self.designs: dict[int, np.ndarray] = {}
        self.state, self.last = self._restore() if path.exists() else (self._start(), None)

    def _episodes(self, grasps: int) -> int:
        """Episodes of a seed after which no more than so many grasps have been simulated."""
        return max(1, int((grasps - self.before - self.tested) / self.case.worlds))

    @property
    def before(self) -> int:
        """Grasps that find a poor seed particle."""
        return 0 if getattr(self.case.optimizer, "screens", False) else self.case.worlds

    @property
    def tested(self) -> int:
        """Grasps by which a mark chooses."""
        return self.case.finalists * self.rounds

    @property
    def done(self) -> int:
        return int(self.state.episode[0])

    @property
    def finished(self) -> bool:
        return len(self.kept) == len(self.marks)

    def step(self) -> int:
        """Simulates an episode, or judges the designs of a mark; returns its grasps."""
        if self.done in self.marks and self.done not in self.kept:
            return self._mark()

        def run(seeds: np.ndarray) -> tuple[Any, ...]:
            states = jax.tree.map(lambda v: v[seeds], self.state)
            new, info = self.episode(states, jnp.tile(self.mask, (len(seeds), 1)))
            return new._replace(key=None), info.population, info.selection.cost

        parts = in_chunks(run, len(self.keys), max(1, self.batch // self.case.worlds))
        state, population, cost = jax.tree.map(lambda *v: np.concatenate(v), *parts)
        self.state = state._replace(key=self.keys)  # root keys, which stay
        self.last = population, cost
        return cost.size * self.case.trials

    def save(self) -> None:
        arrays = {f"state{i}": leaf for i, leaf in enumerate(self._leaves())}
        for name, values in (("kept", self.kept), ("designs", self.designs)):
            arrays |= {f"{name}{mark}": value for mark, value in values.items()}
        if self.last is not None:
            arrays |= {"population": self.last[0], "cost": self.last[1]}
        output.write_arrays(self.path, {n: np.asarray(v) for n, v in arrays.items()})

    def row(self) -> dict[str, Any]:
        """Grasps of a seed at each mark, all counted, and the share that its design keeps."""
        marks = sorted(self.kept)
        return {
            "optimizer": self.case.name,
            "particles": self.case.particles,
            "trials": self.case.trials,
            "grasps": [int(self.before + e * self.case.worlds + self.tested) for e in marks],
            "kept": [np.round(self.kept[e], 4).tolist() for e in marks],
        }

    def _start(self) -> OptimizerState:
        space = self.case.optimizer.space
        first = np.arange(self.case.particles)
        drawn = jax.jit(jax.vmap(lambda key: optimize.candidates(key, space, first)))(self.keys)
        rows = jnp.zeros(len(self.keys), int)
        if self.before:
            noise = self._noise(codesign.STREAM_SCREEN, 0)
            poor = self._costs(self._all(drawn, noise, self.case.trials)) > codesign.SEED_COST
            if not np.asarray(poor.any(1)).all():
                raise RuntimeError("a seed has no poor particle among its first candidates")
            rows = poor.argmax(1)
        init = jax.vmap(lambda k, x: self.case.optimizer.init(k, x, self.case.particles))
        return jax.jit(init)(self.keys, drawn[jnp.arange(len(rows)), rows])

    def _mark(self) -> int:
        """Chooses from particles by fresh trials, and judges the chosen one by others."""
        assert self.last is not None
        particles = self.state.particles
        mark = self.done
        if not self.case.optimizer.keeps_best:
            order = jnp.argsort(jnp.asarray(self.last[1]), axis=1)[..., None]
            particles = jnp.take_along_axis(jnp.asarray(self.last[0]), order, 1)
        chosen = particles[:, : self.case.finalists]
        best = jnp.zeros(len(chosen), int)
        grasps = 0
        if self.rounds:
            noise = self._noise(codesign.STREAM_TEST, mark)
            tested = self._costs(self._all(chosen, noise, self.rounds))
            best = tested.argmin(1)
            grasps = tested.size * self.rounds
        design = chosen[jnp.arange(len(chosen)), best][:, None]
        self.designs[mark] = np.asarray(design[:, 0])
        self.kept[mark] = self.judge(self.designs[mark], self.scene)
        return grasps + len(chosen) * self.tests

    def judge(self, designs: np.ndarray, scene: Scene) -> np.ndarray:
        """Share of the judging trials that each seed's design keeps; the scene's numbers differ."""
        noise = self._noise(STREAM_JUDGE, 0)
        outcome = self._all(jnp.asarray(designs)[:, None], noise, self.tests, scene)
        kept = ~failed(np.asarray(outcome.status)) & (np.asarray(outcome.cost) < SUCCESS_COST)
        return kept[:, 0].mean(-1)

    def _noise(self, stream: int, index: int) -> jax.Array:
        return jax.vmap(lambda key: codesign.stream_key(key, stream, index))(self.keys)

    def _costs(self, outcome: Outcome) -> jax.Array:
        return jax.jit(lambda outcomes: particle_cost(self.scene, outcomes))(outcome)

    def _all(
        self, populations: jax.Array, keys: jax.Array, count: int, scene: Scene | None = None
    ) -> Outcome:
        """Outcomes of shape (seed, particle, trial) in the trials of these keys, by one program."""
        scene = scene or self.scene
        draw = lambda key: rollout.sample_trials(scene, key, count)  # noqa: E731
        trials = jax.tree.map(np.asarray, jax.vmap(draw)(keys))
        shape = (*populations.shape[:2], count)
        seed, particle, trial = np.indices(shape).reshape(3, -1)
        designs = np.asarray(populations)

        def run(rows: np.ndarray) -> Outcome:
            drawn = jax.tree.map(lambda v: v[seed[rows], trial[rows]], trials)
            return self.simulate(designs[seed[rows], particle[rows]], drawn, scene)

        parts = in_chunks(run, len(seed), self.batch)
        outcomes = jax.tree.map(lambda *v: np.concatenate(v), *parts)
        return jax.tree.map(lambda v: v.reshape(*shape, *v.shape[1:]), outcomes)

    def _simulate(self, designs: jax.Array, trials: Trial, scene: Scene) -> Outcome:
        hands = jax.vmap(self.space.params)(designs)
        return rollout.simulate(scene, self.engine, hands, trials)[0]

    def _leaves(self) -> list[jax.Array]:
        state = self.state._replace(key=jax.vmap(jax.random.key_data)(self.state.key))
        return jax.tree.leaves(state)

    def _restore(self) -> tuple[OptimizerState, Any]:
        """What a file holds of the study; the arrays' order is that of a state."""
        n = self.case.particles
        zeros = jnp.zeros(self.mask.shape)
        like = jax.eval_shape(jax.vmap(lambda k: self.case.optimizer.init(k, zeros, n)), self.keys)
        with np.load(self.path) as stored:
            shapes = jax.tree.leaves(like._replace(key=np.zeros(0)))
            leaves = [jnp.asarray(stored[f"state{i}"]) for i in range(len(shapes))]
            for name in stored:
                for word, values in (("kept", self.kept), ("designs", self.designs)):
                    if name.startswith(word):
                        values[int(name.removeprefix(word))] = stored[name]
            last = [jnp.asarray(stored[n]) for n in ("population", "cost") if n in stored]
        state = jax.tree.unflatten(jax.tree.structure(like), leaves)
        if state.particles.shape != like.particles.shape:
            raise ValueError(f"{self.path} is of other seeds or sizes: choose another folder")
        return state._replace(key=jax.vmap(jax.random.wrap_key_data)(state.key)), (*last,) or None


# --- tables --------------------------------------------------------------------------------------


def order(row: dict[str, Any]) -> tuple:
    """Where a row stands: 23D first, the paper's objects first, the default's order of names."""
    name = row["optimizer"].split(":")[0]
    place = NAMES.index(name) if name in NAMES else len(NAMES)
    few = row["preset"] not in (LIMITED, TABLE)
    return few, row["preset"] != LIMITED, row.get("objects") or "", place, row["optimizer"]


def table(rows: list[dict[str, Any]]) -> str:
    """A row for each optimiser: what its recommended designs keep at its last mark."""
    head = "optimiser|preset|hand|objects|seeds|grasps of a seed|median kept|"
    head += "5 % of the seeds below|"
    head += "share of seeds that keep 95 % (95 % interval)|commit"
    table_rows = [head.split("|")]
    for row in sorted((r for r in rows if not variant(r["optimizer"])), key=order):
        kept = np.array(row["kept"][-1])
        table_rows.append(
            [
                f"`{row['optimizer']}`",
                row["preset"],
                row.get("hand") or "pneuflex4",
                row.get("objects") or "three",
                str(kept.size),
                f"{row['grasps'][-1]:,}",
                f"{np.median(kept):.3f}",
                f"{np.quantile(kept, 0.05):.3f}",
                share_of(kept),
                row["provenance"]["commit"][:7],
            ]
        )
    return output.markdown(table_rows)


def variants_table(rows: list[dict[str, Any]]) -> str:
    """What one other constant of the default search is worth on the same seeds, at each mark."""
    table_rows = []
    for row in sorted(rows, key=lambda row: (row["optimizer"] != optimize.DEFAULT, order(row))):
        head = ["search"]
        cells = [f"`{row['optimizer']}`"]
        for grasps, kept in zip(row["grasps"], np.array(row["kept"]), strict=True):
            head += [f"after {grasps:,} grasps: seeds that keep 95 %", "5 % below", "mean kept"]
            cells += [share_of(kept), f"{np.quantile(kept, 0.05):.3f}", f"{kept.mean():.3f}"]
        table_rows = table_rows or [[*head, "commit"]]
        table_rows.append([*cells, row["provenance"]["commit"][:7]])
    return output.markdown(table_rows)


def masses_table(rows: list[dict[str, Any]]) -> str:
    """What recommended designs keep where every object has one of these masses."""
    table_rows = []
    for row in sorted((r for r in rows if "masses" in r), key=order):
        head = ["preset", "hand", "searched with"]
        objects = row.get("objects") or "objects as they are"
        cells = [row["preset"], row.get("hand") or "pneuflex4"]
        cells.append(" ".join(row["changes"]) or objects)
        for mass, kept in row["masses"].items():
            head += [f"{1e3 * float(mass):g} g: kept on average", "seeds that keep 95 %"]
            cells += [f"{np.mean(kept):.3f}", share_of(np.array(kept))]
        table_rows = table_rows or [[*head, "commit"]]
        table_rows.append([*cells, row["provenance"]["commit"][:7]])
    return output.markdown(table_rows)


def share_of(kept: np.ndarray) -> str:
    """Share of the seeds that keep `WANTED`, with its interval."""
    good = int((kept >= WANTED).sum())
    share = wilson(good, kept.size)
    return f"{good / kept.size:.2f} ({share.low:.2f} to {share.high:.2f})"


def variant(name: str) -> bool:
    """Whether a case's name changes more than an optimiser's sizes."""
    changes = {pair.split("=")[0] for pair in name.partition(":")[2].split(",") if pair}
    return not changes <= {"particles", "trials"}


# --- the command ----------------------------------------------------------------------------------


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = provenance.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/search"), help="folder")
    parser.add_argument("--preset", default=LIMITED)
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--hand", help="hand instead of the scene's")
    parser.add_argument("--objects", help="object set instead of the scene's")
    parser.add_argument("--robust", action="store_true", help="as of codesign optimize")
    parser.add_argument("--constants", help="as of codesign optimize")
    flag: dict[str, Any] = {"dest": "overrides", "nargs": "+", "action": "append", "default": []}
    parser.add_argument("--set", **flag, help="KEY=VALUE, as of codesign optimize")
    text = "judge the last designs once more with all objects at each of these masses [kg]"
    parser.add_argument("--masses", nargs="+", default=[], help=text)
    parser.add_argument("--designs", type=Path, help="judge those of an .npz at --masses alone")
    parser.add_argument(
        "--optimizers",
        nargs="+",
        default=[optimize.DEFAULT],
        help="names, each with changes if wanted: screened-es:sigma=0.2,particles=13,trials=6",
    )
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--budget", type=int, default=2400, help="grasps of a seed, all counted")
    parser.add_argument("--tests", type=int, default=400, help="trials of a recommended design")
    parser.add_argument("--marks", type=int, default=9, help="times at which one is recommended")
    parser.add_argument("--at", type=int, nargs="+", default=[], help="grasps instead of --marks")
    parser.add_argument("--report", type=Path, help="fill the page from a folder, and stop")
    parser.add_argument("--page", type=Path, default=PAGE)
    return parser.parse_args(arguments)


def search(args: argparse.Namespace, name: str) -> None:
    """Runs an optimiser's study to its end and writes what its designs keep."""
    files = {"hand_name": args.hand, "object_set": args.objects}
    scene = scenes.load(args.scene, **files, overrides=changes(args))
    engine = make_engine("structured", scene)
    space = design_space(scene.hand, args.preset)
    case = make_case(name, space, args.preset, len(scene.objects.object))
    changed = ["--robust"] * args.robust + [*chain.from_iterable(args.overrides)]
    changed += [f"--constants={Path(args.constants).stem}"] if args.constants else []
    words = [Path(name).stem for name in (args.hand, args.objects) if name]
    words += [args.preset, name, *(re.sub(r"^--|^[a-z_.]+[.](?=.*=)", "", c) for c in changed)]
    stem = re.sub("[:,]", "-", "-".join(dict.fromkeys(words))).replace("=", "")
    if len(stem) > LONGEST_STEM:
        stem = f"{stem[:LONGEST_STEM]}-{zlib.crc32(stem.encode()):08x}"
    arguments = {n: getattr(args, n) for n in ("seeds", "budget", "tests", "marks", "at")}
    arguments["chunk"] = 512 if jax.default_backend() == "cpu" else 16_384
    study = Study(case, scene, engine, space, **arguments, path=args.out / f"{stem}.npz")
    row = {"preset": args.preset, "scene": args.scene, "hand": args.hand, "objects": args.objects}
    row["changes"] = changed
    row |= {"tests": args.tests, "optimizer": name}
    grasps = 0
    start = time.monotonic()
    while not study.finished and args.designs is None:
        grasps += study.step()
        study.save()  # the next command goes on here, whatever ends this one
        rate = grasps / (time.monotonic() - start)
        print(f"{name}: episode {study.done}/{study.marks[-1]}, {rate:.0f} grasps/s", flush=True)
    if args.designs is None:
        row |= study.row()
    if args.masses:
        designs = work.winners(args.designs or study.path)[: args.seeds]
        row["masses"] = {m: study.judge(designs, at_mass(args, m)).tolist() for m in args.masses}
    row["seconds"] = round(time.monotonic() - start)
    row["provenance"] = provenance.results(args.commit)
    output.write_json(args.out / f"{stem}{'-masses' * bool(args.designs)}.json", row)
    shares = [sum(k >= WANTED for k in kept) / len(kept) for kept in study.row()["kept"]]
    print(name, study.row()["grasps"], shares, duration(row["seconds"]), flush=True)
    print({m: float(np.mean(kept)) for m, kept in row.get("masses", {}).items()}, flush=True)


def at_mass(args: argparse.Namespace, mass: str) -> Scene:
    """The scene and hand as their files have them, with each of its objects at a mass [kg].

    Objects are the scene's own, also for designs that were found with others.
    """
    plain = scenes.load(args.scene, hand_name=args.hand)
    masses = {("objects", "object", s.name, "mass"): float(mass) for s in plain.objects.object}
    return scenes.load(args.scene, hand_name=args.hand, overrides=masses)


def main(arguments: list[str] | None = None) -> int:
    args = parse(arguments)
    if args.report:
        rows = [json.loads(path.read_text()) for path in sorted(args.report.glob("*.json"))]
        if not rows:
            sys.exit(f"error: {args.report} has no results of scripts.search")
        plain = [row for row in rows if "kept" in row and not row.get("changes")]
        output.fill(args.page, table(plain), "search")
        same = [r for r in plain if (r["preset"], r.get("objects")) == (TABLE, None)]
        same = [row for row in same if row["optimizer"].startswith(optimize.DEFAULT)]
        output.fill(args.page, variants_table(same), "variants")
        if any("masses" in row for row in rows):
            output.fill(args.page, masses_table(rows), "masses")
        return 0
    use_compilation_cache()
    try:
        for name in args.optimizers:
            search(args, name)
    except KeyboardInterrupt:
        print("stopped; the same command goes on")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
