"""Motion at a constant normal load: a sensor follows its target, but moves along its own z axis to hold its force.

The path is divided into pieces; each is a settled motion. After contact, the part of a piece that changes the distance
to the other frame along z is left out, and the sensor moves along z by a correction from the force error. At the end of
the path it moves along z only, until the force is within the tolerance. Corrections are small: a larger one could open
a contact, or press a contact that slips, which changes its drag.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.models.scene import Scene
from tacsim.physics.motion.controller import ForceReading, Launch, Motion, move_and_settle
from tacsim.physics.motion.path import Path
from tacsim.physics.motion.tuning import (
    INITIAL_LOAD_TRAVEL,
    INTERMEDIATE_LOAD_TOLERANCE,
    MAX_LOAD_CORRECTION,
    MAX_LOAD_CORRECTIONS,
    MAX_LOAD_STEP,
    MAX_LOAD_TRAVEL,
    MIN_FORCE_SHARE,
)
from tacsim.physics.move import MoveStats


class LoadNotReached(RuntimeError):
    """A load that a sensor does not reach by moving along its z axis. The world is in its state before the motion."""


class LoadableWorld(Protocol):
    """Interface of a world that a motion at constant load needs."""

    scene: Scene

    @property
    def sensors(self) -> tuple[str, ...]: ...
    def wrench(self, name: str) -> NDArray[np.float64]: ...
    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path: ...


def require_loads(loads: Mapping[str, float], sensors: Sequence[str]) -> None:
    """Raises KeyError for a name that is no sensor, ValueError for a load that is negative or not finite."""
    for name, load in loads.items():
        if name not in sensors:
            raise KeyError(f"no sensor '{name}' to hold a load; this world has {', '.join(sensors)}")
        if not (math.isfinite(load) and load >= 0.0):
            raise ValueError(f"load of '{name}' is {load:g} N; give 0 or more (positive = pressed)")


@dataclass
class _NormalAxis:
    """State of one sensor's z axis: requested load [N], travel from the target along z [m], stiffness of the
    contact."""

    wanted: float
    tolerance: float  # [N]
    travel: float = 0.0
    stiffness: float = 0.0  # [N/m] as last measured; 0: not measured yet
    retreat: float = math.inf  # last travel away from the contact [m]

    def measure(self, travelled: float, force_change: float) -> None:
        """Computes the stiffness from a correction without a slide: travel [m] and force change [N]."""
        if travelled * force_change > 0.0:
            self.stiffness = force_change / travelled

    def correct(self, force: float, thickness: float) -> None:
        """Changes the travel towards the load; force: of the settled state before the correction."""
        longest, error = MAX_LOAD_CORRECTION * thickness, self.wanted - force
        stiffness = self.stiffness or force / (INITIAL_LOAD_TRAVEL * thickness)
        step = math.copysign(longest, error) if abs(error) >= stiffness * longest else error / stiffness
        if self.wanted == 0.0:  # a decreasing force does not reach 0 by its stiffness: move until the contact opens
            step = min(step, -longest / 4)
        elif force == 0.0:  # not in contact; if it has retreated too far, half of that: the stiffness gives no gap
            self.retreat = max(self.retreat / 2, longest / 64)
            step = min(longest, self.retreat)
        if step < 0.0:
            self.retreat = -step
        self.travel += step


def move_at_constant_load(
    world: LoadableWorld, start: Mapping[str, Pose], end: dict[str, Pose], loads: Mapping[str, float], refine: int, *,
    balanced: bool, max_readings: int = 1,
) -> Motion:  # fmt: skip
    """Moves from `start` to `end` with `loads` [N] held; `end` (the same frames, in order) is set to the final poses.

    Before contact, sensors move straight to their targets. max_readings: of one launch. Raises LoadNotReached.
    """
    scene, targets = world.scene, dict(end)
    gels = {name: scene.gel_of(name) for name in scene.sensors}
    thickness = {name: gel.size[2] for name, gel in gels.items()}
    smallest = {n: MIN_FORCE_SHARE * gel.material.youngs_modulus * thickness[n] ** 2 for n, gel in gels.items()}
    tolerance = scene.settling.tolerance
    axes = {name: _NormalAxis(load, tolerance * max(load, smallest[name])) for name, load in loads.items()}
    done: list[MoveStats] = []

    def force(name: str) -> float:
        return 0.0 - float(world.wrench(name)[2])  # never -0

    def on_path(share: float) -> dict[str, Pose]:
        return {name: se3.interpolate_pose(start[name], target, share) for name, target in targets.items()}

    def gap(name: str, poses: Mapping[str, Pose]) -> float:
        """Distance from a sensor's origin to that of the other frame, along the sensor's z [m]."""
        (other,) = poses.keys() - {name}
        return float((poses[other].position - poses[name].position) @ se3.rotation(poses[name]).as_matrix()[:, 2])

    def settle_at(share: float) -> Generator[Launch, Sequence[ForceReading], None]:
        """Moves to `share` of the path, with each loaded sensor displaced by its travel, and settles."""
        poses = on_path(share)
        for name, axis in axes.items():
            z = se3.rotation(poses[name]).as_matrix()[:, 2]
            poses[name] = Pose(poses[name].position + axis.travel * z, poses[name].quaternion)
        path = replace(world.plan(list(end.values()), list(poses.values())), refine=refine)
        done.append((yield from move_and_settle(path, scene.settling, balanced=balanced, max_readings=max_readings)))
        end.update(poses)

    def correct_at(share: float, slack: float = 0.0) -> Generator[Launch, Sequence[ForceReading], float]:
        """Corrects the loads; returns the largest remaining error [N]; slack: tolerance as a share of the load."""
        for _ in range(MAX_LOAD_CORRECTIONS):
            errors = {name: abs(axis.wanted - force(name)) for name, axis in axes.items()}
            wrong = [n for n, axis in axes.items() if not errors[n] <= max(axis.tolerance, slack * axis.wanted)]
            if not wrong:
                return max(errors.values())
            before = {name: (axes[name].travel, force(name)) for name in wrong}
            for name, (_, force_before) in before.items():
                axes[name].correct(force_before, thickness[name])
            beyond = [name for name in wrong if abs(axes[name].travel) > MAX_LOAD_TRAVEL * thickness[name]]
            if beyond:
                wrong = beyond
                break
            yield from settle_at(share)
            for name, (travel, force_before) in before.items():
                axes[name].measure(axes[name].travel - travel, force(name) - force_before)
        name = wrong[0]
        limit = 1e3 * MAX_LOAD_TRAVEL * thickness[name]
        raise LoadNotReached(
            f"'{name}' does not reach a load of {axes[name].wanted:g} N: {force(name):.3g} N after "
            f"{1e3 * axes[name].travel:+.3g} mm along its z axis from its target (limit {limit:.3g} mm); "
            f"move its target closer to contact, or request another load"
        )

    world.plan(list(start.values()), list(targets.values()))  # raises ValueError for a path that is far too long
    end.update(start)
    length = max(float(np.linalg.norm(targets[name].position - start[name].position)) for name in targets)
    pieces = max(1, math.ceil(length / (MAX_LOAD_STEP * min(thickness.values()))))
    for piece in range(1, pieces + 1):
        if all(force(name) > 0.0 for name in loads):
            yield from correct_at((piece - 1) / pieces, INTERMEDIATE_LOAD_TOLERANCE)
            here, there = on_path((piece - 1) / pieces), on_path(piece / pieces)
            for name, axis in axes.items():
                axis.correct(force(name), thickness[name])
                axis.travel += (gap(name, there) - gap(name, here)) / len(axes)
        yield from settle_at(piece / pieces)
    error = yield from correct_at(1.0)
    return replace(
        done[-1], substeps=sum(s.substeps for s in done), hold=sum(s.hold for s in done),
        guard_hits=sum(s.guard_hits for s in done), load_error=error, courant=max(s.courant for s in done),
    )  # fmt: skip
