"""The seed paper's experiment anew: both tasks driven through their goal and beyond, by its scheme and by ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tacsim.config import load_rig
from tacsim.figure4 import Moment, Trial
from tacsim.interface import Observation, Policy, TactileFrame, Truth
from tacsim.rig import Rig
from tacsim.rigfile import RigFacts
from tacsim.tasks import judge, make_task

FALL = 5.0  # both ends of a reward curve must lie more than this many times the distance allowed below its peak
SEEN = 1.0  # mean difference from the image without contact that contact must make [grey levels]
WHOLE_GEL = ("canonical.rows=80", "canonical.columns=80")  # heights from edge to edge of the gel, for the cut


@dataclass(frozen=True, slots=True)
class Experiment:
    """One task of the seed paper."""

    steps: int  # control steps; about 60 % of them lead to the goal
    best: float  # the closest distance to the goal must be at most this [m]
    overrides: tuple[str, ...]  # of the task


EXPERIMENTS = {
    "squeeze": Experiment(24, 0.05e-3, ("task.max_step=0.3 mm",)),
    # Pressed well beyond a gentle touch: the cube is carried along, tips, and leaves a clear image.
    "reposition": Experiment(32, 0.1e-3, ("task.max_step=0.4 mm", "task.touch_force=1.5 N")),
}


def run_trial(task: str, physics: str, progress: Callable[[], None] = lambda: None) -> Trial:
    """Runs one task with one physics: the scripted policy goes through the goal and on at a constant rate.

    `progress` is called after every control step. Raises what open_rig and Rig.step raise.
    """
    from robot.open import open_rig

    planned = EXPERIMENTS[task]
    facts = load_rig("sim", task=task, overrides=[f"scene.physics={physics}", *planned.overrides, *WHOLE_GEL]).facts
    if facts.task is None:
        raise ValueError(f"rig 'sim' with task '{task}' has no task")
    goal = make_task(facts.task)
    truths: list[Truth] = []
    differences: list[float] = []
    moments: list[Moment] = []
    with open_rig(facts) as rig:
        for observation in _episode(rig, goal.scripted(through=True), planned.steps):
            truths.append(_truth(rig))
            differences.append(image_difference(rig.frames, rig.references))
            moments.append(_moment(len(moments), rig.frames, observation, truths[-1]))
            progress()
    outcomes = [judge(goal, truth, truths[0]) for truth in truths]
    rewards = [outcome.reward for outcome in outcomes]
    shown = [moments[k] for k in telling(len(moments), int(np.argmax(rewards)))]
    return _trial(facts, rewards, [outcome.distance for outcome in outcomes], differences, shown)


def _episode(rig: Rig, policy: Policy, steps: int) -> Iterator[Observation]:
    """Observations of a whole episode, the one after reset first."""
    observation = rig.reset()
    policy.reset()
    yield observation
    for _ in range(steps):
        observation, _ = rig.step(policy(observation))
        yield observation


def _truth(rig: Rig) -> Truth:
    truth = rig.truth()
    if truth is None:
        raise ValueError(f"rig '{rig.name}' has no body whose truth could be judged")
    return truth


def _moment(step: int, frames: Mapping[str, TactileFrame], observation: Observation, truth: Truth) -> Moment:
    heights = {name: touch.height for name, touch in observation.tactile.items() if touch.height is not None}
    return Moment(
        step=step,
        images={name: frame.image for name, frame in frames.items()},
        heights=heights,
        poses=truth.poses,
        points=truth.points,
        force=float(np.mean([abs(arm.wrench[2]) for arm in observation.arms.values()])),
    )


def _trial(
    facts: RigFacts, rewards: list[float], distances: list[float], differences: list[float], shown: list[Moment]
) -> Trial:
    if facts.task is None or facts.scene is None:
        raise ValueError("a trial needs a rig with a task and a scene")
    return Trial(
        step=list(range(len(rewards))),
        reward=rewards,
        distance=distances,
        image_difference=differences,
        goal=facts.task.goal,
        moments=shown,
        pitch=facts.canonical.pitch,
        gel_size=facts.scene.gel.size,
        spacing=facts.scene.spacing,
    )


def telling(count: int, peak: int) -> list[int]:
    """Steps worth showing: first, half-way to the peak, peak, half-way to the end, last."""
    return sorted({0, peak // 2, peak, (peak + count - 1) // 2, count - 1})


def image_difference(frames: Mapping[str, TactileFrame], references: Mapping[str, TactileFrame]) -> float:
    """Mean |I - I0| over pixels, channels and sensors [grey levels]; I0 are the frames without contact."""
    means = [
        float(np.abs(frame.image.astype(np.int16) - references[name].image.astype(np.int16)).mean())
        for name, frame in frames.items()
    ]
    return float(np.mean(means))


def as_json(results: Mapping[str, Mapping[str, Trial]]) -> dict[str, Any]:
    """`{task: {physics: {step, reward, distance, goal, image_difference}}}`; an entry a step, reset first."""
    return {
        task: {
            physics: {
                "step": trial.step,
                "reward": trial.reward,
                "distance": trial.distance,
                "goal": list(trial.goal) if isinstance(trial.goal, tuple) else trial.goal,
                "image_difference": trial.image_difference,
            }
            for physics, trial in trials.items()
        }
        for task, trials in results.items()
    }


def shortcomings(task: str, trial: Trial) -> list[str]:
    """Where a curve is not the seed's, in words: it must rise to a peak at the goal, then fall. Empty when it does."""
    allowed = EXPERIMENTS[task].best
    peak, distance = trial.peak, trial.distance
    found = []
    if not distance[peak] <= allowed:
        found.append(f"closest distance {distance[peak] * 1e3:.3f} mm, at most {allowed * 1e3:.2f} mm is wanted")
    for name, end in (("start", distance[0]), ("end", distance[-1])):
        if not end - distance[peak] > FALL * allowed:
            found.append(
                f"at the {name} the distance is {end * 1e3:.3f} mm, not more than {FALL:g} x {allowed * 1e3:.2f} mm "
                "worse than at the peak"
            )
    if not max(trial.image_difference) > SEEN:
        found.append(f"contact changes the images by at most {max(trial.image_difference):.2f} grey levels")
    return found
