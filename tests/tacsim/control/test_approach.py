"""Equal steps until touch."""

from __future__ import annotations

import pytest

from tacsim.control.contact_signal import NoTouch, approach


@pytest.mark.parametrize(("surface", "steps"), [(0.0, []), (2.5, [1.0, 2.0, 3.0])])
def test_an_approach_ends_at_the_first_step_that_touches(surface: float, steps: list[float]) -> None:
    went: list[float] = []
    assert approach(lambda: max(went, default=0.0) >= surface, went.append, 1.0, 5.0, "") == max(steps, default=0.0)
    assert went == steps


def test_an_approach_that_meets_nothing_ends_at_its_bound() -> None:
    went: list[float] = []
    with pytest.raises(NoTouch, match=r"no touch after an approach of 2.5e[+]03 mm; look"):
        approach(lambda: False, went.append, 1.0, 2.5, "look")
    assert went == [1.0, 2.0]
