"""`tacsim start`: from arms that stand anywhere to a dry run, as a person at a terminal goes."""

from __future__ import annotations

import signal
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from robot.procedures.to_start import Operator, move_to_start
from tacsim import pose as se3
from tests.robot.cli.invoked import tacsim
from tests.robot.cli.lab import Lab, copy_of
from tests.robot.cli.terminal import Terminal
from tests.robot.waiting import until

if find_spec("rtde_control") is None:
    pytest.skip("ur_rtde has no wheel for this Python and machine", allow_module_level=True)

pytestmark = pytest.mark.usefixtures("empty_folder")
AWAY = (40e-3, -30e-3, -50e-3)  # of the start, sensor axes: far outside the box of the shipped file [m]
OFFSET = 24.0  # what the force sensor is off by [N]


def fast(file: Path) -> Path:
    """100 mm/s: the joints' own speed bounds the way."""
    text = file.read_text(encoding="utf-8").replace("speed: 20 mm/s", "speed: 100 mm/s")
    file.write_text(text.replace("approach_speed: 100 mm/s", "approach_speed: 2 mm/s"), encoding="utf-8")
    return file


@pytest.mark.deep
def test_start_moves_arms_to_start_then_dry_run(tmp_path: Path) -> None:
    file = fast(copy_of("ur5e-one", tmp_path, 66))
    with Lab(file, offset=AWAY) as lab:
        lab.faults["arm"].wrench([0.0, OFFSET, 0.0, 0.0, 0.0, 0.0])
        refused = tacsim("run", str(file), "--dry-run", "--steps", "2", "--out", "dry")
        assert refused.exit_code == 1, refused.output
        assert "`tacsim start FILE`" in " ".join(refused.stderr.split())
        here = lab.faults["arm"].state().joints
        with Terminal("start", str(file), folder=tmp_path, lines=80) as terminal:
            terminal.wait_for("outside:")
            for question in ("Connect", "zero it now?", "of this path (Ctrl-C brakes it)?"):
                terminal.wait_for(question)
                assert np.allclose(lab.faults["arm"].state().joints, here, atol=1e-6)
                terminal.type("y\n")
            terminal.wait_for("Then continue to its start")
            terminal.type("y\n")
            terminal.wait_for("Next: tacsim run")
            assert terminal.end() == 0, terminal.picture
        assert lab.faults["arm"].state().rests
        start = lab.config.arms["arm"].start  # type: ignore[union-attr]
        pose = np.array(lab.faults["arm"].state().pose)  # base and world are one, and the TCP is the sensor
        assert start is not None and np.linalg.norm(pose[:3] - start.position) < 1e-3
        assert se3.pose_distance(start.pose, se3.from_rotation_vector(pose[:3], pose[3:]))[1] < 5e-3
        done = tacsim("run", str(file), "--dry-run", "--steps", "2", "--out", "dry")
        assert done.exit_code == 0, done.output


@pytest.mark.deep
def test_start_ctrl_c_brakes_arm_and_no_moves_nothing(tmp_path: Path) -> None:
    file = fast(copy_of("ur5e-one", tmp_path, 66))
    with Lab(file, offset=AWAY) as lab:
        faults, here = lab.faults["arm"], lab.faults["arm"].state().joints
        with Terminal("start", str(file), folder=tmp_path, lines=80) as terminal:
            terminal.wait_for("Connect")
            terminal.type("y\n")
            terminal.wait_for("of this path (Ctrl-C brakes it)?")
            terminal.type("n\n")
            terminal.wait_for("stays where it is")
            assert terminal.end() == 1
        assert np.allclose(faults.state().joints, here, atol=1e-6)
        with Terminal("start", str(file), folder=tmp_path, lines=80) as terminal:
            for question in ("Connect", "of this path (Ctrl-C brakes it)?", "Then continue to its start"):
                terminal.wait_for(question)
                terminal.type("y\n")
            terminal.until(lambda: np.abs(np.array(faults.state().joints) - here).max() > 0.04, "most of the way")
            terminal.type("\x03")
            assert terminal.end() == 128 + signal.SIGINT
            assert terminal.shows("was stopped before it reached its start"), terminal.picture
        state = faults.state()
        assert state.rests and not state.program and not np.allclose(state.joints, here, atol=1e-3)


def test_start_without_terminal_moves_nothing(tmp_path: Path) -> None:
    result = tacsim("start", str(copy_of("ur5e-one", tmp_path, 66)))
    assert result.exit_code == 2 and "run this from a terminal" in " ".join(result.stderr.split())
    result = tacsim("start", "sim")
    assert result.exit_code == 2 and "has no UR arm" in " ".join(result.stderr.split())


@pytest.mark.deep
def test_start_killed_process_brings_arm_to_rest(tmp_path: Path) -> None:
    file = fast(copy_of("ur5e-one", tmp_path, 66))
    with Lab(file, offset=AWAY) as lab:
        faults, here = lab.faults["arm"], np.array(lab.faults["arm"].state().joints)
        with Terminal("start", str(file), folder=tmp_path, lines=80) as terminal:
            for question in ("Connect", "of this path (Ctrl-C brakes it)?", "Then continue to its start"):
                terminal.wait_for(question)
                terminal.type("y\n")
            terminal.until(lambda: np.abs(np.array(faults.state().joints) - here).max() > 0.04, "most of the way")
            terminal.process.kill()
            until(lambda: faults.state().rests and not faults.state().program, "rest without a program")
        gone = np.abs(np.array(faults.state().joints) - here).max()
        assert 0.04 < gone < 0.12  # of 0.157 rad


@pytest.mark.slow
def test_start_without_zeroing_keeps_force_fault(tmp_path: Path) -> None:
    file = fast(copy_of("ur5e-one", tmp_path, 66))
    with Lab(file, offset=AWAY) as lab:
        lab.faults["arm"].wrench([0.0, OFFSET, 0.0, 0.0, 0.0, 0.0])
        here, said = lab.faults["arm"].state().joints, list[str]()
        away = move_to_start(lab.config, lab.starts, Operator(lambda question: "Connect" in question, said.append))
        assert away["arm"] > 0.05 and "cannot be moved" in said[-1]
        assert np.allclose(lab.faults["arm"].state().joints, here, atol=1e-6)
