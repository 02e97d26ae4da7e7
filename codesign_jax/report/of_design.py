"""The report of a design: its verdict by fresh trials, its parameters and a grasp in 3D."""

from pathlib import Path

import numpy as np

from codesign_jax.judge import sentences, stress, verdict
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
    sections = [
        markup.section("Scene", markup.table((), rows)),
        markup.section(
            "Design",
            markup.paragraph(f"{judged.details}. Rule: {verdict.RULE}."),
            *(markup.paragraph(words, "warning") for words in sentences.warnings(judged)),
            *(markup.paragraph(words, "note") for words in sentences.solver(judged.outcomes)),
            markup.paragraph("Finer steps and other conditions: ", "note", again),
            chosen.by_object(judged, turns),
            *(markup.paragraph(f"Warning: {words}.", "warning") for words in warnings),
            chosen.parameters(scene, case.space, case.design),
        ),
    ]
    if shown is not None:
        name = scene.objects.object[int(shown.trial.shape)].name
        note = f"With the object {name}, without noise: {verdict.ending(shown.outcome)}."
        parts = page.in_motion(scene, shown)
        sections.append(markup.section("Grasp", markup.paragraph(note), *parts))
    details = f"<details><summary>{markup.text(file.name)}</summary><pre>{markup.text(text)}</pre>"
    sections.append(markup.section("Design file", markup.Html(f"{details}</details>")))
    return page.save(f"Design {file.name}", judged, sections, path)
