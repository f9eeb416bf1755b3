"""The quasi-static controller: ramped motion of driven frames, then a hold until the measured residual is small.

Materials are rate-independent, so only the path has an effect (tacsim.physics.motion.path); the hold waits until all
motion has ended.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tacsim.models.scene import Settling
from tacsim.physics.failure.health import LaunchSpan, SimulationDiverged
from tacsim.physics.motion.path import Path
from tacsim.physics.motion.tuning import (
    COMPARED_READINGS,
    FORECAST_READINGS,
    MIN_FORCE_SHARE,
    SUBSTEPS_PER_HOLD,
    SUBSTEPS_PER_LAUNCH,
)
from tacsim.physics.move import MoveStats
from tacsim.physics.snapshot import State
from tacsim.physics.units import MM


def force_floor(modulus: float, thickness: float) -> float:
    """Smallest reference force of residuals [N], for a gel with Young's modulus [MPa] and thickness [mm]."""
    return MIN_FORCE_SHARE * modulus * thickness**2


@dataclass(frozen=True)
class Integration:
    """Parameters of the time integration of a launch."""

    step: float = 0.0  # time step [mm, wave speed 1]
    damping: float = 0.0  # of the gel: its rate times the wave's time through it [-]
    courant: float = 0.0  # see tacsim.physics.failure.health.Health


@dataclass(frozen=True)
class ForceReading:
    """Forces at one instant [N]: contact on each gel and reaction at its backing, world axes; results of the guards.

    moment: about each sensor's origin, in sensor axes, divided by half the gel's width [N].
    load: external force on the body without contact, world axes.
    torque: of all contacts of a free body about its centre, world axes, divided by the same length [N].
    """

    contact: NDArray[np.float64]  # (gels, 3)
    backing: NDArray[np.float64]  # (gels, 3)
    floor: float  # [N] residuals are relative to at least this
    overlap: float  # [mm]
    guard_hits: int
    moment: NDArray[np.float64] | None = None  # (gels, 3)
    load: NDArray[np.float64] | None = None  # (3,) weight of the body
    torque: NDArray[np.float64] | None = None  # (3,)
    integration: Integration = Integration()
    gel_overlap: float = 0.0  # between the two gels [mm]
    volumes: tuple[float, float] = (1.0, 1.0)  # smallest and largest elastic volume ratio of the body's particles


def residual(reading: ForceReading, before: ForceReading, balanced: bool) -> float:
    """Largest imbalance of forces or moments, or their change since `before`, relative to the largest force [-].

    `balanced`: the sum of the contact forces on all gels must be the weight of a free body, and their torque zero.
    """
    scale = max(float(np.abs(reading.contact).max()), reading.floor)
    parts = [np.abs(reading.contact - reading.backing).max(), np.abs(reading.contact - before.contact).max()]
    if reading.moment is not None and before.moment is not None:  # a twist settles later than the forces
        parts.append(np.abs(reading.moment - before.moment).max())
    if balanced:
        load = 0.0 if reading.load is None else reading.load
        parts.append(np.abs(reading.contact.sum(axis=0) - load).max())
        if reading.torque is not None:
            parts.append(np.abs(reading.torque).max())
    return float(max(parts)) / scale


def remaining_contact_creep(first: ForceReading, second: ForceReading, third: ForceReading) -> float:
    """Expected further change of the contact forces, relative to the largest force [-]: the sum of a geometric series
    of changes, as in contact whose slip rate decays.

    It is 0 for a change that oscillates; for a change that hardly decays, the series has FORECAST_READINGS terms.
    """
    before, now = second.contact - first.contact, third.contact - second.contact
    creeping = before * now > 0.0
    share = np.minimum(now[creeping] / before[creeping], 1.0)
    to_come = np.abs(now[creeping]) * np.minimum(share / np.maximum(1.0 - share, 1e-9), FORECAST_READINGS)
    return float(to_come.max(initial=0.0)) / max(float(np.abs(third.contact).max()), third.floor)


def remaining_body_creep(held: Sequence[ForceReading], age: float) -> float:
    """Expected decrease of the contact forces of a yielding body in the next FORECAST_READINGS readings, relative to
    the largest force [-]; infinite for fewer than three readings. held: of the hold so far; age: readings since the
    middle of the motion.

    Clay at yield creeps with the logarithm of time: its rate is proportional to 1 / (time since its start). The start
    is estimated from the decay of the rate over the last half of the hold, but is not later than the middle of the
    motion, since oscillations first hide the creep and decay faster. The mean of the forces on two gels moves the body
    as a whole, which oscillates longest; it is left out.
    """
    if len(held) < 3:
        return math.inf
    span = max(1, len(held) // 4)
    first, second, third = (_internal_forces(held[at].contact) for at in (-1 - 2 * span, -1 - span, -1))
    before, now = second - first, third - second
    swings = before * now <= 0.0
    share = np.divide(now, before, out=np.zeros_like(now), where=~swings)
    began = np.maximum(span / np.maximum(1.0 - share, 1e-6), age)
    to_come = np.abs(now) / span * began * np.log1p(FORECAST_READINGS / began)
    return float(to_come.max()) / max(float(np.abs(held[-1].contact).max()), held[-1].floor)


def force_loss(driven: ForceReading, rest: ForceReading) -> float:
    """Force between the gels at the end of a path minus the force at rest, relative to the force at rest [-].

    The difference is stress that is caused by the speed. A body that yields has flowed by it; in a slow motion it has
    not.
    """
    before, now = (float(np.linalg.norm(_internal_forces(reading.contact), axis=1).max()) for reading in (driven, rest))
    return max(0.0, before - now) / max(now, rest.floor)


def _internal_forces(contact: NDArray[np.float64]) -> NDArray[np.float64]:
    """Forces that squeeze and shear a body between gels: the forces on the gels (gels, 3) without their mean."""
    return contact - contact.mean(axis=0) if len(contact) > 1 else contact


@dataclass(frozen=True)
class Launch:
    """Request of a motion: substeps first..last of a path, and a number of ForceReadings at equal intervals, the last
    at the end."""

    path: Path
    first: int
    last: int
    readings: int = 1

    @property
    def is_held(self) -> bool:
        """Sensors do not move."""
        return self.path.substeps == 0

    @property
    def is_flowing(self) -> bool:
        """The motion passes its target without stopping."""
        return self.path.rates is not None

    def span(self, frames: Sequence[str]) -> LaunchSpan:
        """See `Path.span`."""
        return self.path.span(frames, self.first, self.last)


@dataclass(frozen=True)
class PreparedLaunch:
    """A launch for which one environment is prepared: its grid is fitted and its parameters are set."""

    launch: Launch
    where: Callable[[], LaunchSpan]  # part of the motion; a text that only a failure needs
    drive: NDArray[np.float32]  # (n, frames, 6, 3) of the kernel
    before: State  # copies of the environment's arrays


# The logic of one world's motion, without kernels: it yields a Launch and receives its ForceReadings by `send`, or the
# SimulationDiverged of the launch by `throw`. So many worlds can advance in one launch of kernels, each in another
# phase of its motion; `run_motion` runs the motion of a single world.
Motion = Generator[Launch, Sequence[ForceReading], MoveStats]


def run_motion(motion: Motion, advance: Callable[[Launch], Sequence[ForceReading]]) -> MoveStats:
    """Runs one world's motion to its end. An interrupted motion is closed, which restores the world."""
    try:
        wanted = next(motion)
        while True:
            try:
                readings = advance(wanted)
            except SimulationDiverged as failure:
                wanted = motion.throw(failure)
            else:
                wanted = motion.send(readings)
    except StopIteration as end:
        stats: MoveStats = end.value
        return stats
    finally:
        motion.close()


def move_and_settle(path: Path, settling: Settling, *, balanced: bool, max_readings: int = 1) -> Motion:
    """Follows `path`, then holds at its end until the residual is within tolerance or the hold budget is spent.

    A body that creeps (`Path.is_creeping`) must have a small expected creep at two readings: at a single one, the force
    may just change its direction.

    max_readings: of one launch. Launches with several readings are used: the start of a launch takes longer than the
    substeps that single readings would save.
    """
    readings = yield from _follow_path(path)
    followed = len(readings)
    rest = replace(path, start=path.end, substeps=0, rates=None)
    held, worst = 0, math.inf
    first, later = (max(1, min(max_readings, substeps // path.interval)) for substeps in SUBSTEPS_PER_HOLD)
    while held < settling.max_substeps and worst > settling.tolerance:
        left = settling.max_substeps - held
        wanted = min(later if held else first, math.ceil(left / path.interval))
        readings += yield Launch(rest, 0, min(wanted * path.interval, left), wanted)
        held = min(held + wanted * path.interval, settling.max_substeps)
        if len(readings) > COMPARED_READINGS:
            earlier = readings[-1 - COMPARED_READINGS : -1]
            worst = max(residual(readings[-1], each, balanced) for each in earlier)
        if worst > settling.tolerance and held < settling.max_substeps:
            continue
        if len(readings) > COMPARED_READINGS:
            worst = max(worst, remaining_contact_creep(*readings[-3:]))
        if path.is_creeping:
            age = (path.substeps / 2 + held) / path.interval
            worst = max(
                worst,
                remaining_body_creep(readings[followed:-1], age - 1),
                remaining_body_creep(readings[followed:], age),
            )
    lost = force_loss(readings[followed - 1], readings[-1]) if path.is_creeping and followed and held else 0.0
    followable = not path.unsettled_reason and lost <= path.max_force_loss
    return replace(_motion_stats(readings, path.substeps, held, worst, settling, followed=followable), force_loss=lost)


def move_real_time(path: Path, settling: Settling, *, balanced: bool) -> Motion:
    """Follows `path` without a hold; the residual measures the deviation from rest at the end."""
    readings = yield from _follow_path(path)
    worst = residual(readings[-1], readings[-2], balanced) if len(readings) > 1 else math.inf
    return _motion_stats(readings, path.substeps, 0, worst, settling)


def move_flowing(path: Path, settling: Settling, *, balanced: bool, max_readings: int = 1) -> Motion:
    """Follows `path`, which does not end at rest; the residual is the imbalance of forces at its end."""
    if not path.substeps:
        return (yield from move_and_settle(path, settling, balanced=balanced, max_readings=max_readings))
    readings = yield from _follow_path(path)
    stats = _motion_stats(readings, path.substeps, 0, residual(readings[-1], readings[-1], balanced), settling)
    return replace(stats, settled=False)


def come_to_rest(path: Path, motion: Motion) -> Motion:
    """Follows `path`, which ends at rest, then runs `motion`."""
    yield from _follow_path(path)
    stats = yield from motion
    return replace(stats, substeps=path.substeps + stats.substeps)


def _follow_path(path: Path) -> Generator[Launch, Sequence[ForceReading], list[ForceReading]]:
    readings: list[ForceReading] = []
    for first in range(0, path.substeps, SUBSTEPS_PER_LAUNCH):
        readings += yield Launch(path, first, min(first + SUBSTEPS_PER_LAUNCH, path.substeps))
    return readings


def _motion_stats(
    readings: Sequence[ForceReading], substeps: int, held: int, worst: float, settling: Settling, *,
    followed: bool = True,
) -> MoveStats:  # fmt: skip
    overlap = readings[-1].overlap / MM if readings else 0.0
    hits = sum(reading.guard_hits for reading in readings)
    last = readings[-1].integration if readings else Integration()
    smallest, largest = readings[-1].volumes if readings else (1.0, 1.0)
    return MoveStats(
        substeps + held, held, worst, worst <= settling.tolerance and followed, overlap, hits,
        time_step=last.step / MM, damping=last.damping,
        courant=max((reading.integration.courant for reading in readings), default=0.0),
        gel_overlap=readings[-1].gel_overlap / MM if readings else 0.0,
        smallest_volume=smallest, largest_volume=largest,
    )  # fmt: skip
