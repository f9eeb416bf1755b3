"""References of a served rig are taken of free arms only, by their force sensors."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from robot.serve.errors import Refused
from robot.serve.references import References


def references(force: float) -> References:
    """Of a rig with one arm, whose force sensor measures `force` [N], and no sensor."""
    state = SimpleNamespace(wrench=np.array([0.0, 0.0, force, 0.0, 0.0, 0.0]))
    arms = {"upper": SimpleNamespace(state=lambda: state)}
    rig: Any = SimpleNamespace(arms=arms, sensors={}, normalisers={}, references={})
    return References(rig)


@pytest.mark.parametrize(("force", "words"), [(5.0, "5.0 N"), (-1.1, "1.1 N"), (np.nan, "nan N")])
def test_an_arm_that_is_pressed_takes_no_reference(force: float, words: str) -> None:
    with pytest.raises(Refused, match=f"arm 'upper' measures {words}: a gel is touched; move it clear first"):
        references(force).take()


def test_the_noise_of_a_free_arm_is_allowed() -> None:
    references(0.9).take()
