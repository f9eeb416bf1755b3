"""The shape of a body by touch alone: solids known in closed form that roll between two gels without slip."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from tacsim.interface import ArmState, FloatArray, Observation, Pose, TactileObservation
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.grid import canonical_cells
from tacsim.pose import HALF_TURN_X
from tacsim.tasks.knead import Solid, TactileShape, chamfer_distance

GRID = CanonicalGrid()
DEPTH = 0.3e-3  # of the body in each gel [m]
BALL, ROD = 4e-3, (3e-3, 9e-3)  # radius; radius, length [m]
Top = Callable[[FloatArray, FloatArray], FloatArray]  # half the thickness of a body over x, y from its middle; 0 beside


def size_of(shape: TactileShape, volume: float) -> FloatArray:
    """Of a cloud of points, each of which stands for a cube."""
    points = shape.points()
    assert points is not None
    return np.ptp(points, axis=0) + (volume / len(points)) ** (1 / 3)


def ball(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(BALL**2 - x**2 - y**2, 0.0))


def rod(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(ROD[0] ** 2 - y**2, 0.0)) * (np.abs(x) <= ROD[1] / 2)


def bar(turn: float, half: FloatArray) -> Top:
    """An elliptic cylinder of half axes (x: half its length, y, z) that has turned by `turn` about x."""

    def top(x: FloatArray, y: FloatArray) -> FloatArray:
        s, c = np.sin(turn), np.cos(turn)
        a, b, g = (s / half[1]) ** 2 + (c / half[2]) ** 2, s * c * (half[1] ** -2 - half[2] ** -2), 0.0
        g = (c / half[1]) ** 2 + (s / half[2]) ** 2
        inside = np.maximum((b * y) ** 2 - a * (g * y**2 - 1.0), 0.0)
        upper = (-b * y + np.sqrt(inside)) / a
        return np.where((inside > 0) & (np.abs(x) <= half[0]), upper, 0.0)

    return top


def touched(top: Top, height: float, middle: FloatArray, upper: FloatArray) -> Observation:
    """Two gels on a body in the middle (x, y), which point-symmetric bodies press in by DEPTH at their highest."""
    cells = canonical_cells(GRID).points()
    z = height / 2 - DEPTH
    poses = {
        "lower": Pose(np.array([0.0, 0.0, -z])),
        "upper": Pose(np.array([*upper, z]), HALF_TURN_X.quaternion),
    }
    tactile, valid = {}, np.ones((GRID.rows, GRID.columns), bool)
    for name, pose in poses.items():
        side = 1.0 if name == "upper" else -1.0  # below is above, seen through the middle
        x = cells[..., 0] + pose.position[0] - middle[0]
        y = -side * cells[..., 1] + pose.position[1] - middle[1]
        depth = np.maximum(top(side * x, side * y) - z, 0.0).astype(np.float32)
        image = np.zeros((1, 1, 3), np.uint8)
        tactile[name] = TactileObservation(
            image, gradient=None, height=depth, contact=depth > 20e-6, valid=valid, flow=None, time=0.0, age=0.0
        )
    arms = {name: ArmState(pose, np.zeros(6), np.zeros(6), None, 0.0) for name, pose in poses.items()}
    return Observation(tactile, arms, 0.0)


def path(reach: float, *directions: float) -> Iterator[FloatArray]:
    """To and fro, in each direction [rad] once."""
    for direction in directions:
        for way in np.concatenate(
            [np.linspace(0, reach, 7), np.linspace(reach, -reach, 13), np.linspace(-reach, 0, 7)]
        ):
            yield way * np.array([np.cos(direction), np.sin(direction)])


def volume_of_bar(half: FloatArray) -> float:
    return float(2 * np.pi * half.prod())


@pytest.mark.slow
def test_a_ball_that_rolls_in_all_directions_is_felt_as_a_ball() -> None:
    volume = 4 / 3 * np.pi * BALL**3
    shape = TactileShape(volume, GRID)
    for upper in path(0.5 * np.pi * 2 * BALL, 0.0, np.pi / 2):
        shape.add_observation(touched(ball, 2 * BALL, upper / 2, upper))
    points = shape.points()
    assert points is not None
    assert chamfer_distance(points, Solid.make_ball(volume), volume) < 0.05e-3


def test_a_rod_that_rolls_across_its_axis_is_felt_as_a_rod() -> None:
    volume = np.pi * ROD[0] ** 2 * ROD[1]
    shape, target = TactileShape(volume, GRID), Solid.make_rod(volume, ROD[1] / (2 * ROD[0]))
    distances = []
    for number, upper in enumerate(path(0.5 * np.pi * 2 * ROD[0], np.pi / 2)):
        shape.add_observation(touched(rod, 2 * ROD[0], upper / 2, upper))
        if number in (0, 26):
            points = shape.points()
            assert points is not None
            distances.append(chamfer_distance(points, target, volume))
    assert distances[1] < 0.05e-3
    assert distances[0] > 4 * distances[1]  # one touch does not tell that it is round


@pytest.mark.parametrize("half", [np.array([4.5e-3, 2.5e-3, 3.5e-3]), np.array([4.5e-3, 3.5e-3, 2.5e-3])])
def test_what_is_not_round_is_felt_as_it_has_turned(half: FloatArray) -> None:
    """An elliptic bar turns by the way of the upper gel over its height at that moment, and shows its other width."""
    volume, turn, before = float(2 * np.pi * half.prod()), 0.0, 0.0
    shape = TactileShape(volume, GRID)
    for upper in path(0.5 * np.pi * (half[1] + half[2]), np.pi / 2):
        for _ in range(2):
            height = 2 * float(np.hypot(half[1] * np.sin(turn), half[2] * np.cos(turn)))
            turn, before = turn - (upper[1] - before) / height, upper[1]
        shape.add_observation(touched(bar(turn, half), height, upper / 2, upper))
    assert size_of(shape, volume)[1:] == pytest.approx(2 * half[1:], rel=0.1)


def slab(half: FloatArray) -> Top:
    return lambda x, y: half[2] * ((np.abs(x) <= half[0]) & (np.abs(y) <= half[1]))


def test_a_slab_is_sheared_not_turned() -> None:
    """Wide contacts of a flat body: what is felt of it stays flat, however far the gel goes."""
    half = np.array([6e-3, 6e-3, 1.2e-3])
    volume = float(8 * half.prod())
    shape = TactileShape(volume, GRID)
    for upper in [*path(6e-3, np.pi / 2)][:15]:
        shape.add_observation(touched(slab(half), 2 * half[2], upper / 2, upper))
    assert size_of(shape, volume) == pytest.approx(2 * half, rel=0.1)


def test_what_has_been_flattened_is_felt_flat_and_as_wide_as_its_volume_asks() -> None:
    """The corners of a slab are not felt at once: its contact is narrower by a fifth than the body."""
    volume, there = 8 * 4e-3 * 5e-3 * 2.5e-3, np.zeros(2)
    shape = TactileShape(volume, GRID)
    shape.add_observation(touched(slab(np.array([3e-3, 3e-3, 4e-3])), 8e-3, there, there))
    shape.add_observation(touched(slab(np.array([3.2e-3, 4e-3, 2.5e-3])), 5e-3, there, there))
    assert size_of(shape, volume) == pytest.approx([8e-3, 10e-3, 5e-3], rel=0.07)


def test_without_touch_nothing_is_known() -> None:
    shape = TactileShape(1e-7, GRID)
    away = touched(lambda x, y: np.zeros_like(x), 8e-3, np.zeros(2), np.zeros(2))
    shape.add_observation(away)
    assert shape.points() is None
