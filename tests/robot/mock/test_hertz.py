"""The bench in closed form: Hertz's numbers, and pictures that show them."""

from __future__ import annotations

import numpy as np
import pytest

from robot.mock.cell.hertz import GAP, RADIUS, HertzBench, dent
from robot.mock.cell.sim_server import Twin, TwinError
from tacsim import pose as se3
from tacsim.config import load_rig
from tacsim.interface import Pose
from tacsim.models.sensor import CameraNoise, CanonicalGrid, SensorModel
from tacsim.optics.surface import surface_map

START: dict[str, Pose] = {}  # of the sensors


@pytest.fixture(scope="module")
def bench() -> HertzBench:
    scene = load_rig("mock").config.scene
    assert scene is not None
    made = HertzBench(scene, {"lower": SensorModel(), "upper": SensorModel()}, CanonicalGrid())
    START.update(made.poses())
    return made


def pressed(depth: float, x: float = 0.0) -> dict[str, Pose]:
    """Both sensors, `depth` into their balls, which then lie at `x` before the middle of the gels."""
    ahead = Pose(np.array([-x, 0.0, GAP + depth]))
    return {name: se3.compose(pose, ahead) for name, pose in START.items()}


def test_force_is_that_of_hertz_and_pushes_the_sensor_back(bench: HertzBench) -> None:
    material = bench._gel.material
    modulus = material.youngs_modulus / (1 - material.poisson_ratio**2)
    bench.move(pressed(0.4e-3, x=1e-3))
    for wrench in map(bench.wrench, ("lower", "upper")):
        assert wrench[2] == pytest.approx(-4 / 3 * modulus * np.sqrt(RADIUS) * 0.4e-3**1.5, rel=1e-6)
        assert wrench[3:] == pytest.approx(np.cross([1e-3, 0, 0], wrench[:3]), abs=1e-9)
    bench.move(pressed(-0.1e-3))
    assert not bench.wrench("upper").any()


def test_the_dent_is_that_of_hertz() -> None:
    depth, size = 0.5e-3, (16e-3, 16e-3)
    surface = surface_map(dent(size, depth, 1e-3, -0.5e-3), grid=CanonicalGrid(), markers=None)
    grid = CanonicalGrid()
    x = (np.arange(grid.columns) - (grid.columns - 1) / 2) * grid.pitch - 1e-3
    y = (np.arange(grid.rows) - (grid.rows - 1) / 2) * grid.pitch + 0.5e-3
    r = np.hypot(*np.meshgrid(x, y))
    inside = r < 0.8 * np.sqrt(RADIUS * depth)
    assert surface.height[inside] == pytest.approx((depth - r**2 / (2 * RADIUS))[inside], abs=5e-6)
    far = (r > 5e-3) & (r < 6e-3)  # of a point load: u = F / (pi E* r)
    point = 4 * (RADIUS * depth) ** 1.5 / (3 * np.pi * RADIUS * r)
    assert surface.height[far] == pytest.approx(point[far], rel=0.03)


def test_pictures_change_where_the_ball_touches_and_only_there(bench: HertzBench) -> None:

    def picture(depth: float, x: float) -> np.ndarray:
        bench.move(pressed(depth, x))
        return bench.look("lower")[0].astype(int)

    calm = picture(-0.2e-3, 0.0)
    assert np.array_equal(calm, picture(-0.3e-3, 1e-3))
    touched = picture(0.5e-3, 2e-3)
    change = np.abs(touched - calm).sum(axis=2)
    columns = change.sum(axis=0)
    middle = (columns * np.arange(len(columns))).sum() / columns.sum()
    assert middle > len(columns) / 2 + 10


def test_a_ball_does_not_go_through_the_gel(bench: HertzBench) -> None:
    with pytest.raises(ValueError, match=r"sensor 'lower' is pressed 4\.00 mm into a ball, its gel is 4 mm thick"):
        bench.move(pressed(4e-3))


def test_its_process_says_what_is_wrong() -> None:
    scene = load_rig("mock").config.scene
    assert scene is not None
    with pytest.raises(TwinError, match="has no sensor 'left'; it has lower, upper"):
        Twin(scene, {"left": SensorModel()}, CanonicalGrid(), "hertz")
    with Twin(scene, {"upper": SensorModel()}, CanonicalGrid(), "hertz") as twin:
        ahead = Pose(np.array([0.0, 0.0, GAP + 0.3e-3]))
        scenery = twin.move({"upper": se3.compose(twin.initial["upper"], ahead)})
        assert scenery.wrenches["upper"][2] < 0.0
        assert scenery.surfaces["upper"].height.max() == pytest.approx(0.3e-3, rel=0.05)
        assert scenery.truth is None


def test_a_camera_with_noise_shows_another_picture_each_time_and_the_same_surface(bench: HertzBench) -> None:
    scene = load_rig("mock").config.scene
    assert scene is not None
    noisy = SensorModel(noise=CameraNoise(deviation=(2, 2, 2)))
    made = HertzBench(scene, {"lower": SensorModel(), "upper": noisy}, CanonicalGrid())
    bench.place(made.poses())
    plain = bench.look("upper")[0].astype(float)
    first, second = made.look("upper"), made.look("upper")
    assert (first[0] - plain).std() == pytest.approx(2.0, rel=0.05)
    assert np.corrcoef((first[0] - plain).ravel(), (second[0] - plain).ravel())[0, 1] < 0.1
    np.testing.assert_array_equal(first[1].height, second[1].height)
    np.testing.assert_array_equal(made.look("lower")[0], made.look("lower")[0])
