"""The hard cases of numerical stability: every invariant, time step and precision is a test.

The quick variants run with `make test`; all of them with `make stability`, which also writes
docs/notes/stability.md.
"""

import pytest

from tests.stability import (  # noqa: F401  (they register their cases)
    along,
    curled,
    decision,
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
