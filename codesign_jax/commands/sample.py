"""`codesign sample`."""

from pathlib import Path

import jax
import numpy as np

from codesign_jax import batch, files, preflight, sampling
from codesign_jax.commands import common
from codesign_jax.commands.flags import Sample
from codesign_jax.engines import Engine, make_engine
from codesign_jax.interrupts import Interrupts, Stopped
from codesign_jax.judge.verdict import VERDICTS, verdicts
from codesign_jax.runs import dataset
from codesign_jax.runs.dataset import Question, Shards
from codesign_jax.runs.directory import locked
from codesign_jax.runs.progress import Meter
from codesign_jax.scene import Scene
from codesign_jax.scene.parameters import design_space
from codesign_jax.scene.schema import Problem
from codesign_jax.terminal import Console
from codesign_jax.types import Outcome

MOST = 1_000_000_000
"""Most designs of a file: their indices are int32."""


def main(options: Sample) -> int:
    common.use_compilation_cache()
    _check(options)
    scene = common.load_scene(options)
    question = _question(options, scene)
    engine = make_engine(options.engine, scene)
    console = Console()
    outcomes = Shards(options.out)
    outcomes.refuse_other(question)
    designs = {"the default design": question.space.default()}
    for note in preflight.notes(scene, question.space, designs):
        console.print(note)
    count = question.shards(options.designs)
    console.print(f"{_amount(options)} in {common.counted(count, 'call')}")
    if options.dry_run:
        return 0
    outcomes.folder.mkdir(parents=True, exist_ok=True)
    with locked(outcomes.folder):
        outcomes.begin(question)
        for path in options.out.parent.glob(f"{options.out.name}.*.tmp"):
            path.unlink()  # what a killed process was writing
        with Interrupts(console.print) as interrupts:
            try:
                counts = _simulate(options.designs, question, engine, outcomes, interrupts, console)
            except Stopped as stopped:
                console.print("stopped; the same command goes on")
                return 128 + stopped.signum
        dataset.write(options.out, question, options.designs, outcomes)
        files.remove(outcomes.folder)
    _report(options.out, counts, console)
    return 0


def _check(options: Sample) -> None:
    problems = common.number_problems(
        ("--designs", options.designs, 1, MOST),
        ("--trials", options.trials, 1, 100_000),
        ("--seed", options.seed, 0, 2**31 - 1),
        ("--chunk", options.chunk, 1, 10_000_000),
    )
    problems += common.place_problems("--out", options.out, ".parquet")
    if options.out.exists():
        problems.append(
            Problem("file", f"--out {options.out} is there already: choose another, or delete it")
        )
    common.refuse(problems + common.engine_problems(options.engine, options.overrides))
    dataset.pyarrow_module("codesign sample")


def _question(options: Sample, scene: Scene) -> Question:
    """What is asked; without --chunk calls are as large as those that made what is there."""
    design_space(scene.hand, options.preset)
    before = Shards(options.out).question
    if before is None or options.chunk is not None:
        chunk = batch.size(options.designs, options.trials, most=options.chunk)
    else:
        chunk = before["chunk"]
    return Question(scene, options.engine, options.preset, options.trials, options.seed, chunk)


def _amount(options: Sample) -> str:
    sizes = (options.designs, "design"), (options.trials, "trial")
    each = " x ".join(common.counted(*size) for size in sizes)
    return f"{each}: {common.counted(options.designs * options.trials, 'grasp')}"


def _simulate(
    designs: int,
    question: Question,
    engine: Engine,
    outcomes: Shards,
    interrupts: Interrupts,
    console: Console,
) -> np.ndarray:
    """Simulates the shards that are missing; numbers of grasps by `verdict.VERDICTS`."""
    simulate = sampling.make_simulate(question.scene, engine, question.space)
    counts = np.zeros(len(VERDICTS), int)
    total = question.shards(designs)

    def count(shard: int, outcome: Outcome) -> int:
        count = min(question.chunk, designs - shard * question.chunk)
        ends = np.bincount(verdicts(outcome)[:count].ravel(), minlength=len(counts))
        counts[:] += ends
        return int(ends.sum())

    with Meter("sample", designs * question.trials, console) as meter:
        missing = []
        for shard in range(total):
            outcome = outcomes.load(shard)
            if outcome is None:
                missing.append(shard)
            else:
                meter.count(count(shard, outcome))
        if done := total - len(missing):
            calls = common.counted(total, "call")
            meter.message(f"going on after {done} of {calls}, from {outcomes.folder}")
        for shard in missing:
            answer = interrupts.call(lambda s=shard: simulate(*question.drawn(s)))
            outcome = jax.tree.map(np.asarray, answer)
            outcomes.save(shard, outcome)
            meter.advance(count(shard, outcome))
    return counts


def _report(path: Path, counts: np.ndarray, console: Console) -> None:
    total = int(counts.sum())
    ends = zip(VERDICTS, counts.tolist(), strict=True)
    words = ", ".join(f"{name} {n} ({100 * n / total:.1f} %)" for name, n in ends)
    console.print(f"of {total} grasps: {words}")
    console.print(f"table: {path} ({path.stat().st_size / 1e6:.1f} MB)")
