"""The quasi-static controller: ramped motion of driven frames, then a hold until the measured residual is small.

Materials are rate-independent, so only the path counts (tacsim.physics.motion.path); the hold waits for what still
moves at its end.
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
    """The smallest force [N] that residuals are relative to, of a gel with Young's modulus [MPa] and thickness [mm]."""
    return MIN_FORCE_SHARE * modulus * thickness**2


@dataclass(frozen=True)
class Integration:
    """How a launch was integrated."""

    step: float = 0.0  # time step [mm, wave speed 1]
    damping: float = 0.0  # of the gel: its rate times the wave's time through it [-]
    courant: float = 0.0  # see tacsim.physics.failure.health.Health


@dataclass(frozen=True)
class ForceReading:
    """Forces at one instant [N]: contact on each gel and reaction at its backing, world axes; and what guards saw.

    moment: about each sensor's origin, in its own axes, divided by half the gel's width [N].
    load: external force on the body besides contact, world axes.
    torque: of all contact on a free body about its centre, world axes, divided likewise [N].
    """

    contact: NDArray[np.float64]  # (gels, 3)
    backing: NDArray[np.float64]  # (gels, 3)
    floor: float  # [N] residuals are relative to at least this
    overlap: float  # [mm]
    guard_hits: int
    moment: NDArray[np.float64] | None = None  # (gels, 3)
    load: NDArray[np.float64] | None = None  # (3,) of the body from elsewhere: its weight
    torque: NDArray[np.float64] | None = None  # (3,)
    integration: Integration = Integration()
    gel_overlap: float = 0.0  # of the gels with one another [mm]
    volumes: tuple[float, float] = (1.0, 1.0)  # least and largest elastic volume ratio of the body's particles


def residual(reading: ForceReading, before: ForceReading, balanced: bool) -> float:
    """Largest imbalance of forces or moments, or their change since `before`, relative to the largest force [-].

    `balanced`: the contact forces on all gels must add up to the load of a free body, its weight, and have no torque.
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


def still_to_come(first: ForceReading, second: ForceReading, third: ForceReading) -> float:
    """How far the contact forces will still creep, relative to the largest force [-]: what is left of a change that
    shrinks by the same share from reading to reading, as contact that slips ever more slowly does.

    A change that swings leaves nothing; of one that hardly shrinks only the next FORECAST_READINGS count.
    """
    before, now = second.contact - first.contact, third.contact - second.contact
    creeping = before * now > 0.0
    share = np.minimum(now[creeping] / before[creeping], 1.0)
    to_come = np.abs(now[creeping]) * np.minimum(share / np.maximum(1.0 - share, 1e-9), FORECAST_READINGS)
    return float(to_come.max(initial=0.0)) / max(float(np.abs(third.contact).max()), third.floor)


def creep_to_come(held: Sequence[ForceReading], age: float) -> float:
    """How far the contact forces of a body that flows will fall in FORECAST_READINGS more, relative to the largest
    force [-]; infinite of fewer than three. held: of the hold so far; age: readings since the motion's middle.

    Clay at yield creeps with the logarithm of time: its rate goes with 1 / (time since it began), so the creep is as
    old as the shrinking of its rate over the last half of the hold says. It is no younger than the motion: what rings
    hides it at first, and swings shrink faster. Two gels creep alike: the mean of their forces moves the body as a
    whole, which swings longest, and is left out.
    """
    if len(held) < 3:
        return math.inf
    span = max(1, len(held) // 4)
    first, second, third = (_between(held[at].contact) for at in (-1 - 2 * span, -1 - span, -1))
    before, now = second - first, third - second
    swings = before * now <= 0.0
    share = np.divide(now, before, out=np.zeros_like(now), where=~swings)
    began = np.maximum(span / np.maximum(1.0 - share, 1e-6), age)
    to_come = np.abs(now) / span * began * np.log1p(FORECAST_READINGS / began)
    return float(to_come.max()) / max(float(np.abs(held[-1].contact).max()), held[-1].floor)


def force_loss(driven: ForceReading, rest: ForceReading) -> float:
    """How much larger the force between the gels was at the end of a path than it is at rest, relative to that [-].

    The difference is stress that the motion itself cost. A body that yields has flowed by it, and a slow one has not.
    """
    before, now = (float(np.linalg.norm(_between(reading.contact), axis=1).max()) for reading in (driven, rest))
    return max(0.0, before - now) / max(now, rest.floor)


def _between(contact: NDArray[np.float64]) -> NDArray[np.float64]:
    """What squeezes and shears a body that lies between gels: the forces on them (gels, 3) without their mean."""
    return contact - contact.mean(axis=0) if len(contact) > 1 else contact


@dataclass(frozen=True)
class Launch:
    """What a motion wants next: substeps first..last of a path, and ForceReadings at so many equal distances in it, the
    last at its end."""

    path: Path
    first: int
    last: int
    readings: int = 1

    @property
    def held(self) -> bool:
        """Sensors stand still."""
        return self.path.substeps == 0

    @property
    def flowing(self) -> bool:
        """It belongs to a motion that flows into the next."""
        return self.path.rates is not None

    def span(self, frames: Sequence[str]) -> LaunchSpan:
        """See `Path.span`."""
        return self.path.span(frames, self.first, self.last)


@dataclass(frozen=True)
class PreparedLaunch:
    """A launch that one environment is ready for: its grid is fitted and its parameters are set."""

    launch: Launch
    where: Callable[[], LaunchSpan]  # which part of the motion it is: words that only a failure needs
    drive: NDArray[np.float32]  # (n, frames, 6, 3) of the kernel
    before: State  # copies of the environment's arrays


# The logic of one world's motion, which touches no kernel: it yields a Launch and is sent its ForceReadings, or thrown
# the SimulationDiverged that the launch ended in. So many worlds can advance in one launch of kernels, each at its own
# phase of its own motion; `run` runs the motion of a single world.
Motion = Generator[Launch, Sequence[ForceReading], MoveStats]


def run(motion: Motion, advance: Callable[[Launch], Sequence[ForceReading]]) -> MoveStats:
    """Runs one world's motion to its end. An interrupted motion is closed, so it rolls back."""
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


def move_and_settle(path: Path, settling: Settling, *, balanced: bool, most: int = 1) -> Motion:
    """Follows `path`, then holds at its end until the residual is within tolerance or the hold budget is spent.

    What creeps (`Path.creeps`) must have little to come at two readings: at one of them it may just turn.

    most: readings that a launch can give. It takes several: a launch costs more than the substeps that it would save.
    """
    readings = yield from _follow(path)
    followed = len(readings)
    rest = replace(path, start=path.end, substeps=0, rates=None)
    held, worst = 0, math.inf
    first, later = (max(1, min(most, substeps // path.interval)) for substeps in SUBSTEPS_PER_HOLD)
    while held < settling.max_substeps and worst > settling.tolerance:
        left = settling.max_substeps - held
        wanted = min(later if held else first, math.ceil(left / path.interval))
        readings += yield Launch(rest, 0, min(wanted * path.interval, left), wanted)
        held = min(held + wanted * path.interval, settling.max_substeps)
        if len(readings) > COMPARED_READINGS:
            earlier = readings[-1 - COMPARED_READINGS : -1]
            worst = max(residual(readings[-1], each, balanced) for each in earlier)
            worst = max(worst, still_to_come(*readings[-3:]))
        if path.creeps:
            age = (path.substeps / 2 + held) / path.interval
            worst = max(worst, creep_to_come(readings[followed:-1], age - 1), creep_to_come(readings[followed:], age))
    lost = force_loss(readings[followed - 1], readings[-1]) if path.creeps and followed and held else 0.0
    followable = not path.unfollowed and lost <= path.max_force_loss
    return replace(_stats(readings, path.substeps, held, worst, settling, followed=followable), force_loss=lost)


def move_real_time(path: Path, settling: Settling, *, balanced: bool) -> Motion:
    """Follows `path` without a hold; the residual says how far from rest the scene is at the end."""
    readings = yield from _follow(path)
    worst = residual(readings[-1], readings[-2], balanced) if len(readings) > 1 else math.inf
    return _stats(readings, path.substeps, 0, worst, settling)


def move_flowing(path: Path, settling: Settling, *, balanced: bool, most: int = 1) -> Motion:
    """Follows `path`, which does not end at rest; the residual is the imbalance of forces there."""
    if not path.substeps:
        return (yield from move_and_settle(path, settling, balanced=balanced, most=most))
    readings = yield from _follow(path)
    stats = _stats(readings, path.substeps, 0, residual(readings[-1], readings[-1], balanced), settling)
    return replace(stats, settled=False)


def come_to_rest(path: Path, motion: Motion) -> Motion:
    """Follows `path`, which ends at rest, then does `motion`."""
    yield from _follow(path)
    stats = yield from motion
    return replace(stats, substeps=path.substeps + stats.substeps)


def _follow(path: Path) -> Generator[Launch, Sequence[ForceReading], list[ForceReading]]:
    readings: list[ForceReading] = []
    for first in range(0, path.substeps, SUBSTEPS_PER_LAUNCH):
        readings += yield Launch(path, first, min(first + SUBSTEPS_PER_LAUNCH, path.substeps))
    return readings


def _stats(
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
