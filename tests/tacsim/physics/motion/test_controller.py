"""What counts as rest."""

from dataclasses import replace

import numpy as np
import pytest

from tacsim.interface import Pose
from tacsim.models.scene import Settling
from tacsim.physics.motion.controller import (
    ForceReading,
    Launch,
    move_and_settle,
    remaining_body_creep,
    remaining_contact_creep,
    residual,
    run_motion,
)
from tacsim.physics.motion.path import Path
from tacsim.physics.motion.tuning import FORECAST_READINGS


def test_contact_forces_balance_the_weight_of_the_body() -> None:
    weight = np.array([0.0, 0.3, -0.4])
    contact = np.array([[0.0, 0.3, -1.4], [0.0, 0.0, 1.0]])  # on the gels
    hung = ForceReading(contact, contact, 0.1, 0.0, 0, load=weight)
    assert residual(hung, hung, balanced=True) == pytest.approx(0.0, abs=1e-12)
    weightless = replace(hung, load=None)
    assert residual(weightless, weightless, balanced=True) == pytest.approx(0.4 / 1.4)
    falling = replace(hung, contact=np.zeros((2, 3)), backing=np.zeros((2, 3)))
    assert residual(falling, falling, balanced=True) == pytest.approx(0.4 / 0.1)
    assert residual(falling, falling, balanced=False) == 0.0


def reading(drag: float) -> ForceReading:
    force = np.array([[drag, 0.0, -1.0]])
    return ForceReading(force, force, 0.1, 0.0, 0)


def test_what_creeps_is_held_until_little_is_left_of_it() -> None:
    """A drag that loses 5 % of what it is above 0.5 from reading to reading: each change is soon within the tolerance,
    while 20 times as much is still to come."""
    drags = (0.5 + 0.1 * 0.95**n for n in range(1000))
    path = Path([Pose()], [Pose()], 0, 0.4)
    stats = run_motion(
        move_and_settle(path, Settling(max_substeps=100_000), balanced=False),
        lambda launch: [reading(next(drags))],
    )
    left = 0.1 * 0.95 ** (stats.hold // path.interval - 1)
    assert stats.settled
    assert 0.5e-2 < left <= 1e-2
    assert stats.residual == pytest.approx(left, rel=0.01)


def test_what_swings_or_stands_has_nothing_still_to_come() -> None:
    assert remaining_contact_creep(reading(0.5), reading(0.51), reading(0.505)) == 0.0
    assert remaining_contact_creep(reading(0.5), reading(0.5), reading(0.5)) == 0.0


def creeping(share: float, after: float) -> ForceReading:
    """A force that falls with the logarithm of time, by `share` in each e-fold of it, `after` so many readings."""
    return reading(0.5 - share * float(np.log(after)))


@pytest.mark.parametrize("before", [1, 40])
def test_remaining_creep_of_logarithmic_creep_is_estimated(before: int) -> None:
    """Whenever it began: the motion alone would have it 10 readings older than the hold."""
    held = [creeping(0.01, before + n) for n in range(1, 41)]
    lost = 0.01 * np.log1p(FORECAST_READINGS / (before + 40))
    told = remaining_body_creep(held, 40 + (10 if before > 10 else 1))
    assert 0.95 * lost < told < 1.25 * lost


def test_a_creep_that_turns_is_as_old_as_the_motion() -> None:
    held = [reading(0.5 + 0.01 * change) for change in (0, 1, 0)]
    assert remaining_body_creep(held, 20.0) == pytest.approx(0.01 * 20 * np.log1p(FORECAST_READINGS / 20))


def test_a_body_that_swings_between_two_gels_does_not_creep() -> None:
    """What one gel feels more, the other feels less."""
    forces = [np.array([[0.0, 0.0, -1.0 + swing], [0.0, 0.0, 1.0 + swing]]) for swing in (0.0, 0.01, 0.015)]
    held = [ForceReading(force, force, 0.1, 0.0, 0) for force in forces]
    assert remaining_body_creep(held, 20.0) == pytest.approx(0.0, abs=1e-12)
    squeezed = [replace(each, contact=each.contact * [[1.0], [0.0]]) for each in held]
    assert remaining_body_creep(squeezed, 20.0) > 0.01


def test_a_launch_gives_several_readings_where_it_can() -> None:
    """Of a hold in steps of 4 substeps the first four, later ones three."""

    def settled(most: int) -> tuple[int, list[int]]:
        times, asked = iter(range(8, 1000)), list[int]()

        def advance(launch: Launch) -> list[ForceReading]:
            asked.append(launch.readings)
            assert launch.last == launch.readings * launch.path.interval
            return [creeping(0.02, next(times)) for _ in range(launch.readings)]

        path = replace(Path([Pose()], [Pose()], 0, 0.4, interval=4), is_creeping=True)
        stats = run_motion(
            move_and_settle(path, Settling(max_substeps=100_000), balanced=False, max_readings=most), advance
        )
        assert stats.settled and stats.hold == 4 * sum(asked)
        return stats.hold, asked

    hold, one_by_one = settled(1)
    longer, asked = settled(4)
    assert set(one_by_one) == {1} and asked[0] == 4 and set(asked[1:]) == {3} and set(settled(2)[1]) == {2}
    assert hold <= longer <= hold + 2 * 4


@pytest.mark.parametrize("creeps", [True, False])
def test_logarithmic_creep_settles_only_below_tolerance(creeps: bool) -> None:
    """Each change is within the tolerance from the start, and so is what a geometric rest of them would be."""
    path = replace(Path([Pose()], [Pose()], 0, 0.4), is_creeping=creeps)
    times = iter(range(8, 1000))
    stats = run_motion(
        move_and_settle(path, Settling(max_substeps=100_000), balanced=False),
        lambda launch: [creeping(0.01, next(times))],
    )
    after = 7 + stats.hold // path.interval
    assert stats.settled
    assert (0.01 * np.log1p(FORECAST_READINGS / after) <= 1e-2) == creeps
