"""A finger that comes loose and strikes another one at 3 m/s, at several time steps."""

import numpy as np
import pytest

from tests.helpers import strikes


@pytest.mark.slow  # programs for four time steps; `test_kernel_pairs` has the step itself
def test_a_strike_is_the_same_at_any_step():
    """Depths and impulses at 10, 5, 2 and 1 ms, in eighteen worlds.

    Medians of depth lie within 0.5 mm of one another, and half of all impulses within 5 % of those
    at 1 ms.  No finger passes through the other, which is 22 mm high, and what they push each other
    by adds up to nothing.
    """
    found = {h: strikes.strike(strikes.two_fingers(h)) for h in (0.01, 0.005, 0.002, 0.001)}
    for h, each in found.items():
        assert 2 < np.median(each.speed) < 4, h
        assert each.depth.max() < 5e-3, (h, each.depth)
        assert (each.impulse > 1e-3).all(), h  # each strikes
        # Of 50 mN s: the solver ends at a relative decrement of 1e-6.
        assert each.wrist.max() < 1e-5, (h, each.wrist)
    depths = [np.median(each.depth) for each in found.values()]
    assert max(depths) - min(depths) < 0.5e-3, depths
    for h, each in found.items():
        assert abs(np.median(each.impulse / found[0.001].impulse) - 1) < 0.05, h
