"""What decides which of two hands is better: the figure at the front of the accuracy page.

python -m scripts.accuracy.decisions      # draws docs/data/hard_designs.json
"""

import json
import sys
from pathlib import Path
from typing import Any

from codesign_jax.statistics import wilson
from scripts.shared import output

DATA = Path(__file__).parents[2] / "docs/data/hard_designs.json"
FIGURE = Path("docs/figures/decisions.png")
KINDS = {
    "chance": ("a micrometre", "0.6"),
    "step": ("time step, integrator, accuracy", "tab:blue"),
    "contact": ("constants of the contact", "tab:green"),
    "rubber": ("constants of the rubber", "tab:red"),
}
"""What a variant changes: its words and its colour."""


def flips(row: dict[str, Any], trials: int) -> tuple[float, float, float]:
    """Share of a variant's verdicts that flip, and its interval of 95 % over trials."""
    return wilson(row["gained"] + row["lost"], trials)


def draw(content: dict[str, Any], path: Path) -> Path:
    """A bar for each variant, shortest first, with the rank correlation of the designs' shares."""
    trials = content["designs"] * content["trials"]
    rows = sorted(content["variants"], key=lambda row: -row["gained"] - row["lost"])
    figure = output.new_figure(9, 4.6)
    axis = figure.subplots()
    for y, row in enumerate(rows):
        share, low, high = (100 * value for value in flips(row, trials))
        color = KINDS[row["kind"]][1]
        axis.barh(y, share, color=color, alpha=0.85)
        axis.plot([low, high], [y, y], color="0.2", lw=1)
        text = f"{share:.0f} %, rank correlation {row['rank']:.2f}"
        axis.text(high + 0.4, y, text, va="center", fontsize=8)
    axis.set_yticks(range(len(rows)), [row["variant"].replace("`", "") for row in rows], fontsize=8)
    axis.set_xlim(0, 32)
    axis.set_xlabel(f"verdicts that change [%], {content['designs']} designs that keep 30 to 95 %")
    for words, color in KINDS.values():
        axis.bar(0, 0, color=color, label=words)
    axis.legend(frameon=False, fontsize=8, loc="upper right")
    return output.save_figure(figure, path)


def main() -> int:
    print(draw(json.loads(DATA.read_text()), FIGURE))
    return 0


if __name__ == "__main__":
    sys.exit(main())
