"""Random actions of the squeeze: cost of a step and error of its force, settled and flowing."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.cases.squeeze import SLOW, normal_forces, squeeze_scene, world_in_contact
from benchmarks.harness.cache import cached
from benchmarks.harness.measure import Measurement, Timing, timed
from benchmarks.harness.runner import Case
from tacsim.interface import FloatArray, Pose
from tacsim.physics.world import World, make_world

# first squeeze from touch [m]; number of steps; largest motion of one sensor [m], that of the squeeze task
START, ACTIONS, MAX_STEP = 1.5e-3, 20, 0.2e-3
FLOW_MACHS = {"draft": (0.5, 1.0, 2.0)}  # times the default; other presets use only the default


def random_steps(preset: str, repeat: int) -> list[Measurement]:
    """Twenty steps in a row, each sensor along its z by a random -0.2 to 0.2 mm: force after each step against the slow
    limit through the same poses, as a share of the mean force; settled, and flowing, at draft with three speeds."""
    begin, truth = _slow_forces(preset)
    usual = squeeze_scene(preset, "hybrid").flow_mach
    rows = [_row(preset, begin, truth, "settled", flow=False)]
    for share in FLOW_MACHS.get(preset, (1.0,)):
        what = f"flowing at Mach {share * usual:g}" + (", the default" if share == 1.0 else "")
        rows.append(_row(preset, begin, truth, what, flow=True, flow_mach=share * usual))
    return rows


def _random_motions() -> FloatArray:
    return np.random.default_rng(0).uniform(-MAX_STEP, MAX_STEP, (ACTIONS, 2))


def _slow_forces(preset: str) -> tuple[Mapping[str, NDArray[Any]], FloatArray]:
    """The squeezed state, and the mean force of both sensors [N] after each step at a speed without influence. The
    forces take minutes at `standard`; they are cached."""
    scene = squeeze_scene(preset, "hybrid", **SLOW)
    world = world_in_contact(scene)
    _move_sensors(world, np.full(2, START / 2), flow=False)
    begin = world.snapshot()

    def compute() -> list[float]:
        return [_force_after_motion(world, step, flow=False) for step in _random_motions()]

    question = f"{scene.model_dump_json()} {START} {ACTIONS} {MAX_STEP}"
    return begin, np.array(cached(f"random-steps-{preset}", question, compute))


def _move_sensors(world: World, by: FloatArray, *, flow: bool) -> int:
    """Moves both sensors along their z, which points into the body, by `by` [m]; returns the substeps."""
    targets = {}
    for name, sign, length in zip(("lower", "upper"), (1.0, -1.0), by, strict=True):
        pose = world.pose(name)
        targets[name] = Pose(pose.position + [0.0, 0.0, sign * length], pose.quaternion)
    return world.move(targets, flow=flow).substeps


def _force_after_motion(world: World, by: FloatArray, *, flow: bool) -> float:
    _move_sensors(world, by, flow=flow)
    return float(normal_forces(world).mean())


def _row(
    preset: str, begin: Mapping[str, NDArray[Any]], truth: FloatArray, what: str, *, flow: bool, **settling: float
) -> Measurement:
    world, steps = make_world(squeeze_scene(preset, "hybrid", **settling)), _random_motions()

    def run() -> tuple[FloatArray, float, int]:
        world.restore(begin)
        forces, max_difference, substeps = [], 0.0, 0
        for step in steps:
            substeps += _move_sensors(world, step, flow=flow)
            sensor_forces = normal_forces(world)
            forces.append(float(sensor_forces.mean()))
            max_difference = max(max_difference, float(np.ptp(sensor_forces) / sensor_forces.mean() * 100))
        return np.array(forces), max_difference, substeps

    # kernels are warm after the slow limit's start
    timing, (forces, max_difference, substeps) = timed(run, 1, warm=lambda: None)
    errors = np.abs(forces - truth) / truth.mean() * 100
    each = Timing(tuple(sample / ACTIONS for sample in timing.samples), timing.processor / ACTIONS)
    return Measurement(
        each, float(np.sqrt(np.mean(errors**2))), "% of the mean force, rms", "the same poses, settled at Mach 0.003",
        what, round(substeps / ACTIONS),
        {"worst_percent": float(errors.max()), "first_step_percent": float(errors[0]),
         "sensors_apart_percent": max_difference},
        "a step: its seconds and substeps",
    )  # fmt: skip


CASES = (
    *(Case("squeeze", "random_steps", "tacsim", each, partial(random_steps, each)) for each in ("learn", "draft")),
    Case("squeeze", "random_steps", "tacsim", "standard", partial(random_steps, "standard"), long=True),
)
