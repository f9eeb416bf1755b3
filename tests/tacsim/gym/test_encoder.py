"""What a learned policy sees: every number against the observation that it stands for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from tacsim.gym.features import FeatureEncoder
from tacsim.interface import ArmState, IncompatibleRig, Needs, Observation, Pose, TactileObservation
from tacsim.models.policy import Features, MapGrid
from tacsim.models.sensor import CanonicalGrid
from tacsim.pose import HALF_TURN_X

GRID = CanonicalGrid(rows=8, columns=12, pitch=0.5e-3, image_scale=2)
COARSE = MapGrid(rows=4, columns=6, pitch=1e-3)


def touch(seed: int) -> TactileObservation:
    random = np.random.default_rng(seed)
    height = random.normal(0, 1e-4, (8, 12)).astype(np.float32)
    return TactileObservation(
        image=random.integers(0, 256, (16, 24, 3), dtype=np.uint8),
        gradient=random.normal(0, 0.1, (8, 12, 2)).astype(np.float32),
        height=height,
        contact=height > 1e-4,
        valid=np.ones((8, 12), np.bool_),
        flow=random.normal(0, 1e-4, (3, 5, 2)).astype(np.float32),
        time=1.0,
        age=0.0,
    )


def arm(pose: Pose, wrench: Any = (0.0,) * 6) -> ArmState:
    return ArmState(pose, np.zeros(6), np.array(wrench, dtype=np.float64), None, 1.0)


def observation(seed: int = 0, z: float = 10e-3, **changed: Any) -> Observation:
    arms = {
        "lower": arm(Pose(), (1.0, 2.0, -5.0, 0.01, 0.02, 0.03)),
        "upper": arm(Pose(np.array([1e-3, -2e-3, z]), HALF_TURN_X.quaternion)),
    }
    tactile = {"lower": replace(touch(seed), **changed), "upper": touch(seed + 100)}
    return Observation(tactile, arms, 1.0)


def encoder(**wanted: Any) -> FeatureEncoder:
    return FeatureEncoder(Features(**{"grid": COARSE, "goal": False, **wanted}), GRID)


def test_maps_are_means_of_the_cells_channel_by_channel() -> None:
    seen = observation()
    maps = encoder(maps=("height", "slope", "contact", "image")).begin(seen)["maps"]
    assert maps.shape == (2 * 7, 4, 6) and maps.dtype == np.float32
    lower, upper = seen.tactile["lower"], seen.tactile["upper"]
    assert lower.height is not None and upper.gradient is not None
    assert maps[0, 1, 2] == pytest.approx(1e3 * lower.height[2:4, 4:6].mean(dtype=float), rel=1e-6)  # mm
    assert maps[9, 3, 5] == pytest.approx(
        upper.gradient[6:8, 10:12, 1].mean(dtype=float), rel=1e-6
    )  # after its height and x
    assert maps[3, 0, 0] == pytest.approx(lower.contact[:2, :2].mean())
    assert maps[4, 0, 1] == pytest.approx(lower.image[:4, 4:8, 0].mean() / 128 - 1, rel=1e-6)


def test_maps_lie_in_the_middle_and_leave_out_what_is_not_valid() -> None:
    valid = np.ones((8, 12), np.bool_)
    valid[3, 4:] = False
    valid[4, 4:6] = False
    valid[4, 6:] = False
    seen = observation(valid=valid)
    maps = encoder(grid=MapGrid(rows=1, columns=4, pitch=1e-3), sensors=("lower",), touch=()).begin(seen)["maps"]
    height = seen.tactile["lower"].height
    assert height is not None
    assert maps[0, 0, 0] == pytest.approx(1e3 * height[3:5, 2:4].mean(dtype=float), rel=1e-6)
    assert maps[0, 0, 1:].tolist() == [0.0] * 3  # nothing valid there


def test_a_picture_is_seen_whole_as_the_camera_gave_it() -> None:
    picture = np.random.default_rng(3).integers(0, 256, (13, 18, 3), dtype=np.uint8)
    seen = observation(picture=picture)
    asked = encoder(sensors=("lower",), maps=("height", "picture"), touch=())
    maps = asked.begin(seen)["maps"]
    assert maps.shape == (1 + 3, 4, 6)
    wanted = 2 * picture[3:6, 6:9].mean(axis=(0, 1)) / 255 - 1  # rows 3 to 5 of 13: parts differ by a row at most
    assert maps[1:, 1, 2] == pytest.approx(wanted, abs=1e-6)
    assert maps[1:, 3, 5] == pytest.approx(2 * picture[9:, 15:].mean(axis=(0, 1)) / 255 - 1, abs=1e-6)
    assert asked.inputs["maps"].names[1:] == tuple(f"picture_{c}_lower" for c in ("red", "green", "blue"))
    assert asked.inputs["maps"].scales[1:] == (127.5,) * 3  # grey levels
    # Of the canonical image nothing is left in it, so no canonical grid need fit.
    odd = encoder(sensors=("lower",), maps=("picture",), touch=(), grid=MapGrid(rows=3, columns=5, pitch=0.3e-3))
    assert odd.begin(seen)["maps"].shape == (3, 3, 5)
    assert odd.needs == Needs(frozenset({"lower"}), frozenset({"lower", "upper"}))


def test_a_picture_that_is_missing_or_too_small_is_told() -> None:
    asked = encoder(maps=("picture",), touch=())
    with pytest.raises(IncompatibleRig, match="pictures as the camera gave them, and this sensor delivers none"):
        asked.begin(observation())
    with pytest.raises(IncompatibleRig, match="picture of 3 x 18 px has fewer than 4 x 6 parts"):
        asked.begin(observation(picture=np.zeros((3, 18, 3), np.uint8)))


@pytest.mark.parametrize(
    "grid",
    [
        MapGrid(rows=4, columns=6, pitch=0.75e-3),
        MapGrid(rows=5, columns=6, pitch=1e-3),
        MapGrid(rows=3, columns=6, pitch=0.5e-3),
        MapGrid(rows=4, columns=6, pitch=0.1e-3),
    ],
)
def test_a_grid_that_cannot_be_put_together_is_refused(grid: MapGrid) -> None:
    with pytest.raises(IncompatibleRig, match=r"cannot be put together from the rig's canonical grid of 8 x 12 cells"):
        encoder(grid=grid)
    FeatureEncoder(Features(grid=grid, maps=()), GRID)  # without maps the grid says nothing


def test_touch_holds_what_its_names_say() -> None:
    asked = encoder(touch=("area", "depth", "centroid", "shear", "wrench", "moved", "between"))
    first = observation()
    asked.begin(first)
    later = observation(seed=5, z=9e-3)
    values = dict(zip(asked.inputs["touch"].names, asked(later)["touch"].tolist(), strict=True))
    seen = later.tactile["upper"]
    assert seen.height is not None and seen.flow is not None
    assert values["area_upper"] == pytest.approx(seen.contact.sum() * 0.25e-6 / 1e-4)
    assert values["depth_greatest_upper"] == pytest.approx(1e3 * seen.height.max(), rel=1e-6)
    assert values["depth_mean_upper"] == pytest.approx(1e3 * seen.height[seen.contact].mean(dtype=float), rel=1e-6)
    x, y = np.meshgrid((np.arange(12) - 5.5) * 0.5e-3, (np.arange(8) - 3.5) * 0.5e-3)
    weights = np.where(seen.contact, seen.height, 0.0)
    assert values["centroid_x_upper"] == pytest.approx((weights * x).sum() / weights.sum() / 5e-3, rel=1e-5)
    assert values["centroid_y_upper"] == pytest.approx((weights * y).sum() / weights.sum() / 5e-3, rel=1e-5)
    assert values["shear_y_upper"] == pytest.approx(seen.flow[..., 1].mean() / 0.2e-3, rel=1e-5)
    assert [values[f"force_{axis}_lower"] for axis in "xyz"] == pytest.approx([0.1, 0.2, -0.5])
    assert values["torque_z_lower"] == pytest.approx(0.6)
    assert values["moved_z_upper"] == pytest.approx(0.2)  # 1 mm down, which is along z of a sensor that faces down
    assert values["moved_z_lower"] == 0.0
    assert [values[f"between_{axis}_upper"] for axis in "xyz"] == pytest.approx([0.1, -0.2, 0.9])
    assert "between_x_lower" not in values
    assert all(
        values[f"turn_{c}{a}_{n}"] == pytest.approx(0.0, abs=1e-6)
        for c in "xy"
        for a in "xyz"
        for n in ("lower", "upper")
    )


def test_a_turn_is_that_since_reset() -> None:
    asked = encoder(touch=("moved",))
    asked.begin(observation())
    turned = Rotation.from_rotvec([0.0, 0.0, 0.01]) * Rotation.from_quat(HALF_TURN_X.quaternion)
    later = observation()
    arms = {**later.arms, "upper": arm(Pose(later.arms["upper"].pose.position, turned.as_quat()))}
    values = dict(zip(asked.inputs["touch"].names, asked(replace(later, arms=arms))["touch"].tolist(), strict=True))
    assert values["turn_xy_upper"] == pytest.approx(-0.1, rel=1e-3)  # z of the upper sensor points down
    assert values["turn_yx_upper"] == pytest.approx(0.1, rel=1e-3)


def test_pressure_is_where_the_force_acts_since_reset() -> None:
    """A force at (x, y) of a sensor has the moment (y Fz, -x Fz)."""

    def pressed(x: float, y: float, force: float) -> Observation:
        seen = observation()
        wrench = (0.0, 0.0, force, y * force, -x * force, 0.0)
        return replace(seen, arms={**seen.arms, "lower": arm(Pose(), wrench)})

    asked = encoder(touch=("pressure",))
    names = asked.inputs["touch"].names
    assert names == ("pressure_x_lower", "pressure_y_lower", "pressure_x_upper", "pressure_y_upper")
    assert asked.begin(pressed(1e-3, -2e-3, -3.0))["touch"].tolist() == [0.0] * 4
    assert asked(pressed(3e-3, -1e-3, -5.0))["touch"] == pytest.approx([0.4, 0.2, 0, 0], rel=1e-6)
    assert asked(pressed(3e-3, -1e-3, -1e-6))["touch"].tolist() == [0.0] * 4  # nothing touches
    asked.begin(pressed(1e-3, -2e-3, 0.0))
    assert asked(pressed(1.5e-3, -2e-3, -1.0))["touch"].tolist() == [0.0] * 4  # the first touch of an episode
    assert asked(pressed(2.5e-3, -2e-3, -1.0))["touch"] == pytest.approx([0.2, 0, 0, 0], abs=1e-7)


def test_dragged_is_how_far_the_contact_has_gone_since_the_first_in_the_episode() -> None:
    def pressed(row: int, column: int, depth: float = 1e-4) -> Observation:
        height = np.zeros((8, 12), np.float32)
        height[row : row + 2, column : column + 2] = depth
        return observation(height=height, contact=height > 0)

    asked = encoder(touch=("dragged",))
    names = asked.inputs["touch"].names
    assert names == ("dragged_x_lower", "dragged_y_lower", "dragged_x_upper", "dragged_y_upper")
    assert asked.needs.height
    assert asked.begin(pressed(2, 7))["touch"].tolist() == [0.0] * 4  # wherever it begins
    assert asked(pressed(1, 9))["touch"] == pytest.approx([1.0, -0.5, 0, 0], abs=1e-6)  # cells of 0.5 mm
    assert asked(pressed(1, 9, depth=0.0))["touch"].tolist() == [0.0] * 4  # nothing touches
    assert asked(pressed(3, 7))["touch"] == pytest.approx([0, 0.5, 0, 0], abs=1e-6)  # since the first, still
    asked.begin(pressed(4, 4, depth=0.0))
    assert asked(pressed(4, 4))["touch"].tolist() == [0.0] * 4  # the first contact of a new episode
    assert asked(pressed(5, 4))["touch"] == pytest.approx([0, 0.5, 0, 0], abs=1e-6)


def test_stepped_is_the_way_since_the_last_observation_along_the_axes_of_the_sensor_at_reset() -> None:
    asked = encoder(touch=("stepped",), arms=("upper",))
    assert asked.inputs["touch"].names == ("stepped_x_upper", "stepped_y_upper", "stepped_z_upper")
    assert asked.begin(observation(z=10e-3))["touch"].tolist() == [0.0] * 3
    down = asked(observation(z=9.5e-3))["touch"]
    assert down == pytest.approx([0, 0, 1.0], abs=1e-5)  # of 0.5 mm, by a sensor that faces down
    assert asked(observation(z=9.5e-3))["touch"] == pytest.approx([0, 0, 0], abs=1e-5)
    asked.begin(observation(z=8e-3))
    assert asked(observation(z=8.5e-3))["touch"] == pytest.approx([0, 0, -1.0], abs=1e-5)  # a new episode


def test_without_contact_nothing_is_felt_and_all_is_finite() -> None:
    flat = np.zeros((8, 12), np.float32)
    seen = observation(height=flat, contact=flat > 0)
    asked = encoder(sensors=("lower",), touch=("area", "depth", "centroid", "dragged"))
    assert asked.begin(seen)["touch"].tolist() == [0.0] * 7


def test_frames_are_stacked_oldest_first_and_begin_alike() -> None:
    asked = encoder(frames=3, sensors=("lower",), touch=("depth",))
    views = [observation(seed) for seed in range(3)]
    one = [encoder(sensors=("lower",), touch=("depth",)).begin(view) for view in views]
    begun = asked.begin(views[0])
    assert begun["maps"].tolist() == np.concatenate([one[0]["maps"]] * 3).tolist()
    asked(views[1])
    last = asked(views[2])
    assert last["maps"].tolist() == np.concatenate([each["maps"] for each in one]).tolist()
    assert last["touch"].tolist() == np.concatenate([each["touch"] for each in one]).tolist()
    assert asked.begin(views[1])["touch"].tolist() == one[1]["touch"].tolist() * 3  # a new episode remembers nothing


def test_the_goal_is_told() -> None:
    asked = encoder(goal=True)
    assert asked.begin(observation(), (2e-3, -1e-3))["goal"].tolist() == pytest.approx([0.2, -0.1])
    assert asked(observation())["goal"].tolist() == pytest.approx([0.2, -0.1])
    assert asked.begin(observation(), 7e-3)["goal"].tolist() == pytest.approx([0.7])  # of the next episode
    assert "goal" not in encoder().begin(observation(), 7e-3)
    with pytest.raises(IncompatibleRig, match="the rig has no task"):
        asked.begin(observation())


def test_its_needs_are_those_of_what_it_sees() -> None:
    both = frozenset({"lower", "upper"})
    assert encoder().needs == Needs(both, both, height=True)
    assert encoder(maps=("image",), touch=("wrench",)).needs == Needs(both, both)
    assert encoder(maps=(), touch=("shear",)).needs == Needs(both, both, flow=True)


def test_what_a_sensor_does_not_deliver_is_told() -> None:
    with pytest.raises(IncompatibleRig, match="heights"):
        encoder().begin(observation(height=None))
    with pytest.raises(IncompatibleRig, match="slopes"):
        encoder(maps=("slope",)).begin(observation(gradient=None))
    with pytest.raises(IncompatibleRig, match="no markers"):
        encoder(flow=True).begin(observation(flow=None))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"maps": ("height", "height")}, "names something twice"),
        ({"maps": (), "touch": (), "goal": True}, "sees nothing"),
        ({"arms": ("upper",)}, "two arms"),
        ({"sensors": (), "touch": ("wrench",)}, "those of sensors"),
        ({"frames": 0}, "greater than or equal to 1"),
        ({"maps": ("colour",)}, "'height'"),
    ],
)
def test_features_that_make_no_sense_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Features(**wrong)
