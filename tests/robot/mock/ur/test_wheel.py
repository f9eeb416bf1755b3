"""The unmodified ur_rtde wheel against the mock, in processes of its own: it may hang or crash, and holds the GIL."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import textwrap
import threading
import time
from typing import Any

import numpy as np
import pytest

from robot.common.kinematics import Kinematics, displacement, matrix
from robot.mock import MOCK_SERIAL, MockUR
from robot.mock.ur.machine.arm import HOME

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("rtde_control") is None, reason="ur_rtde has no wheel for this Python"
)
LIMIT = 90.0  # of one client process [s]

BEGIN = """
import json, os, time
from rtde_receive import RTDEReceiveInterface
from rtde_control import RTDEControlInterface
found = {}
def ends(receive, test, limit=60):
    end = time.monotonic() + limit
    while not test():
        assert time.monotonic() < end, "not in time"
        time.sleep(0.002)
"""


def client(mock: MockUR, code: str) -> dict[str, Any]:
    """Runs the code with ur_rtde; what it leaves in `found`."""
    end = "print('FOUND' + json.dumps(found), flush=True); os._exit(0)"
    text = "\n".join([BEGIN, f"host = {mock.host!r}", textwrap.dedent(code), end])
    # Without the destructors of ur_rtde, which take a second.
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=LIMIT)
    lines = [line for line in done.stdout.splitlines() if line.startswith("FOUND")]
    assert lines, done.stdout + done.stderr
    found: dict[str, Any] = json.loads(lines[-1].removeprefix("FOUND"))
    return found


def test_receive_reads_every_field_of_its_default_recipe(mock: MockUR) -> None:
    mock.faults.wrench([1, 2, 3, 0.1, 0.2, 0.3])
    found = client(
        mock,
        """
        r = RTDEReceiveInterface(host)
        ends(r, lambda: r.getActualTCPForce()[2] == 3)
        for name in dir(r):
            if name.startswith("get") and "Register" not in name and "State" not in name:
                found[name] = getattr(r, name)()
        found["bits"] = [r.isProtectiveStopped(), r.isEmergencyStopped(), r.isConnected(), r.getDigitalOutState(3)]
        found["safety"] = r.getSafetyMode()
        """,
    )
    assert found["getActualQ"] == pytest.approx(HOME) and found["getTargetQ"] == pytest.approx(HOME)
    np.testing.assert_allclose(matrix(found["getActualTCPPose"]), Kinematics().forward(HOME), atol=1e-9)
    assert found["getActualTCPForce"] == [1, 2, 3, 0.1, 0.2, 0.3]
    assert found["getRobotMode"] == 7 and found["safety"] == 1 and found["getJointMode"] == [253] * 6
    assert found["getSpeedScaling"] == 1 and found["getTimestamp"] > 0 and found["getPayload"] == 0
    assert found["getActualToolAccelerometer"] == pytest.approx([0, 0, -9.82], abs=1e-9)  # it hangs down
    assert found["bits"] == [False, False, True, False]


def test_control_moves_and_answers(mock: MockUR) -> None:
    found = client(
        mock,
        """
        r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
        p = r.getActualTCPPose()
        goal = [p[0] + 0.03, p[1], p[2] - 0.1, *p[3:]]
        found["moves"] = [c.moveL(goal, 0.25, 1.2), c.moveJ(r.getTargetQ(), 1, 1), c.moveJ_IK(goal, 1, 1)]
        ends(r, lambda: max(map(abs, r.getActualQd())) < 1e-9)
        found["goal"], found["pose"], found["q"] = goal, r.getActualTCPPose(), r.getActualQ()
        far = [5, 0, 0, 0, 0, 0]
        found["ik"], found["fk"] = c.getInverseKinematics(goal), c.getForwardKinematics()
        found["solvable"] = [c.getInverseKinematicsHasSolution(goal), c.getInverseKinematicsHasSolution(far)]
        found["safe"] = [c.isPoseWithinSafetyLimits(goal), c.isPoseWithinSafetyLimits(far)]
        found["safe"] += [c.isJointsWithinSafetyLimits([0] * 6), c.isJointsWithinSafetyLimits([7, 0, 0, 0, 0, 0])]
        found["tcp"] = [c.setTcp([0, 0, 0.1, 0, 0, 0]), c.getTCPOffset()]
        found["trans"], found["steady"] = c.poseTrans([1, 0, 0, 0, 0, 0], [0, 2, 0, 0, 0, 0]), c.isSteady()
        def second(call, *arguments):
            # The wheel does not wait for the answers of these: it returns what the registers held before.
            call(*arguments)
            begun = r.getTimestamp()
            ends(r, lambda: r.getTimestamp() > begun + 0.2)
            return call(*arguments)
        found["flange"], found["step"] = second(c.getActualToolFlangePose), second(c.getStepTime)
        found["torque"], found["history"] = second(c.getJointTorques), second(c.getActualJointPositionsHistory, 10)
        found["contact"] = second(c.toolContact, [0, 0, 1, 0, 0, 0])
        found["payload"] = [c.setPayload(1.2, [0, 0, 0.05]), c.setTargetPayload(1.2, [0, 0, 0.05], [1, 2, 3, 4, 5, 6])]
        ends(r, lambda: r.getPayloadInertia() == [1, 2, 3, 4, 5, 6])
        found["cog"] = r.getPayloadCog()
        found["freedrive"] = [c.freedriveMode([1, 0, 0, 0, 0, 0], [0] * 6), c.getFreedriveStatus()]
        found["freedrive"].append(c.endFreedriveMode())
        found["teach"] = [c.teachMode(), c.endTeachMode()]
        found["program"] = c.isProgramRunning()
        c.stopScript()
        """,
    )
    assert found["moves"] == [True] * 3 and found["program"]
    np.testing.assert_allclose(displacement(matrix(found["pose"]), matrix(found["goal"])), 0, atol=1e-8)
    np.testing.assert_allclose(found["ik"], found["q"], atol=1e-7)
    np.testing.assert_allclose(displacement(matrix(found["fk"]), matrix(found["goal"])), 0, atol=1e-8)
    assert found["solvable"] == [True, False] and found["safe"] == [True, False, True, False]
    assert found["tcp"] == [True, [0, 0, 0.1, 0, 0, 0]] and found["trans"] == [1, 2, 0, 0, 0, 0]
    np.testing.assert_allclose(displacement(matrix(found["flange"]), matrix(found["goal"])), 0, atol=1e-8)
    assert found["step"] == 0.002 and found["steady"] and found["contact"] == 0
    np.testing.assert_allclose(found["history"], found["q"], atol=1e-9)
    assert found["payload"] == [True, True] and found["cog"] == [0, 0, 0.05]
    assert found["freedrive"] == [True, 0, True] and found["teach"] == [True, True]


def test_control_servo_speed_force_jog_and_paths(mock: MockUR) -> None:
    found = client(
        mock,
        """
        r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
        p = r.getActualTCPPose()
        def rest():
            ends(r, lambda: max(map(abs, r.getActualQd())) < 1e-9)
            return r.getActualTCPPose()
        found["servo"] = []
        for k in range(200):
            found["servo"].append(c.servoL([p[0] + 1e-4 * k, *p[1:]], 0.5, 0.5, 0.002, 0.03, 600))
        ends(r, lambda: r.getActualTCPPose()[0] > p[0] + 0.0198)
        found["servoStop"] = c.servoStop()
        found["speed"] = c.speedL([0, 0, -0.05, 0, 0, 0], 0.5)
        ends(r, lambda: abs(r.getActualTCPSpeed()[2] + 0.05) < 1e-4)
        found["speedStop"] = c.speedStop()
        rest()
        found["force"] = [c.forceMode([0] * 6, [0, 0, 1, 0, 0, 0], [0, 0, -10, 0, 0, 0], 2, [0.1, 0.1, 0.05, 1, 1, 1])]
        ends(r, lambda: r.getActualTCPSpeed()[2] < -0.009)
        found["force"] += [c.forceModeStop(), c.zeroFtSensor()]
        rest()
        found["jog"] = [c.jogStart([0, 0, 0.02, 0, 0, 0], c.FEATURE_TOOL)]
        ends(r, lambda: r.getActualTCPSpeed()[2] < -0.019)
        found["jog"].append(c.jogStop())
        q = rest()
        a, b = [q[0], q[1], q[2] + 0.05, *q[3:]], [q[0] + 0.05, q[1], q[2] + 0.05, *q[3:]]
        found["path"] = c.moveL([a + [0.25, 1.2, 0.02], b + [0.25, 1.2, 0.0]])
        found["at"], found["b"] = rest(), b
        found["async"] = [c.moveL(a, 0.05, 1.0, True)]
        ends(r, lambda: c.getAsyncOperationProgressEx().isAsyncOperationRunning())
        c.stopL(10.0)
        found["async"].append(c.getAsyncOperationProgressEx().isAsyncOperationRunning())
        found["program"] = c.isProgramRunning()
        """,
    )
    assert found["servo"] == [True] * 200 and found["servoStop"] and found["speed"] and found["speedStop"]
    assert found["force"] == [True] * 3 and found["jog"] == [True, True] and found["path"]
    # Numbers of a path have six digits on the wire.
    np.testing.assert_allclose(displacement(matrix(found["at"]), matrix(found["b"])), 0, atol=1e-5)
    assert found["async"] == [True, False] and found["program"]


def test_jacobian_of_a_newer_controller(mock: MockUR) -> None:
    mock.faults.version(5, 25, 1)
    found = client(mock, "c = RTDEControlInterface(host); found['jacobian'] = c.getJacobian()")
    np.testing.assert_allclose(np.reshape(found["jacobian"], (6, 6)).T, Kinematics().jacobian(HOME), atol=1e-12)


def test_io_and_dashboard(mock: MockUR) -> None:
    found = client(
        mock,
        """
        from rtde_io import RTDEIOInterface
        from dashboard_client import DashboardClient
        r, io, d = RTDEReceiveInterface(host), RTDEIOInterface(host), DashboardClient(host)
        io.setStandardDigitalOut(3, True); io.setToolDigitalOut(1, True); io.setSpeedSlider(0.5)
        io.setAnalogOutputVoltage(1, 0.25)
        ends(r, lambda: abs(r.getSpeedScaling() - 0.5) < 1e-9)
        ends(r, lambda: r.getActualDigitalOutputBits() == (1 << 3 | 1 << 17))
        ends(r, lambda: abs(r.getStandardAnalogOutput1() - 2.5) < 1e-9)
        d.connect()
        found["facts"] = [d.polyscopeVersion(), d.getSerialNumber(), d.isInRemoteControl()]
        found["facts"] += [d.robotmode(), d.safetystatus()]
        d.powerOff(); ends(r, lambda: r.getRobotMode() == 3)
        d.powerOn(); ends(r, lambda: r.getRobotMode() == 5)
        d.brakeRelease(); ends(r, lambda: r.getRobotMode() == 7)
        """,
    )
    version, serial, remote, mode, safety = found["facts"]
    assert "5.11.0.108150" in version and serial == MOCK_SERIAL and remote
    assert mode == "Robotmode: RUNNING" and safety == "Safetystatus: NORMAL"


def test_protective_stop_in_motion_and_back(mock: MockUR) -> None:
    def press() -> None:
        end = time.monotonic() + 60
        while time.monotonic() < end and mock.faults.state().tcp_speed[2] > -0.019:
            time.sleep(0.01)
        mock.faults.protective_stop()

    presser = threading.Thread(target=press)
    presser.start()
    found = client(
        mock,
        """
        from dashboard_client import DashboardClient
        r, c, d = RTDEReceiveInterface(host), RTDEControlInterface(host), DashboardClient(host)
        p = r.getActualTCPPose()
        goal = [*p[:2], p[2] - 0.2, *p[3:]]
        found["moved"] = c.moveL(goal, 0.02, 0.5)
        ends(r, lambda: r.isProtectiveStopped())
        found["again"] = c.moveL(goal, 0.02, 0.5)
        d.connect(); d.unlockProtectiveStop()
        found["upload"] = c.reuploadScript()
        ends(r, lambda: c.isProgramRunning())
        time.sleep(0.1)
        found["after"] = c.moveL(r.getActualTCPPose(), 0.1, 0.5)
        """,
    )
    presser.join()
    assert found == {"moved": False, "again": False, "upload": True, "after": True}


def test_refusals_that_the_wheel_turns_into_errors(mock: MockUR) -> None:
    refused = """
        try:
            RTDEControlInterface(host)
        except RuntimeError as error:
            found["error"] = str(error)
        """
    mock.faults.remote_control(False)
    assert "remote control" in client(mock, refused)["error"]
    mock.faults.remote_control(True)
    mock.faults.claim(["input_int_register_0"])
    assert "already in use" in client(mock, refused)["error"]
    mock.faults.claim([])
    found = client(
        mock, "c = RTDEControlInterface(host)\n" + textwrap.dedent(refused) + "\nfound['first'] = c.isSteady()"
    )
    assert "already in use" in found["error"] and found["first"]


def test_command_without_a_model_is_refused_not_pretended(mock: MockUR) -> None:
    mock.faults.version(5, 25, 1)
    client(
        mock,
        """
        c = RTDEControlInterface(host)
        try:
            c.getMassMatrix()
        except Exception:
            pass
        """,
    )
    assert "get_mass_matrix is not modelled" in mock.faults.state().stop_reason
