"""The seed paper's experiment anew: both tasks driven through their goal and beyond, by its scheme and by ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tacsim.config import load_rig
from tacsim.interface import Observation, TactileFrame
from tacsim.rig import Rig
from tacsim.tasks import judge, make_task

if TYPE_CHECKING:
    from tacsim.figure4 import Moment, Trial

FALL = 5.0  # both ends of a reward curve must lie this many times the best distance allowed below the peak
EDGE_GRID = ("canonical.rows=80", "canonical.columns=80")  # heights over the whole gel, for the cut


@dataclass(frozen=True, slots=True)
class Experiment:
    """One task of the seed paper."""

    steps: int  # control steps; the goal is reached after about 60 % of them
    best: float  # closest to the goal that counts as reproduced [m]


EXPERIMENTS = {"squeeze": Experiment(steps=25, best=0.05e-3), "reposition": Experiment(steps=36, best=0.1e-3)}


def run_trial(task_name: str, physics: str, progress: Callable[[], None] = lambda: None) -> Trial:
    """Runs one task with one physics: the scripted policy goes through the goal and on at a constant rate.

    `progress` is called after every control step. Raises what open_rig and Rig.step raise.
    """
    from robot.open import open_rig
    from tacsim.figure4 import Trial

    experiment = EXPERIMENTS[task_name]
    facts = load_rig("sim", task=task_name, overrides=[f"scene.physics={physics}", *EDGE_GRID]).facts
    assert facts.task is not None and facts.scene is not None  # the rig `sim` with a task has both
    with open_rig(facts) as rig:
        shown = _shown(experiment.steps)
        trial = Trial([], [], [], [], facts.task.goal, [], facts.canonical.pitch, facts.scene.gel.size, facts.scene.spacing)
        task = make_task(facts.task)
        start = None
        for k, observation in enumerate(_episode(rig, task.scripted(through=True), experiment.steps)):
            truth = rig.truth()
            assert truth is not None  # simulated with a body
            start = truth if start is None else start
            outcome = judge(task, truth, start)
            trial.step.append(k)
            trial.reward.append(outcome.reward)
            trial.distance.append(outcome.distance)
            trial.image_difference.append(image_difference(rig.frames, rig.references))
            moment = _moment(k, rig, observation)
            if k in shown:
                trial.moments.append(moment)
            progress()
    return trial
