"""Tables and figure of docs/notes/section.md."""

from pathlib import Path

import numpy as np

from codesign_jax.scene import beams, section_law, section_numbers
from codesign_jax.scene.section_numbers import FITTED, Constants
from scripts.section import fit, study
from scripts.section.elements import Model, Section
from scripts.section.study import SHEAR_MODULUS
from scripts.shared import output

LETTERS = dict(
    zip(
        FITTED,
        ("ln a", "ln b", "ln b′", "g", "e", "ln c", "ln t", "ln t′", "s", "ln f"),
        strict=True,
    )
)
TERMS = ("1", "D", "W", "D²", "D·W", "W²", "z", "z²", "z·D", "z·W")
"""D = ln(d / 0.2 h), W = ln(w / 1.2 h), z the thread's depth."""
SHOWN = (20e3, 50e3)
"""Pressures of the table and the figure [Pa]."""


def constants_table(fitted: Constants) -> str:
    rows = [["", *TERMS]]
    for name, row in zip(FITTED, fitted.functions, strict=True):
        rows.append([LETTERS[name], *(f"{v:.2f}" for v in row)])
    pairs = [
        ("sideways stiffness of the walls over 4·I_z", fitted.upright),
        ("their axial stiffness over 4·A", fitted.axial),
        ("what bending takes from both", fitted.stretch),
        ("λ₁ over 2T/(k_f·w²)", fitted.strip),
        ("x₀ over T/(k_f·w·f·q), 7.5 for a parabola", fitted.turn),
        ("twist over 4A_m²d/U + U·d³/3", fitted.torsion),
        ("what a bulge adds to it: factor and exponent of d/h", fitted.torsion_round),
        ("Wagner's effect over M·h/2, and what a bulge adds", fitted.wagner),
        ("crossed winding over k_t·sin²α·cos²α·4A²/U", fitted.crossing),
        ("single winding over 2A·tan α·h/2", fitted.helix),
    ]
    more = [["constant", "fitted"]]
    for name, value in pairs:
        more.append([name, ", ".join(f"{v:.2f}" for v in np.atleast_1d(value))])
    return f"{output.markdown(rows)}\n\n{output.markdown(more)}"


def comparison(data: Path) -> str:
    """Free bends and twist of the sections that the build sheet's default has, by wall."""
    rows = [
        ["wall mm", "kPa", "free bend 1/m", "law", "beam theory", "held N m", "law", "twist", "law"]
    ]
    for name, (section, column) in study.read(data).items():
        if not name.startswith("nominal"):
            continue
        n = section_numbers.numbers(
            np.array(section.height),
            section.wall,
            section.width,
            shear_modulus=section.shear_modulus,
        )
        theory = beams.beam(
            section.height,
            section.wall,
            width=section.width,
            shear_modulus=section.shear_modulus,
            density=1.0,
        )
        for pressure in SHOWN:
            rest = (column["pressure"] == np.float32(pressure)) & (column["lateral"] == 0)
            free = np.flatnonzero(rest)[0]
            held = np.flatnonzero(rest & (column["bend"] == 0))[0]
            bend = column["bend"][free]
            torsion = theory.torsion
            law = float(section_law.twist_stiffness(n, pressure, np.array(bend)))
            rows.append(
                [
                    f"{1e3 * section.wall:g}",
                    f"{1e-3 * pressure:g}",
                    f"{bend:.1f}",
                    f"{float(section_law.free_bend(n, np.array(pressure))):.1f}",
                    f"{_beam_bend(section, pressure):.1f}",
                    f"{-column['moment_bend'][held]:.3f}",
                    f"{-_moment(n, pressure):.3f}",
                    f"{column['twist_twist'][free] / torsion:.2f}",
                    f"{law / torsion:.2f}",
                ]
            )
    return output.markdown(rows)


def _moment(n: section_numbers.Numbers, pressure: float) -> float:
    return float(section_law.response(n, pressure, 0.0, np.array(0.0), 0.0).bend)


def _beam_bend(section: Section, pressure: float) -> float:
    """Free bend by beam theory and the neo-Hookean law of the walls [1/m]."""
    strains = np.linspace(1e-3, 4, 4000)
    reached = beams.strain_pressure(
        strains,
        section.height,
        section.wall,
        width=section.width,
        shear_modulus=SHEAR_MODULUS,
        neo_hookean=True,
    )
    return float(np.interp(pressure, reached, strains)) / section.height


def draw(path: Path) -> Path:
    """Deformed sections in free bend."""
    figure = output.new_figure(9, 2.6)
    axes = figure.subplots(1, 4, sharey=True)
    for axis, wall in zip(axes, (2.5, 3.5, 5.0, 7.0), strict=True):
        section = Section(wall=wall * 1e-3)
        model = Model(section)
        for pressure, colour in ((0.0, "0.7"), (SHOWN[0], "C0"), (SHOWN[1], "C1")):
            model.reach(pressure, steps=3, twist=0.0, lateral=0.0)
            positions = 1e3 * model.positions()[:, 1:]
            for edges in (model.outside, model.chamber):
                line = positions[[n for e in edges.nodes for n in e[:2]]]
                line = np.concatenate([line, line[:1]])
                axis.plot(*line.T, color=colour, lw=1)
        axis.set_title(f"wall {wall:g} mm")
        axis.set_aspect("equal")
        axis.set_xlabel("across mm")
    axes[0].set_ylabel("up mm")
    return output.save_figure(figure, path)


def fill(data: Path, docs: Path, highest: float) -> None:
    page = docs / "notes" / "section.md"
    fitted = section_numbers.constants()
    states = fit.states(data, highest)
    output.fill(page, constants_table(fitted), "section_constants")
    output.fill(page, output.markdown(fit.report(fitted, states)), "section_residuals")
    output.fill(page, comparison(data), "section_comparison")
    draw(docs / "figures" / "section.png")
