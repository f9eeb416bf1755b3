"""`tacsim calibrate hand-eye`: from a file, and live with a mock arm whose camera sits where only the test knows."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibration.poses.records import board_pose_file, write_record
from robot.fixtures import mock_host
from robot.mock import MockCamera, MockState
from robot.procedures.boards import BoardPosePlan, record_board_poses, schedule
from robot.procedures.session import CannotCalibrate, Session
from tacsim import pose as se3
from tacsim.interface import Pose
from tests.calibration.boards import CHARUCO, LENS, facing, photograph
from tests.calibration.poses.test_hand_eye import CAMERA, made_sights
from tests.calibration.touches import posed
from tests.robot.cli.invoked import plain_text, tacsim
from tests.robot.procedures.seen_arm import SeenArm

RIG = """
name: looker
clock: wall
arms:
  upper:
    driver: ur
    host: {host}
    world_from_base: {{ position: [-450 mm, 0, -300 mm] }}
    tool_from_sensor: {{ position: [0, 0, 60 mm] }}
    limits:
      workspace: {{ lower: [-60 mm, -60 mm, -60 mm], upper: [60 mm, 60 mm, 60 mm] }}
      speed: 200 mm/s
      turn_rate: 1.5
      acceleration: 2 m/s^2
    start: {{ position: [0, 0, 0] }}
    link_timeout: 2 s
    watchdog: 0.4
    mock: {{}}
sensors:
  upper: {{ driver: camera, source: '/dev/nothing', arm: upper }}
"""


def run(*words: object) -> tuple[int, str, str]:
    done = tacsim("calibrate", "hand-eye", *words)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.stdout, plain_text(done.stderr)


@pytest.mark.parametrize("fixed", [False, True])
def test_board_pose_file_gives_camera_pose(fixed: bool, tmp_path: Path) -> None:
    board_poses = made_sights(np.random.default_rng(0), fixed=fixed)
    path = write_record(tmp_path / "poses.yaml", board_pose_file(board_poses, fixed=fixed))
    code, said, err = run(path, "--out", tmp_path / "out")
    assert code == 0, err
    name = "base_from_camera" if fixed else "flange_from_camera"
    assert f"{name}: {{ position: [" in said and "scatter" in said
    report = json.loads((tmp_path / "out" / "hand-eye.json").read_text())
    found = se3.from_rotation_vector(report[name]["position"], report[name]["rotation"])
    metres, radians = se3.pose_distance(found, CAMERA)
    assert metres < 1e-3 and np.degrees(radians) < 0.15
    assert np.array(report["residuals"]).shape == (30, 2) and all(report["used"])


def test_command_invalid_input_exits_2(tmp_path: Path) -> None:
    alike = write_record(
        tmp_path / "alike.yaml", board_pose_file(made_sights(np.random.default_rng(0), 9, 3.0), fixed=False)
    )
    (tmp_path / "lens.yaml").write_text(yaml.safe_dump(LENS.model_dump(mode="json")))
    live = ["--rig", "mock", "--arm", "upper", "--camera", "nowhere", "--lens", tmp_path / "lens.yaml"]
    for words, said in (
        ([alike], "turns too little"),
        ([tmp_path / "none.yaml"], "none.yaml"),
        ([], "either a file of recorded poses, or --rig"),
        (["--rig", "mock"], "--arm, --camera, --lens and --board"),
        ([*live, "--board", "dots:9x7:2 mm"], "use a ChArUco board"),
        ([*live, "--board", "charuco:9x7:2 mm"], "is no board"),
        (["--rig", "sim", *live[2:], "--board", "charuco:9x7:3 mm:2.2 mm"], "is not a hardware arm"),
        (["--rig", "ur5e", *live[2:], "--board", "charuco:9x7:3 mm:2.2 mm"], "the operator did not confirm"),
    ):
        code, out, err = run(*words, "--out", tmp_path / "out")
        assert code == 2 and said in err, (words, code, out, err)
        assert not (tmp_path / "out").exists()


class Eye(SeenArm):
    """Draws what a camera on the flange sees of a board that stands fixed; no picture comes while the arm moves."""

    def __init__(self, host: str, camera: MockCamera, flange_from_camera: Pose, base_from_board: Pose) -> None:
        super().__init__(host, camera)
        self._mount, self._board = flange_from_camera, base_from_board
        self._shown: Pose | None = None
        camera.stall(True)  # nothing is seen before the arm is there

    def draw(self, state: MockState) -> None:
        flange = posed(Rotation.from_rotvec(state.pose[3:]), state.pose[:3])  # the TCP, which the rig file leaves there
        if not state.rests:
            self._camera.stall(True)
            self._shown = None
        elif self._shown is None:
            seen = se3.relative_pose(se3.compose(flange, self._mount), self._board)
            self._camera.push(photograph(CHARUCO, seen))
            self._camera.stall(False)
            self._shown = flange


@pytest.mark.deep
@pytest.mark.skipif(find_spec("rtde_control") is None, reason="ur_rtde has no wheel for this Python and machine")
def test_board_poses_mock_arm_finds_camera_pose(tmp_path: Path) -> None:
    host = mock_host(51)
    true = posed(Rotation.from_rotvec(np.radians([3.0, -2.0, 30.0])), [8e-3, -5e-3, 20e-3])
    flange = Pose(np.array([0.45, 0.0, 0.3 - 60e-3]))  # at the start, in the base
    board = se3.compose(se3.compose(flange, true), facing(CHARUCO, [0.1, 0.05, 0.2], 0.045))
    (tmp_path / "lens.yaml").write_text(yaml.safe_dump(LENS.model_dump(mode="json")))
    with MockCamera(host, width=LENS.width, height=LENS.height, fps=30.0, stamped=False) as camera:
        (tmp_path / "looker.yaml").write_text(RIG.format(host=host))
        words = ["--rig", tmp_path / "looker.yaml", "--arm", "upper", "--camera", camera.url]
        words += ["--lens", tmp_path / "lens.yaml", "--board", "charuco:9x7:3 mm:2.2 mm", "--poses", "10"]
        words += ["--tilt", "30 deg", "--pivot", "5 mm", "--noise-board", "0.1 mm", "--noise-turn", "0.2 deg"]
        with Eye(host, camera, true, board):
            code, _, err = run(*words, "--out", tmp_path / "out")
    assert code == 0, err
    report = json.loads((tmp_path / "out" / "hand-eye.json").read_text())
    found = report["flange_from_camera"]
    metres, radians = se3.pose_distance(true, se3.from_rotation_vector(found["position"], found["rotation"]))
    assert metres < 0.4e-3 and np.degrees(radians) < 0.4
    assert sum(report["used"]) >= 7
    assert len(yaml.safe_load((tmp_path / "out" / "poses.yaml").read_text())["poses"]) == len(report["used"])


def test_board_poses_small_tilts_raise_before_motion() -> None:
    plan = BoardPosePlan(CHARUCO, LENS, poses=12, tilt=np.radians(15.0))
    with pytest.raises(CannotCalibrate, match=r"with a tilt of 15 degrees and 12 poses .* give a larger --tilt"):
        record_board_poses(None, None, plan, Session())  # type: ignore[arg-type]
    turns = schedule(BoardPosePlan(CHARUCO, LENS, poses=20, tilt=np.radians(30.0)))
    assert turns[0].magnitude() == 0.0 and len(turns) == 20
    vectors = np.degrees([turn.as_rotvec() for turn in turns])
    assert np.abs(vectors).max() <= 30.0 + 1e-9
    assert (vectors.std(axis=0) > 12.0).all()
