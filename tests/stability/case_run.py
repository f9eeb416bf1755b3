"""Runs one hard case from a new world on.

A case ends `finite` (a sound state, whose numbers are in `figures`), `diverged` (SimulationDiverged, and the world is
bit for bit as before the motion and still of use) or `refused` (ValueError). Anything else is a failure of the case.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np
from case_motions import Motions, Targets, gap
from hard_cases import CASES

from tacsim.physics import snapshot
from tacsim.physics.failure import diagnosis
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.move import MoveStats
from tacsim.physics.seed import world as seed_world
from tacsim.physics.world import World, make_world
from tacsim.physics.worlds import fem, hybrid_inertia, press
from tacsim.physics.worlds.tuning import MAX_RETRIES


@dataclass(frozen=True)
class Outcome:
    kind: str  # finite, diverged, refused
    words: str = ""
    figures: dict[str, float] = field(default_factory=dict)


def poisoned(name: str, times: int) -> Callable[..., Any]:
    """The function `name` of snapshot, which worlds call with their arrays before a launch, puts a NaN into a velocity.

    Before the 3rd launch, and before the ones after it: `times` in all.
    """
    launches = 0

    def spoilt(arrays: Mapping[str, np.ndarray], *others: Any) -> Any:
        nonlocal launches
        launches += 1
        if 3 <= launches < 3 + times:
            velocity = arrays.get("velocity", arrays.get("gel_velocity"))
            assert velocity is not None
            velocity[(0,) * velocity.ndim] = math.nan
        return getattr(snapshot, name)(arrays, *others)

    return spoilt


def run(name: str, physics: str) -> Outcome:
    """One case from a new world on. Raises AssertionError where the world breaks its promises."""
    if name == "death":  # for the tests of the worker itself
        os.abort()
    while name == "endless":
        time.sleep(1.0)
    case = CASES[name]
    modules = {"fem": fem, "hybrid_inertia": hybrid_inertia, "press": press, "seed": seed_world}
    with ExitStack() as stack:
        for target, value in case.patch.items():
            module, _, attribute = target.partition(".")
            if attribute == "copy_arrays":
                value = poisoned(attribute, value)
            stack.enter_context(mock.patch.object(modules[module], attribute, value))
        try:
            world = make_world(case.scene("seed" if physics == "seed" else "hybrid"))
            return _driven(world, case.motions)
        except ValueError as refusal:
            return Outcome("refused", str(refusal))


def _driven(world: World, motions: Motions) -> Outcome:
    stats: list[MoveStats] = []
    moves: dict[str, float] = {}
    first: np.ndarray | None = None
    for targets in motions(world):
        before = world.snapshot()
        try:
            stats.append(world.move(targets))
        except SimulationDiverged as failure:
            _assert_rolled_back(world, before, failure)
            return Outcome("diverged", str(failure), {"moves": len(stats)})
        _assert_consistent(world, stats[-1], targets)
        moves |= _after_move(world, len(stats))
        if targets or first is None:
            first = _shape(world)
    drift = 0.0 if first is None else float(np.abs(_shape(world) - first).max())
    return Outcome("finite", "", {**moves, **_facts(world, stats), "drift": drift})


def _after_move(world: World, number: int) -> dict[str, float]:
    """Largest force on a sensor [N], and largest displacement of a gel's surface [m]."""
    return {
        f"force {number}": max(float(np.linalg.norm(world.wrench(name)[:3])) for name in world.sensors),
        f"dent {number}": max(float(np.abs(world.surface(name).displacement).max()) for name in world.sensors),
    }


def _shape(world: World) -> np.ndarray:
    """What must not drift at rest: body particles and gel surfaces [m]."""
    truth = world.truth()
    parts = [] if truth is None else [truth.points.ravel()]
    return np.concatenate([*parts, *(world.surface(name).displacement.ravel() for name in world.sensors)])


def _assert_rolled_back(world: World, before: Mapping[str, np.ndarray], failure: SimulationDiverged) -> None:
    after = world.snapshot()
    changed = [name for name in before if before[name].tobytes() != after[name].tobytes()]
    assert not changed, f"after divergence {changed} are not as before the motion"
    assert failure.cause and failure.where and failure.advice
    assert failure.cause in str(failure) and failure.advice in str(failure)
    if all(np.isfinite(a).all() for a in before.values()) and "spread over" not in failure.cause:
        world.move({})  # the world is still of use
        assert all(np.isfinite(a).all() for a in world.snapshot().values())


def _assert_consistent(world: World, stats: MoveStats, targets: Targets) -> None:
    settling = world.scene.settling  # type: ignore[attr-defined]
    assert 0 <= stats.hold <= min(stats.substeps, settling.max_substeps)
    if stats.settled != (stats.residual <= settling.tolerance):  # what friction could not follow has not settled either
        assert not stats.settled and settling.mach is not None  # type: ignore[attr-defined]
    assert stats.residual >= 0 and stats.overlap >= 0 and stats.guard_hits >= 0 and 0 <= stats.retries <= MAX_RETRIES
    for name, pose in targets.items():
        assert np.allclose(world.pose(name).position, pose.position, atol=1e-12)
    assert all(np.isfinite(a).all() for a in world.snapshot().values())
    for name in world.sensors:
        assert np.isfinite(world.wrench(name)).all() and np.isfinite(world.surface(name).displacement).all()


def _facts(world: World, stats: list[MoveStats]) -> dict[str, float]:
    state, truth = world.snapshot(), world.truth()
    figures = {
        "force": -float(world.wrench("lower")[2]),
        "torque": float(world.wrench("lower")[5]),
        "settled": float(stats[-1].settled),
        "residual": stats[-1].residual,
        "gap": gap(world) if truth is not None else math.nan,
        "overlap": max(s.overlap for s in stats),
        "substeps": float(sum(s.substeps for s in stats)),
        "retries": float(sum(s.retries for s in stats)),
        "guard_hits": float(sum(s.guard_hits for s in stats)),
    }
    volumes = diagnosis.particle_volumes(state)
    thickness = world.scene.gel.size[2] * 1e3  # type: ignore[attr-defined]
    elements = diagnosis.element_volumes(state["gel_displacement"], thickness) if "gel_displacement" in state else None
    for name, values in (("particle", volumes), ("element", elements)):
        if values is not None:
            figures |= {f"least {name}": float(values.min()), f"most {name}": float(values.max())}
    if truth is not None:
        figures |= {
            "height": truth.height,
            "x": float(truth.position[0]),
            "upper force": -float(world.wrench("upper")[2]),
            "upper torque": float(world.wrench("upper")[5]),
        }
    return figures
