"""The doctor finds what is wrong: checked on broken surroundings that the tests make."""

from __future__ import annotations

import json
import tomllib
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pytest
from packaging.requirements import Requirement

from robot.doctor import machine

ROOT = Path(__file__).resolve().parents[3]


def test_this_machine_is_fit_and_the_answer_is_json() -> None:
    report = json.loads(json.dumps(machine.as_json(machine.examine())))
    failed = [check for check in report["checks"] if check["state"] == "fail"]
    assert report["ok"], failed
    names = [check["name"] for check in report["checks"]]
    for name in ("python", "one cv2", "cv2.calibrateHandEye", "taichi", "kernel cache", "processors"):
        assert name in names


def test_wrong_python_fails_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "PYTHONS", ((3, 90), (3, 91)))
    (check,) = machine.python()
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
    found = {check.name: check for check in machine.packages()}
    assert set(found) == {"package numpy", "package scipy", "package no-such-package-here"}  # markers are obeyed
    assert found["package numpy"].state == "ok"
    assert found["package scipy"].state == "fail"
    assert "scipy<0.1" in found["package scipy"].advice
    assert found["package no-such-package-here"].found == "not installed"


def test_an_unknown_distribution_is_a_warning() -> None:
    (check,) = machine.packages("no-such-package-here")
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
        SimpleNamespace(name=machine.OPENCV, version="4.13.0.92"),
        SimpleNamespace(name=other, version=version),
    ]
    monkeypatch.setattr(metadata, "distributions", lambda: installed)
    (check,) = machine.second_opencv()
    assert check.state == state and words in check.found
    assert (f"{machine.OPENCV}==4.13.0.92" in check.advice) == (state == "fail")


def test_robot_framework_beside_tacsim_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine.robot_framework()[0].state == "ok"
    monkeypatch.setattr(metadata, "version", lambda name: {"robotframework": "7.3"}[name])
    (check,) = machine.robot_framework()
    assert (
        check.state == "fail" and "robotframework 7.3" in check.found and "uninstall -y robotframework" in check.advice
    )


def test_opencv_is_asked_for_as_lerobot_does_everywhere_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside LeRobot 0.6, which asks for opencv-python-headless below 4.14, both builds can only be of one version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (ours,) = (need for need in map(Requirement, project["dependencies"]) if need.name == machine.OPENCV)
    assert ours.specifier.contains("4.13.0.92") and not ours.specifier.contains("4.14.0.0")
    for path in sorted((ROOT / "constraints").glob("py*.txt")):
        (pin,) = (line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith(machine.OPENCV))
        assert ours.specifier.contains(pin.partition("==")[2]), path.name
    import cv2

    monkeypatch.delattr(cv2, "calibrateHandEye")
    assert Requirement(machine.opencv()[0].advice.split("'")[1]) == ours


def test_opencv_without_hand_eye_calibration_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    monkeypatch.delattr(cv2, "calibrateHandEye")
    assert machine.opencv()[0].state == "fail"


def test_kernel_cache_is_measured_and_must_be_a_folder(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "kernel").write_bytes(b"x" * 2_000_000)
    check = machine.kernel_cache(tmp_path / "cache")
    assert (check.state, "2.0 MB" in check.found) == ("ok", True)
    assert machine.kernel_cache(tmp_path / "not" / "yet").state == "ok"
    (tmp_path / "file").touch()
    assert machine.kernel_cache(tmp_path / "file" / "cache").state == "warn"


def test_a_working_directory_that_is_not_writable_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert machine.working_directory()[0].state == "ok"
    monkeypatch.setattr(machine.Path, "cwd", lambda: Path("/proc/self"))  # nobody, root included, can write there
    assert machine.working_directory()[0].state == "fail"


def test_missing_ur_driver_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named '{name}'")

    monkeypatch.setattr(machine.importlib, "import_module", missing)
    assert machine.ur_rtde()[0].state == "warn"


def test_a_check_that_breaks_is_a_failure_not_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> list[machine.Check]:
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(machine, "opencv", broken)
    report = machine.as_json(machine.examine())
    assert not report["ok"]
    assert any("libGL" in check["found"] for check in report["checks"])
