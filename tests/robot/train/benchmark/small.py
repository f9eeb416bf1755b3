"""A task of the benchmark with episodes of a second: a small cube, three control steps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from robot.train.benchmark.episodes import draw_episodes
from tests.tacsim.gym.small import SMALL

TASK: dict[str, Any] = {
    "version": "v1",
    "task": "squeeze",
    "level": "easy",
    "reason": "A test.",
    "overrides": [*SMALL, "motion=flowing"],
    "max_force": "8 N",
    "values": {
        "task.goal": {"uniform": ["2 mm", "2.6 mm"]},
        "scene.body.material.yield_stress": {"log_uniform": ["5 kPa", "20 kPa"]},
    },
    "shifts": {"shift-material": {"values": {"scene.body.material.yield_stress": {"choice": ["60 kPa", "80 kPa"]}}}},
}


def write_task(folder: Path, episodes: int = 4, **changed: Any) -> str:
    """Writes the task file and its drawn episodes; the path of the task file."""
    path = folder / "small.yaml"
    path.write_text(json.dumps(TASK | changed), encoding="utf-8")
    draw_episodes(str(path), episodes)
    return str(path)


class Raises:
    """A policy that raises in the second step of every third episode."""

    from tacsim.interface import Needs

    needs = Needs()
    count = -1  # of episodes, of all objects

    def reset(self) -> None:
        Raises.count += 1
        self._step = 0

    def __call__(self, observation: Any) -> Any:
        from tacsim.interface import Action

        self._step += 1
        if self._step == 2 and Raises.count % 3 == 1:
            raise ZeroDivisionError("a number was zero")
        return Action({"lower": None, "upper": None})
