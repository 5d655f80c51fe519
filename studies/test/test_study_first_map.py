# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The study of first maps, on two halls: the first gives a map, the second a mirror ambiguity."""

import pytest

from studies.first_map import CERTAIN, judged

pytestmark = pytest.mark.slow


def test_halls_are_drawn_and_judged():
    found = judged(9)
    assert found["input"] == "distances by radio" and not found["why"]
    assert found["z"] < CERTAIN and found["error"] < 0.5
    assert judged(9) == found
    assert "mirror image" in judged(3)["why"]
