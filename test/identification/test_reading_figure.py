# SPDX-License-Identifier: Apache-2.0
"""What the theory page says of the lost inertias is what readings of the figures determine."""

import numpy as np
import pytest

from tools.reading_figure import PANELS, determined


def test_fig_9_fixes_the_product_of_inertia_and_initial_rate_and_little_more():
    _, name, read, rate = PANELS[0]
    labels, relative = determined(name, read, rate)
    assert relative[0] == pytest.approx(0.012, abs=0.001)
    assert relative[1] == pytest.approx(0.14, abs=0.01)
    assert np.all(relative[2:] > 1e3)
    assert "I_{zz}^{+" in labels[0] and r"\dot{\gamma}^{+" in labels[0]
    assert r"\dot{\gamma}^{-" in labels[1]


@pytest.mark.parametrize(("panel", "worst"), [(1, 0.05), (2, 0.2)])
def test_example_2_fixes_the_moments_of_the_star_and_two_combinations_never(panel, worst):
    _, name, read, rate = PANELS[panel]
    _, relative = determined(name, read, rate)
    assert relative[0] < 0.011 and relative[2] < worst
    assert 0.3 < relative[3] < 0.45
    assert 1.0 < relative[4] < 10.0
    assert np.all(relative[5:] > 1e6)
