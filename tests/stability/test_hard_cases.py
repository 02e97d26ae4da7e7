"""The hard cases of numerical stability: every invariant, time step and precision is a test.

The quick variants run with `make test`; all of them with `make stability`, which also writes
docs/notes/stability.md.
"""

import json

import pytest

from tests.stability import (  # noqa: F401  (they register their cases)
    along,
    curled,
    decision,
    energy,
    grasp,
    hold,
    symmetry,
    table,
    touch,
)


def variants():
    for case in table.CASES.values():
        for variant in case.variants:
            slow = case.quick != case.engine or variant != case.variants[0]
            marks = [pytest.mark.stability, *[pytest.mark.slow] * slow]
            part = "h" if variant[0] == 1 else f"h_{1 / variant[0]:g}"
            name = f"{case.number}-{case.name}-{part}-{variant[1]}"
            yield pytest.param(case, variant, marks=marks, id=name)


@pytest.mark.parametrize("case, variant", list(variants()))
def test_hard_case(case, variant, rows):
    row = case.run(*variant)
    rows.append(row)
    text = f"{row['measured']:.4g} {row['unit']} against {row['bound']:.4g}: {row['note']}"
    # A case that passes again loses the cause of its failure.
    assert row["passed"] == (not row["failure"]), text


def test_a_run_replaces_its_rows_and_drops_those_of_no_case(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "notes").mkdir()
    page = tmp_path / "notes" / "stability.md"
    page.write_text("before\n<!-- table:begin --><!-- table:end -->\nafter\n")
    kept = {"case": 14, "name": "spawned-mujoco", "step": 0.5, "precision": "float64"}
    names = {"title": "t", "invariant": "i", "engine": "mujoco", "lower": False, "unit": "m/s"}
    kept |= names | {"measured": 0.5, "bound": 1.0, "margin": 2.0, "note": "", "passed": True}
    renewed = kept | {"step": 1.0}
    obsolete = kept | {"name": "no_case"}
    table.write(tmp_path, [kept, renewed, obsolete], "aaaaaaa")
    table.write(tmp_path, [renewed | {"measured": 0.25, "margin": 4.0}], "bbbbbbb")
    rows = json.loads((tmp_path / "data" / "stability.json").read_text())["rows"]
    assert [(r["name"], r["commit"], r["measured"]) for r in rows] == [
        ("spawned-mujoco", "bbbbbbb", 0.25),
        ("spawned-mujoco", "aaaaaaa", 0.5),
    ]
    assert "| 0.5 m/s | <= 1 |" in page.read_text()  # of the least margin
    assert page.read_text().startswith("before") and page.read_text().endswith("after\n")
