"""The cell in closed form: Hertz's numbers, and pictures that show them."""

from __future__ import annotations

import numpy as np
import pytest

from robot.mock.cell.hertz import BALL_GAP, BALL_RADIUS, HertzCell, dent
from robot.mock.cell.sim_server import SimServer, SimServerError
from tacsim import pose as se3
from tacsim.config import load_rig
from tacsim.interface import Pose
from tacsim.models.sensor import CameraNoise, CanonicalGrid, SensorModel
from tacsim.optics.surface import surface_map

START: dict[str, Pose] = {}  # of the sensors


@pytest.fixture(scope="module")
def cell() -> HertzCell:
    scene = load_rig("mock").config.scene
    assert scene is not None
    made = HertzCell(scene, {"lower": SensorModel(), "upper": SensorModel()}, CanonicalGrid())
    START.update(made.poses())
    return made


def pressed(depth: float, x: float = 0.0) -> dict[str, Pose]:
    """Both sensors, `depth` into their balls, which then lie at `x` before the middle of the gels."""
    ahead = Pose(np.array([-x, 0.0, BALL_GAP + depth]))
    return {name: se3.compose(pose, ahead) for name, pose in START.items()}


def test_hertz_cell_force_equals_closed_form(cell: HertzCell) -> None:
    material = cell._gels["lower"].material
    modulus = material.youngs_modulus / (1 - material.poisson_ratio**2)
    cell.move(pressed(0.4e-3, x=1e-3))
    for wrench in map(cell.wrench, ("lower", "upper")):
        assert wrench[2] == pytest.approx(-4 / 3 * modulus * np.sqrt(BALL_RADIUS) * 0.4e-3**1.5, rel=1e-6)
        assert wrench[3:] == pytest.approx(np.cross([1e-3, 0, 0], wrench[:3]), abs=1e-9)
    cell.move(pressed(-0.1e-3))
    assert not cell.wrench("upper").any()


def test_hertz_cell_dent_equals_closed_form() -> None:
    depth, size = 0.5e-3, (16e-3, 16e-3)
    surface = surface_map(dent(size, depth, 1e-3, -0.5e-3), grid=CanonicalGrid(), markers=None)
    grid = CanonicalGrid()
    x = (np.arange(grid.columns) - (grid.columns - 1) / 2) * grid.pitch - 1e-3
    y = (np.arange(grid.rows) - (grid.rows - 1) / 2) * grid.pitch + 0.5e-3
    r = np.hypot(*np.meshgrid(x, y))
    inside = r < 0.8 * np.sqrt(BALL_RADIUS * depth)
    assert surface.height[inside] == pytest.approx((depth - r**2 / (2 * BALL_RADIUS))[inside], abs=5e-6)
    far = (r > 5e-3) & (r < 6e-3)  # of a point load: u = F / (pi E* r)
    point = 4 * (BALL_RADIUS * depth) ** 1.5 / (3 * np.pi * BALL_RADIUS * r)
    assert surface.height[far] == pytest.approx(point[far], rel=0.03)


def test_hertz_cell_image_changes_only_at_contact(cell: HertzCell) -> None:

    def picture(depth: float, x: float) -> np.ndarray:
        cell.move(pressed(depth, x))
        return cell.render("lower")[0].astype(int)

    calm = picture(-0.2e-3, 0.0)
    assert np.array_equal(calm, picture(-0.3e-3, 1e-3))
    touched = picture(0.5e-3, 2e-3)
    change = np.abs(touched - calm).sum(axis=2)
    columns = change.sum(axis=0)
    middle = (columns * np.arange(len(columns))).sum() / columns.sum()
    assert middle > len(columns) / 2 + 10


def test_hertz_cell_ball_through_gel_is_refused(cell: HertzCell) -> None:
    with pytest.raises(ValueError, match=r"sensor 'lower' is pressed 4\.00 mm into a ball, its gel is 4 mm thick"):
        cell.move(pressed(4e-3))


@pytest.mark.slow
def test_hertz_cell_process_reports_errors() -> None:
    scene = load_rig("mock").config.scene
    assert scene is not None
    with pytest.raises(SimServerError, match="has no sensor 'left'; it has lower, upper"):
        SimServer(scene, {"left": SensorModel()}, CanonicalGrid(), "hertz")
    with SimServer(scene, {"upper": SensorModel()}, CanonicalGrid(), "hertz") as sim_server:
        ahead = Pose(np.array([0.0, 0.0, BALL_GAP + 0.3e-3]))
        scene_frame = sim_server.move({"upper": se3.compose(sim_server.initial["upper"], ahead)})
        assert scene_frame.wrenches["upper"][2] < 0.0
        assert scene_frame.surfaces["upper"].height.max() == pytest.approx(0.3e-3, rel=0.05)
        assert scene_frame.truth is None


def test_hertz_cell_noise_changes_image_not_surface(cell: HertzCell) -> None:
    scene = load_rig("mock").config.scene
    assert scene is not None
    noisy = SensorModel(noise=CameraNoise(deviation=(2, 2, 2)))
    made = HertzCell(scene, {"lower": SensorModel(), "upper": noisy}, CanonicalGrid())
    cell.place(made.poses())
    plain = cell.render("upper")[0].astype(float)
    first, second = made.render("upper"), made.render("upper")
    assert (first[0] - plain).std() == pytest.approx(2.0, rel=0.05)
    assert np.corrcoef((first[0] - plain).ravel(), (second[0] - plain).ravel())[0, 1] < 0.1
    np.testing.assert_array_equal(first[1].height, second[1].height)
    np.testing.assert_array_equal(made.render("lower")[0], made.render("lower")[0])
