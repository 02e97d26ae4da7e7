"""The report of a design: its verdict by fresh trials, its parameters and a grasp in 3D."""

from pathlib import Path

import numpy as np

from codesign_jax.judge import stress, verdict
from codesign_jax.judge.cases import Case
from codesign_jax.judge.sentences import Judged
from codesign_jax.report import chosen, markup, page
from codesign_jax.report.replay import Replay


def write(case: Case, judged: Judged, shown: Replay | None, file: Path, path: Path) -> Path:
    """Writes the report of a design file."""
    scene = case.scene
    turns = np.arange(judged.outcomes.cost.size)
    warnings = stress.of_design(scene, case.space.params(case.design))
    rows = [*page.surroundings(scene), ("engine", case.commanded)]
    again = ["evaluate", str(file), "--accuracy", "reference", "--stress"]
    text = file.read_text(encoding="utf-8")
    sections = []
    if shown is not None:
        name = scene.objects.object[int(shown.trial.shape)].name
        note = f"With the object {name}, without noise: {verdict.ending(shown.outcome)}."
        parts = page.in_motion(scene, shown)
        sections.append(markup.section("Grasp", *parts, markup.paragraph(note, "note")))
    sections += [
        markup.section(
            "How the grasps ended",
            chosen.by_object(judged, turns),
            *chosen.trials(judged),
            markup.paragraph("Finer steps and other conditions: ", "note", again),
        ),
        markup.section(
            "Design",
            *(markup.paragraph(f"Warning: {words}.", "warning") for words in warnings),
            chosen.parameters(scene, case.space, case.design),
        ),
        markup.section("Settings", markup.table((), rows)),
        markup.section("Design file", markup.folded(file.name, f"<pre>{markup.text(text)}</pre>")),
    ]
    return page.save(f"Design {file.name}", judged, sections, path)
