"""A rig of hardware before the simulated cell: loads, touch, truth."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from robot.fixtures import rig_addresses
from tacsim.control import NoTouch
from tacsim.interface import Action, Pose
from tests.robot.rig.bare_rig import Opened, failing, opened
from tests.robot.waiting import until

pytestmark = pytest.mark.usefixtures("no_pause")
SMALL = [f"canonical.{key}={value}" for key, value in (("rows", 32), ("columns", 32), ("pitch", "0.5 mm"))]
for _name in ("lower", "upper"):
    SMALL += [f"sensors.{_name}.{key}={value}" for key, value in (("width", 80), ("height", 60), ("max_age", "20 s"))]
    SMALL += [
        f"sensors.{_name}.model.geometry.{key}={value}"
        for key, value in (("width", 80), ("height", 60), ("pixel_pitch", "0.1 mm"))
    ]
TINY = ["scene.body.geometry.size=[4 mm, 4 mm, 4 mm]", "scene.gel.size=[8 mm, 8 mm, 2 mm]"]


@pytest.fixture(scope="module")
def loaded() -> Iterator[Opened]:
    """A task whose upper arm holds a load."""
    reposition = ["task=reposition", "task.touch_force=0.3 N", "task.loads={upper: 0.6 N}"]
    with opened("mock", *SMALL, *TINY, *reposition, *rig_addresses(), "start.approach_step=0.2 mm") as found:
        yield found


@pytest.fixture
def simulated(loaded: Opened, monkeypatch: pytest.MonkeyPatch) -> Opened:
    """The same rig without the load."""
    monkeypatch.setattr(loaded.rig, "_load_control", None)
    return loaded


@pytest.mark.slow
def test_mock_rig_arms_hold_task_loads(loaded: Opened) -> None:
    start = loaded.rig.reset().arms["upper"].pose
    for count in range(1, 7):
        asked = Pose(start.position + [count * 0.05e-3, 0.0, 0.0], start.quaternion)
        observation, _ = loaded.rig.step(Action({"upper": asked}))
    arm = observation.arms["upper"]
    assert -arm.wrench[2] == pytest.approx(0.6, rel=0.05)
    assert arm.pose.position[0] - start.position[0] == pytest.approx(0.3e-3, abs=10e-6)


@pytest.mark.slow
def test_mock_rig_reset_ends_in_touch_with_truth(simulated: Opened) -> None:
    rig = simulated.rig
    observation = rig.reset()
    forces = [-arm.wrench[2] for arm in observation.arms.values()]
    assert min(forces) > 0.3  # task.touch_force [N]
    assert max(forces) < 10.0
    assert all(touch.height is not None for touch in observation.tactile.values())
    before = rig.truth()
    arms = observation.arms
    closer = Action(
        {name: Pose(arm.pose.position + [0, 0, 0.1e-3 * sign], arm.pose.quaternion)
         for (name, arm), sign in zip(arms.items(), (1, -1), strict=True)}
    )  # fmt: skip
    observation, sent = rig.step(closer)
    after = rig.truth()
    assert before is not None and after is not None and after.height < before.height
    for name, pose in sent.items():
        assert pose is not None
        assert observation.arms[name].pose.position == pytest.approx(pose.position, abs=5e-6)


@pytest.mark.slow
def test_mock_rig_approach_without_touch_returns_to_start(simulated: Opened) -> None:
    reset = simulated.rig._reset
    config = reset._config  # type: ignore[attr-defined]
    reset._config = config.model_copy(update={"approach_distance": 0.1e-3})  # type: ignore[attr-defined]
    try:
        with pytest.raises(NoTouch, match=r"no touch after an approach of 0\.\d mm.*back at their start"):
            simulated.rig.reset()
    finally:
        reset._config = config  # type: ignore[attr-defined]
    for name, pose in simulated.cell.start_poses.items():
        assert simulated.rig.arms[name].state().pose.position == pytest.approx(pose.position, abs=50e-6)


@pytest.mark.deep
def test_killed_simulator_ends_episode(simulated: Opened) -> None:
    """The last test of this rig."""
    sim_server = simulated.cell._sim_server
    assert sim_server is not None
    failed = failing(simulated.rig, lambda: os.kill(sim_server.pid, signal.SIGKILL))
    assert "simulated cell" in str(failed) and "open the rig again" in str(failed)
    assert len(failed.episode.steps) >= 3
    until(lambda: all(faults.state().rests for faults in simulated.cell.faults.values()), "rest")
