"""Environments for learning: steps a second with random actions, the cost of a reset, and the loss of a policy that is
transferred from coarse to fine physics."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.squeeze import PRESETS
from benchmarks.harness.measure import Measurement, Timing, once
from benchmarks.harness.runner import Case
from tacsim import pose as se3
from tacsim.gym.features import SCALES
from tacsim.interface import Action, Pose
from tacsim.models.task import SqueezeConfig
from tacsim.rig import Rig
from tacsim.tasks import Squeeze

NUMBER = 16  # environments of a batch
STEPS = 6  # timed steps of the batch
MANY, STEPS_OF_MANY = 64, 2  # a larger batch has fewer timed steps
WARM = 2  # untimed steps before those
ROUNDS = 10  # resets of each environment
TOUCH_FEATURES = {"maps": ("height",), "touch": ("wrench",)}  # features of a policy without pictures
SMALL = ("width=160", "height=120", "pixel_pitch=0.125 mm")


def picture_overrides(size: tuple[str, ...]) -> list[str]:
    """Overrides of the geometry of both sensors."""
    return [f"sensors.{name}.model.geometry.{what}" for name in ("lower", "upper") for what in size]


BODIES = tuple(
    (f"scene.body.material.yield_stress={20 + 2 * k} kPa", f"scene.body.geometry.size=[{9 + 0.1 * k} mm, 9 mm, 10 mm]",
     f"task.goal={7 + 0.1 * k} mm")
    for k in range(8)
)  # fmt: skip
GOAL = 7e-3  # height of the body [m]
CLOSING = 0.2e-3  # of each sensor in a control step [m]


def random_actions(preset: str, motion: str, repeat: int) -> list[Measurement]:
    """Sixteen squeezes in one batch under random actions, with heights and forces; at learn also with two pictures of
    160 x 120, and, for flowing motion, their resets, each with a random choice of eight materials, sizes and goals."""
    words = f"{motion}, heights and forces"
    rows = _random_actions(preset, [f"motion={motion}"], words, resets=False, features=TOUCH_FEATURES)
    several = f"{words}, a process for each core"
    rows += _random_actions(
        preset, [f"motion={motion}"], several, resets=False, features=TOUCH_FEATURES, in_processes=True
    )
    if preset == "learn":
        picture_words = f"{motion}, two pictures of 160 x 120"
        rows += _random_actions(
            preset, [f"motion={motion}", *picture_overrides(SMALL)], picture_words, resets=motion == "flowing"
        )
    return rows


def flowing_actions(number: int, repeat: int) -> list[Measurement]:
    """Squeezes at learn in one batch under random actions, flowing, with heights and forces: steps a second."""
    words = "flowing, heights and forces"
    more = ["motion=flowing"]
    return _random_actions("learn", more, words, resets=False, features=TOUCH_FEATURES, number=number)


def _random_actions(
    preset: str, more: list[str], words: str, *, resets: bool, features: dict[str, Any] | None = None,
    in_processes: bool = False, number: int | None = None,
) -> list[Measurement]:  # fmt: skip
    """Rows of a step and, with `resets`, of a reset."""
    import gymnasium

    import tacsim.gym  # noqa: F401  registers

    number = number or NUMBER
    steps = STEPS if number <= MANY else STEPS_OF_MANY
    overrides = [f"scene.preset={preset}", "task.steps=1000", *more]
    options: dict[str, Any] = {"overrides": overrides, "variants": list(BODIES), "features": features}
    forces, newtons = ("wrench_upper", 1.0) if features is None else ("touch", SCALES["force"])
    processes = {"processes": None} if in_processes else {}  # None: one for each core
    many = gymnasium.make_vec("tacsim/Squeeze-v0", number, autoreset_mode="Disabled", **options, **processes)
    alone = gymnasium.make("tacsim/Squeeze-v0", **options).unwrapped
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (WARM + steps, number, 2)).astype(np.float32)
    began = time.perf_counter()
    many.reset(seed=1)
    first = time.perf_counter() - began
    alone.reset(seed=1)
    difference = 0.0
    for action in actions[:WARM]:
        forces_of_batch, forces_alone = (flats[forces] for flats in (many.step(action)[0], alone.step(action[0])[0]))
        difference = max(difference, newtons * float(np.abs(forces_of_batch[0] - forces_alone).max()))
    each = [once(partial(many.step, action))[0] for action in actions[WARM:]]
    timing = Timing(tuple(step.samples[0] for step in each), sum(step.processor for step in each) / steps)
    share = sum(timing.samples) / steps / number  # of one environment in a mean step, because random steps differ
    rows = [
        Measurement(
            timing, difference, "N difference", "the first of them alone", f"{words}: a step of {number}",
            figures={"env_steps_per_s": 1 / share}
            | ({} if in_processes else {"cpu_ms_per_env_step": timing.processor / number * 1e3}),
        )
    ]  # fmt: skip
    if resets:
        again, _ = once(lambda: [many.reset() for _ in range(ROUNDS - 1)])
        later = again.median / (ROUNDS - 1) / number
        mean = (first / number + (ROUNDS - 1) * later) / ROUNDS
        rows.append(
            Measurement(
                Timing((mean,), again.processor / (ROUNDS - 1) / number), mean / share, "control steps",
                "one environment's share of a step", f"{words}: a reset, mean of {ROUNDS} rounds with the first",
                figures={"kept_ms": later * 1e3, "first_ms": first / number * 1e3},
            )
        )  # fmt: skip
    many.close()
    return rows


def transfer(preset: str, repeat: int) -> list[Measurement]:
    """The loss of a policy from `learn` at other presets: squeezing to 7 mm by a closing distance that is correct at
    learn, and by touch (the scripted policy), which uses heights."""
    with _open_rig(preset) as rig, _open_rig("learn") as coarse:
        found = 0.0
        # closing distances of both sensors together that leave the body too high and too low [m]
        low, high = 3e-3, 5e-3
        for _ in range(8):
            found = (low + high) / 2
            low, high = (found, high) if _run_episode(coarse, found)[1] > GOAL else (low, found)
        rows = []
        for what, closing in (("a closing distance found at learn", found), ("by touch, as shipped", None)):
            _, at_learn = _run_episode(coarse, closing)
            seconds, height = _run_episode(rig, closing)
            figures = {"reward": -abs(height - GOAL) * 1e3, "reward_at_learn": -abs(at_learn - GOAL) * 1e3}
            error = abs(height - GOAL) * 1e3
            rows.append(
                Measurement(Timing((seconds,), seconds), error, "mm from the goal", "7 mm", what, figures=figures)
            )
    return rows


def _open_rig(preset: str) -> Rig:
    from robot.open import open_rig

    return open_rig(
        "sim", task="squeeze", overrides=[f"scene.preset={preset}", f"task.goal={GOAL} m", *picture_overrides(SMALL)]
    )


def _run_episode(rig: Rig, closing: float | None) -> tuple[float, float]:
    """Duration of an episode [s], and the body's height at its end [m]: closed by `closing`, or by touch."""
    policy = Squeeze(SqueezeConfig(kind="squeeze", goal=GOAL)).scripted()
    observation = rig.reset(0)
    began, displacement = time.perf_counter(), 0.0
    start = {name: arm.pose for name, arm in observation.arms.items()}
    while True:
        if closing is None:
            action = policy(observation)
        else:
            displacement = min(displacement + CLOSING, closing / 2)
            action = Action({name: se3.translated_along_z(pose, displacement) for name, pose in start.items()})
        before = observation
        observation, _ = rig.step(action)
        if all(_is_same_position(before.arms[name].pose, arm.pose) for name, arm in observation.arms.items()):
            break
    truth = rig.truth()
    assert truth is not None
    return time.perf_counter() - began, truth.height


def _is_same_position(a: Pose, b: Pose) -> bool:
    return bool(np.array_equal(a.position, b.position))


CASES = (
    *(
        Case(
            "scenes",
            "random_actions",
            "tacsim",
            f"16 x {PRESETS[preset]}, {motion}",
            partial(random_actions, preset, motion),
        )
        for preset, motion in (("learn", "flowing"), ("learn", "settled"), ("draft", "flowing"), ("draft", "settled"))
    ),
    *(
        Case("scenes", "transfer", "tacsim", PRESETS[preset], partial(transfer, preset), long=preset == "standard")
        for preset in ("learn", "draft", "standard")
    ),
)
