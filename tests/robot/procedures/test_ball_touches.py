"""`tacsim calibrate touch`: from a file, and live with a mock arm whose sensor sits where only the test knows."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Callable
from contextlib import nullcontext
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibration.poses.records import read_touches, touch_file, write_record
from calibration.poses.robust_fit import BadMeasurements
from robot.errors import DeviceError
from robot.fixtures import mock_host
from robot.mock import MockCamera
from robot.procedures import ball_touches
from robot.procedures.ball_touches import BallTouchPlan, schedule, without_task
from robot.procedures.session import CannotCalibrate, Session
from tacsim import pose as se3
from tacsim.config import ConfigError, load_rig
from tacsim.control import NoTouch
from tacsim.interface import Pose
from tacsim.models.hardware import Placement
from tacsim.models.sensor import SensorModel
from tests.calibration.touches import BALL_RADIUS, made_touches, posed
from tests.robot.cli.invoked import plain_text, tacsim
from tests.robot.procedures.ball_on_post import BallOnPost

RIG = """
name: toucher
clock: wall
arms:
  upper:
    driver: ur
    host: {host}
    world_from_base: {{ position: [-450 mm, 0, -300 mm] }}
    tool_from_sensor: {{ position: [0, 0, 60 mm] }}
    limits:
      workspace: {{ lower: [-40 mm, -40 mm, -40 mm], upper: [40 mm, 40 mm, 40 mm] }}
      speed: 100 mm/s
      acceleration: 2 m/s^2
    start: {{ position: [0, 0, 0] }}
    link_timeout: 2 s
    watchdog: 0.4
    mock: {{}}
sensors:
  upper:
    {{ driver: camera, source: '{source}', arm: upper, width: 320, height: 240, fps: 60, max_age: 10 s, model: ideal }}
start: {{ approach_speed: 10 mm/s, approach_step: 20 um }}
"""


def test_schedule_spreads_tilts_and_positions_evenly() -> None:
    plan = BallTouchPlan(ball_radius=4e-3, touches=24, tilt=0.4, spread=3e-3)
    moves = schedule(plan)
    assert len(moves) == 24
    assert moves[0][0].magnitude() == 0.0 and not moves[0][1].any()
    tilts = np.array([turn.as_rotvec() for turn, _ in moves])
    places = np.array([place for _, place in moves])
    assert np.linalg.norm(tilts, axis=1).max() == pytest.approx(0.4)
    assert not tilts[:, 2].any()  # no turn about the gel's own axis: cables
    assert np.linalg.norm(places, axis=1).max() <= 3e-3
    for each in (tilts[:, :2], places):
        spreads = np.sqrt(np.linalg.eigvalsh(np.cov(each.T)))
        assert spreads[0] > 0.8 * spreads[1]
        assert (np.abs(each.mean(axis=0)) < 0.2 * spreads[1]).all()
    assert abs(np.corrcoef(np.linalg.norm(tilts, axis=1), np.linalg.norm(places, axis=1))[0, 1]) < 0.6


def test_touch_file_gives_rig_file_entries(tmp_path: Path) -> None:
    touches, sensor, ball = made_touches(np.random.default_rng(0))
    write_record(tmp_path / "touches.yaml", touch_file(touches, BALL_RADIUS))
    words = ["calibrate", "touch", str(tmp_path / "touches.yaml"), "--arm", "upper", "--out", str(tmp_path / "out")]
    done = tacsim(*words)
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "out" / "touch.json").read_text())
    lines = yaml.safe_load(done.stdout.partition("Write into the rig file:\n")[2].rpartition("\n" + str(tmp_path))[0])
    printed = Placement.model_validate(lines["arms"]["upper"]["tool_from_sensor"]).pose
    kept = report["tool_from_sensor"]
    exact = se3.from_rotation_vector(kept["position"], kept["rotation"])
    assert max(se3.pose_distance(printed, exact)) < 2e-6
    metres, radians = se3.pose_distance(exact, sensor)
    assert metres < 0.12e-3 and np.degrees(radians) < 1.2
    np.testing.assert_allclose(report["ball"], ball, atol=0.2e-3)
    assert np.array(report["tool_from_sensor"]["covariance"]).shape == (6, 6)
    assert np.array(report["residuals"]).shape == (24, 3) and all(report["used"])
    assert "at best, by Cramer and Rao" in done.stdout
    again = tacsim(*words)
    assert again.exit_code == 2  # nothing is overwritten


def test_touch_file_incomplete_is_refused(tmp_path: Path) -> None:
    """Cut anywhere, it is refused with the line: never fewer touches, never half a number."""
    touches, _, _ = made_touches(np.random.default_rng(0), 8)
    path = write_record(tmp_path / "touches.yaml", touch_file(touches, BALL_RADIUS))
    whole, text = read_touches(path), path.read_text()
    for back, wrote in zip(whole.measurements(), touches, strict=True):
        assert max(se3.pose_distance(back.tool, wrote.tool)) < 1e-12
        assert (back.contact, back.depth) == (wrote.contact, wrote.depth)
    assert len(text.splitlines()) == 3 + 8 and [each.name for each in tmp_path.iterdir()] == ["touches.yaml"]
    for end in (
        *range(0, len(text) - 1, 37),
        *(at for at, sign in enumerate(text[:-1]) if sign == "\n"),
        len(text) - 2,
    ):
        path.write_text(text[:end])
        with pytest.raises(ConfigError, match=rf"{path}:\d+: "):
            read_touches(path)
    path.write_text(text.replace("count: 8\n", ""))  # written by hand, without a count
    assert read_touches(path).touches == whole.touches


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            lambda text: text[: text.rindex("- {")],
            "touches.yaml:3: touches: holds 7 entries, `count` says 8: .* cut off",
        ),
        (lambda text: text[:-40], r"touches.yaml:\d+: not valid YAML"),
        (
            lambda text: text.replace("depth: 0.", "depth: -0.", 3),
            r"touches.yaml:6: touches.2.depth: .* is out of range",
        ),
        (
            lambda text: text.replace("contact: [", "contact: [.nan, ", 1),
            "touches.yaml:4: touches.0.contact.0: .nan is",
        ),
        (lambda text: "x,y,z\n1,2,3\n", "touches.yaml:1: .* does not fit; allowed: a mapping with keys among"),
        (
            lambda text: text.replace("touches:", "poses:"),
            "touches.yaml:3: poses: unknown key; .* did you mean|allowed",
        ),
        (lambda text: "", "touches.yaml:1: the file is empty"),
        (lambda text: "\0\1PNG", r"touches.yaml:\d+: "),
    ],
    ids=["cut between touches", "cut in a touch", "numbers", "not finite", "CSV", "another record", "empty", "binary"],
)
def test_touch_file_invalid_line_is_named(damage: Callable[[str], str], said: str, tmp_path: Path) -> None:
    touches, _, _ = made_touches(np.random.default_rng(0), 8)
    path = write_record(tmp_path / "touches.yaml", touch_file(touches, BALL_RADIUS))
    path.write_text(damage(path.read_text()))
    done = tacsim("calibrate", "touch", path, "--out", tmp_path / "out")
    assert done.exit_code == 2 and re.search(said, plain_text(done.stderr)), done.output
    assert not (tmp_path / "out").exists()


def test_command_invalid_input_exits_2_without_traceback(tmp_path: Path) -> None:
    touches, _, _ = made_touches(np.random.default_rng(0), 5)
    few = write_record(tmp_path / "few.yaml", touch_file(touches, BALL_RADIUS))
    (tmp_path / "odd.yaml").write_text("ball_radius: 4 mm\ntouches: [{tool: {}, contact: [1 mm, 2 mm], depht: 1 mm}]\n")
    for words, said in (
        ([str(few)], "5 touches are too few"),
        ([str(tmp_path / "odd.yaml")], "depht"),
        ([str(tmp_path / "none.yaml")], "none.yaml"),
        ([], "either a file of recorded poses, or --rig"),
        ([str(few), "--rig", "mock"], "either a file of recorded poses, or --rig"),
        (["--rig", "mock"], "--arm, --sensor and --ball-radius"),
        (["--rig", "sim", "--arm", "upper", "--sensor", "upper", "--ball-radius", "4 mm"], "is not a hardware arm"),
        (
            ["--rig", "mock", "--arm", "upper", "--sensor", "lower", "--ball-radius", "4 mm"],
            "carries no sensor 'lower'",
        ),
        (["--rig", "mock", "--arm", "upper", "--sensor", "upper", "--ball-radius", "4 m"], "allowed: 0.0005 to 0.05"),
    ):
        done = tacsim("calibrate", "touch", *words, "--out", tmp_path / "out")
        assert done.exit_code == 2, (words, done.output)
        assert said in plain_text(done.stderr), (words, done.output)
        assert not (tmp_path / "out").exists()


def test_without_task_gel_without_depth_raises() -> None:
    config = load_rig("ur5e").config
    bare = {
        name: sensor.model_copy(update={"model": None, "calibration": None}) for name, sensor in config.sensors.items()
    }
    with pytest.raises(CannotCalibrate, match="does not measure its depth"):
        without_task(config.model_copy(update={"sensors": bare}), "upper", "upper")


def test_command_real_arm_moves_only_after_confirmation(tmp_path: Path) -> None:
    words = ["calibrate", "touch", "--rig", "ur5e", "--arm", "upper", "--sensor", "upper", "--ball-radius", "4 mm"]
    calibrated = ["--set", "sensors.upper.model=ideal", "--set", "sensors.upper.corners=null"]
    done = tacsim(*words, *calibrated, "--out", tmp_path / "out")
    assert done.exit_code == 2
    assert "the operator did not confirm (at a terminal); nothing was moved" in done.stderr


@pytest.mark.parametrize(("left", "taken"), [(0.1e-3, True), (0.25e-3, False)])
def test_touch_reference_with_contact_raises(left: float, taken: bool) -> None:
    """A picture that came late, or what sticks to the gel, would shift the next contact by a twentieth of a mm."""
    here, references = [Pose()], []
    seen = SimpleNamespace(height=np.array([[0.0, left], [0.0, 9.0]]), valid=np.array([[True, True], [True, False]]))
    arm = SimpleNamespace(
        command=lambda target: here.append(target) or target,
        state=lambda: SimpleNamespace(pose=here[-1], twist=np.zeros(6)),
    )
    rig: Any = SimpleNamespace(
        arms={"upper": arm},
        sensors={"gel": SimpleNamespace(read=lambda timeout: SimpleNamespace(time=np.inf))},
        normalisers={"gel": SimpleNamespace(take_reference=references.append)},
        frames={"gel": "the picture"},
        observe=lambda: SimpleNamespace(tactile={"gel": seen}),
    )
    plan = BallTouchPlan(ball_radius=BALL_RADIUS, depth=0.4e-3, step=0.1e-3)
    prober = ball_touches._BallProber(rig, load_rig("ur5e").config, "upper", "gel", plan)
    with pytest.raises(NoTouch if taken else BadMeasurements, match="no touch" if taken else "pressed by 0.25 mm"):
        prober.touch(Pose(), Pose(), 0.2e-3)
    assert references == (["the picture"] if taken else [])


@pytest.mark.deep
@pytest.mark.skipif(find_spec("rtde_control") is None, reason="ur_rtde has no wheel for this Python and machine")
def test_ball_touches_mock_arm_finds_sensor_pose(tmp_path: Path) -> None:
    """And again without the arm, from what was kept."""
    host = mock_host(41)
    nominal = Pose(np.array([0.0, 0.0, 60e-3]))
    true = posed(Rotation.from_rotvec(np.radians([2.0, -3.0, 4.0])), [0.8e-3, -1.1e-3, 60.9e-3])
    ball_radius = 4e-3
    # the rig's start: the nominal sensor at the world's origin; the ball 1.5 mm before it, and 0.5 mm aside
    base_from_ball = np.array([0.45 + 0.5e-3, -0.3e-3, 0.3 + 1.5e-3 + ball_radius])
    with MockCamera(host, width=320, height=240, fps=60.0, quality=100, stamped=False) as camera:
        (tmp_path / "toucher.yaml").write_text(RIG.format(host=host, source=camera.url))
        words = ["calibrate", "touch", "--rig", str(tmp_path / "toucher.yaml"), "--arm", "upper", "--sensor", "upper"]
        words += ["--ball-radius", "4 mm", "--touches", "7", "--tilt", "22 deg", "--out", str(tmp_path / "out")]
        with BallOnPost(host, camera, SensorModel(), true, base_from_ball, ball_radius) as post:
            done = tacsim(*words)
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "out" / "touch.json").read_text())
    found = report["tool_from_sensor"]
    off = se3.relative_pose(true, se3.from_rotation_vector(found["position"], found["rotation"]))
    was = se3.relative_pose(true, nominal)
    assert np.linalg.norm(was.position) > 1.5e-3
    np.testing.assert_allclose(off.position[:2], 0.0, atol=0.1e-3)
    assert abs(off.position[2]) < 0.15e-3  # the depth's own bias goes wholly along z
    assert np.degrees(se3.pose_distance(Pose(), off)[1]) < 0.8 < 5.0 < np.degrees(se3.pose_distance(true, nominal)[1])
    kept = tmp_path / "out" / "touches.yaml"
    assert len(read_touches(kept).touches) == len(report["used"]) >= 6
    assert f"without the arm: tacsim calibrate touch {kept}" in plain_text(done.stderr)
    words = ["calibrate", "touch", str(kept), "--out", str(tmp_path / "again")]
    again = tacsim(*words)
    assert again.exit_code == 0, again.output
    redone = json.loads((tmp_path / "again" / "touch.json").read_text())["tool_from_sensor"]
    np.testing.assert_allclose(redone["position"], found["position"], atol=1e-9)
    np.testing.assert_allclose(redone["rotation"], found["rotation"], atol=1e-9)
    assert post.deepest < 1.2e-3  # no touch went far beyond the requested 0.4 mm


@pytest.mark.parametrize("ends", ["stopped", "fails"])
def test_ball_touches_interrupted_keep_measurements(ends: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The arm and its touches are made up; keeping and the end are the command's own."""
    touches, _, _ = made_touches(np.random.default_rng(0), 5)

    def some(*given: Any) -> None:
        session: Session[Any] = given[-1]
        for count in range(1, 6):
            session.check()
            session.add_measurement(touches[count - 1])
            assert len(read_touches(tmp_path / "out" / "touches.yaml").touches) == count  # each at once
        if ends == "fails":
            raise DeviceError("most touches failed")
        os.kill(os.getpid(), signal.SIGINT)
        assert session.stop()

    monkeypatch.setattr("robot.procedures.ball_touches.record_ball_touches", some)
    monkeypatch.setattr("robot.open.open_rig", lambda *_, **__: nullcontext())
    words = ["calibrate", "touch", "--rig", "mock", "--arm", "upper", "--sensor", "upper", "--ball-radius", "4 mm"]
    done = tacsim(*words, "--out", tmp_path / "out")
    assert done.exit_code == (130 if ends == "stopped" else 1), done.output
    said = plain_text(done.stderr)
    assert f"recorded: {tmp_path / 'out' / 'touches.yaml'}; to calibrate from it again" in said
    assert ("5 touches are kept, nothing is calibrated" if ends == "stopped" else "most touches failed") in said
    assert len(read_touches(tmp_path / "out" / "touches.yaml").touches) == 5
