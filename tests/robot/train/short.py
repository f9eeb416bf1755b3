"""Trainings of seconds: the small environments of the gym tests, a few steps."""

from __future__ import annotations

from typing import Any

from tacsim.models.policy import Training
from tests.tacsim.gym.small import SMALL

DRAWN = {"draws": 3, "values": {"scene.body.material.yield_stress": {"uniform": ["5 kPa", "20 kPa"]}}}


def training(**changed: Any) -> Training:
    whole: dict[str, Any] = {
        "task": "squeeze",
        "overrides": SMALL,
        "randomise": DRAWN,
        "features": {
            "maps": ["height"],
            "grid": {"rows": 4, "columns": 4, "pitch": 2e-3},
            "touch": ["depth", "wrench"],
        },
        "environments": 3,
        "width": 8,
        "dagger": {"rounds": 3, "epochs": 2, "batch": 4},
        "reinforce": {"rounds": 3, "episodes": 2, "batch": 4},
    }
    return Training.model_validate({**whole, **changed})
