"""The doctor finds what is wrong with the machine and the rig: checked on broken surroundings that the tests make, and
on a mock rig."""

from __future__ import annotations

import json
import time
import tomllib
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest
from packaging.requirements import Requirement

import robot.arm.examine
import robot.camera.driver
import robot.mock.cell.cell
from robot import doctor
from robot.doctor import examine_rig
from robot.fixtures import mock_host
from robot.mock import FaultClient, MockCamera, MockUR
from robot.mock.cell.cell import MockCell
from tacsim.config import load_rig
from tacsim.models.driver import Check
from tacsim.models.rig import RigConfig
from tests.robot.cli.invoked import tacsim

ROOT = Path(__file__).resolve().parents[2]


def test_this_machine_is_fit_and_the_answer_is_json() -> None:
    report = json.loads(json.dumps(doctor.as_json(doctor.examine_machine())))
    failed = [check for check in report["checks"] if check["state"] == "fail"]
    assert report["ok"], failed
    names = [check["name"] for check in report["checks"]]
    for name in ("python", "one cv2", "cv2.calibrateHandEye", "taichi", "kernel cache", "processors"):
        assert name in names


def test_wrong_python_fails_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "PYTHONS", ((3, 90), (3, 91)))
    (check,) = doctor.python()
    assert check.state == "fail"
    assert "3.90" in check.advice


def test_packages_are_held_against_their_pins(monkeypatch: pytest.MonkeyPatch) -> None:
    pins = [
        "numpy>=2.0",
        "scipy<0.1",
        "no-such-package-here>=1",
        "rich; python_version < '3'",
        "pytest; extra == 'dev'",
    ]
    monkeypatch.setattr(metadata, "requires", lambda name: pins)
    found = {check.name: check for check in doctor.packages()}
    assert set(found) == {"package numpy", "package scipy", "package no-such-package-here"}  # markers are obeyed
    assert found["package numpy"].state == "ok"
    assert found["package scipy"].state == "fail"
    assert "scipy<0.1" in found["package scipy"].advice
    assert found["package no-such-package-here"].found == "not installed"


def test_an_unknown_distribution_is_a_warning() -> None:
    (check,) = doctor.packages("no-such-package-here")
    assert check.state == "warn"


@pytest.mark.parametrize(
    ("other", "version", "state", "words"),
    [
        ("opencv-python", "4.9.0", "fail", "opencv-python 4.9.0 in addition to"),
        ("OpenCV_Python_Headless", "4.9.0", "fail", "opencv-python-headless 4.9.0 in addition to"),
        ("opencv-python-headless", "4.13.0.92", "ok", "the same version"),
        ("no-opencv", "4.9.0", "ok", "no other opencv package"),
    ],
)
def test_a_second_opencv_is_harmful_unless_of_the_same_version(
    monkeypatch: pytest.MonkeyPatch, other: str, version: str, state: str, words: str
) -> None:
    installed = [
        SimpleNamespace(name=doctor.OPENCV, version="4.13.0.92"),
        SimpleNamespace(name=other, version=version),
    ]
    monkeypatch.setattr(metadata, "distributions", lambda: installed)
    (check,) = doctor.second_opencv()
    assert check.state == state and words in check.found
    assert (f"{doctor.OPENCV}==4.13.0.92" in check.advice) == (state == "fail")


def test_robot_framework_beside_tacsim_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.robot_framework()[0].state == "ok"
    monkeypatch.setattr(metadata, "version", lambda name: {"robotframework": "7.3"}[name])
    (check,) = doctor.robot_framework()
    assert (
        check.state == "fail" and "robotframework 7.3" in check.found and "uninstall -y robotframework" in check.advice
    )


def test_opencv_is_asked_for_as_lerobot_does_everywhere_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside LeRobot 0.6, which asks for opencv-python-headless below 4.14, both builds can only be of one version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (ours,) = (need for need in map(Requirement, project["dependencies"]) if need.name == doctor.OPENCV)
    assert ours.specifier.contains("4.13.0.92") and not ours.specifier.contains("4.14.0.0")
    for path in sorted((ROOT / "constraints").glob("py*.txt")):
        (pin,) = (line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith(doctor.OPENCV))
        assert ours.specifier.contains(pin.partition("==")[2]), path.name
    import cv2

    monkeypatch.delattr(cv2, "calibrateHandEye")
    assert Requirement(doctor.opencv()[0].advice.split("'")[1]) == ours


def test_opencv_without_hand_eye_calibration_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    monkeypatch.delattr(cv2, "calibrateHandEye")
    assert doctor.opencv()[0].state == "fail"


def test_kernel_cache_is_measured_and_must_be_a_folder(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "kernel").write_bytes(b"x" * 2_000_000)
    check = doctor.kernel_cache(tmp_path / "cache")
    assert (check.state, "2.0 MB" in check.found) == ("ok", True)
    assert doctor.kernel_cache(tmp_path / "not" / "yet").state == "ok"
    (tmp_path / "file").touch()
    assert doctor.kernel_cache(tmp_path / "file" / "cache").state == "warn"


def test_a_working_directory_that_is_not_writable_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert doctor.working_directory()[0].state == "ok"
    monkeypatch.setattr(doctor.Path, "cwd", lambda: Path("/proc/self"))  # nobody, root included, can write there
    assert doctor.working_directory()[0].state == "fail"


def test_missing_ur_driver_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named '{name}'")

    monkeypatch.setattr(doctor.importlib, "import_module", missing)
    assert doctor.ur_rtde()[0].state == "warn"


def test_a_check_that_breaks_is_a_failure_not_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> list[doctor.Check]:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(doctor, "opencv", broken)
    report = doctor.as_json(doctor.examine_machine())
    assert not report["ok"]
    assert any("libGL" in check["found"] for check in report["checks"])


RIG = """
name: looked at
clock: wall
arms:
  left:
    driver: ur
    host: HOST
    world_from_base: { position: [-450 mm, 0, -300 mm] }
    limits: { workspace: { lower: [-30 mm, -30 mm, -30 mm], upper: [30 mm, 30 mm, 60 mm] } }
    start: { position: [0, 0, 0] }
    mock: {}
sensors:
  finger: { driver: camera, source: 'SOURCE', arm: left, width: 80, height: 60, stamped: true }
"""
REAL = ("arms.left.mock=null", f"arms.left.host={mock_host(72)}")


@pytest.fixture(scope="module")
def camera() -> Iterator[MockCamera]:
    with MockCamera(mock_host(71), width=80, height=60) as running:
        yield running


@pytest.fixture
def file(camera: MockCamera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(robot.arm.examine, "TIMEOUT", 1.0)
    monkeypatch.setattr(robot.camera.driver, "CHECK_TIMEOUT", 2.0)
    monkeypatch.setattr(robot.camera.driver, "CHECK_TIME", 0.3)
    path = tmp_path / "looked.yaml"
    path.write_text(RIG.replace("HOST", mock_host(71)).replace("SOURCE", camera.url))
    return path


def looked(
    monkeypatch: pytest.MonkeyPatch,
    file: Path,
    *overrides: str,
    fault: Callable[[FaultClient], object] = lambda faults: None,
    **started: object,
) -> dict[str, Check]:
    """The checks by name, after `fault` was done to the controller; it was started with other facts if `started`."""
    commanded = []

    class Faulty(MockCell):
        def __init__(self, config: RigConfig) -> None:
            arms = {name: arm.model_copy(update=started) for name, arm in config.arms.items()}
            super().__init__(config.model_copy(update={"arms": arms}))
            for faults in self.faults.values():
                fault(faults)

        def close(self) -> None:
            commanded.extend(entry for faults in self.faults.values() for entry in faults.received().entries)
            super().close()

    monkeypatch.setattr(robot.mock.cell.cell, "MockCell", Faulty)
    checks = examine_rig(load_rig(file, overrides=overrides).config)
    assert commanded == []  # it only looks
    return {check.name: check for check in checks}


def unpowered(faults: FaultClient) -> None:
    """After an emergency stop that a person has released already."""
    faults.estop()
    deadline = time.monotonic() + 60.0
    while faults.state().mode == "RUNNING":
        assert time.monotonic() < deadline
        time.sleep(0.01)
    faults.release()


def bad(checks: dict[str, Check]) -> dict[str, str]:
    return {name: check.state for name, check in checks.items() if check.state != "ok"}


def test_a_sound_rig_passes_every_check(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    checks = looked(monkeypatch, file)
    kinds = {"network", "PolyScope", "model", "ready", "RTDE", "limits", "start"}
    kinds |= {"pose", "workspace", "path to start", "force", "payload", "TCP", "speed slider"}
    assert set(checks) == {f"left: {kind}" for kind in kinds} | {"finger: camera"}
    camera = checks.pop("finger: camera")
    assert bad(checks) == {}
    assert camera.state in ("ok", "warn") and "80 x 60 px" in camera.found  # how fast it is depends on the machine
    assert "60 x 60 x 90 mm" in checks["left: limits"].found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "check", "words"),
    [
        (FaultClient.protective_stop, "ready", "protective stop"),
        (FaultClient.estop, "ready", "emergency stop; a person must release it"),
        (lambda faults: faults.remote_control(False), "ready", "switch it to remote control"),
        (unpowered, "ready", "power it on"),
        (FaultClient.dashboard_mute, "dashboard", "does not answer"),
        (FaultClient.refuse, "network", "no answer at 29999 (dashboard), 30003 (script), 30004 (RTDE)"),
        (FaultClient.black_hole, "dashboard", "does not answer"),
    ],
)
def test_what_is_wrong_with_a_controller_is_named(
    monkeypatch: pytest.MonkeyPatch, file: Path, fault: Callable[[FaultClient], object], check: str, words: str
) -> None:
    found = looked(monkeypatch, file, fault=fault)
    one = found[f"left: {check}"]
    assert one.state == "fail" and one.advice
    assert words in one.found, one


def test_an_old_controller_is_a_warning(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    found = looked(monkeypatch, file, fault=lambda faults: faults.version(5, 4, 3, 1))
    assert found["left: PolyScope"].state == "warn" and "5.6" in found["left: PolyScope"].advice


def test_another_model_than_the_file_says_is_found(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    found = looked(monkeypatch, file, model="ur3e")
    assert found["left: model"].state == "fail"
    assert "UR3" in found["left: model"].found and "ur5e" in found["left: model"].advice


def test_a_controller_that_is_not_there_is_found(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    found = looked(monkeypatch, file, *REAL)
    assert found["left: network"].state == "fail"
    assert "is the controller on" in found["left: network"].advice
    assert "finger: camera" in found  # the rest is looked at nevertheless


def test_a_mock_is_not_taken_for_a_robot(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    with MockUR(mock_host(72)):
        found = looked(monkeypatch, file, *REAL)
    assert found["left: kind"].state == "fail" and found["left: kind"].found == "a mock"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "check", "words"),
    [
        ("sensors.finger.width=100", "finger: camera", "expected 100 x"),
        ("sensors.finger.source=http://127.0.0.1:1/?action=stream", "finger: camera", "no picture"),
        ("arms.left.start.position=[0, 0, 70 mm]", "left: start", "outside the workspace"),
        ("arms.left.world_from_base.position=[-2, 0, 0]", "left: start", "out of reach"),
    ],
)
def test_what_the_file_has_wrong_is_named(
    monkeypatch: pytest.MonkeyPatch, file: Path, override: str, check: str, words: str
) -> None:
    found = looked(monkeypatch, file, "arms.left.mock.joints=[0, -1.5, 1.5, -1.5, -1.5, 0]", override)
    assert found[check].state == "fail" and words in found[check].found and found[check].advice


def test_a_camera_slower_than_asked_for_is_a_warning(monkeypatch: pytest.MonkeyPatch, file: Path) -> None:
    found = looked(monkeypatch, file, "sensors.finger.fps=500")
    assert found["finger: camera"].state == "warn" and "500 frames/s were asked for" in found["finger: camera"].advice


def test_a_frozen_camera_fails(monkeypatch: pytest.MonkeyPatch, file: Path, camera: MockCamera) -> None:
    camera.freeze(True)
    try:
        found = looked(monkeypatch, file)["finger: camera"]
    finally:
        camera.freeze(False)
    assert found.state == "fail" and "shown the same picture for" in found.advice and "shown again" in found.found


def test_addresses_that_are_taken_are_a_failed_check_not_a_crash(file: Path) -> None:
    with MockUR(mock_host(71)):
        (check,) = examine_rig(load_rig(file).config)
    assert check.state == "fail" and "in use" in check.found


def test_a_rig_without_hardware_has_nothing_to_check() -> None:
    (check,) = examine_rig(load_rig("sim").config)
    assert check.state == "ok" and "no hardware" in check.found


@pytest.mark.slow
def test_the_command_ends_with_1_if_something_must_be_mended(file: Path) -> None:
    for overrides, code in (((), 0), (("--set", "sensors.finger.width=100"), 1)):
        done = tacsim("doctor", "--rig", file, *overrides)
        assert done.exit_code == code, done.output
    assert "expected 100 x" in done.output
