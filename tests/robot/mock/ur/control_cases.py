"""The other methods of RTDEControlInterface: questions, the program, what the mock refuses."""

from __future__ import annotations

import datetime
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from robot.common.kinematics import displacement, matrix
from robot.mock.ur.machine.arm import HOME
from tests.robot.mock.ur.arm_cases import CONTROL
from tests.robot.mock.ur.cases import Robot, Verdict, case

NO_DYNAMICS = "the program ends, as after a run-time error"
STALE = "returns the previous content of the registers: call it twice"
NEWER = f"{STALE}; from PolyScope 5.23 on"

# -- questions -------------------------------------------------------------------------------------------------------


@case(
    CONTROL,
    "setTcp getTCPOffset getInverseKinematics getInverseKinematicsHasSolution poseTrans "
    "isPoseWithinSafetyLimits isJointsWithinSafetyLimits isSteady getTargetWaypoint",
)
def questions(robot: Robot) -> None:
    control, tcp, far = robot.control, [0, 0, 0.1, 0, 0, 0], [5.0, 0, 0, 0, 0, 0]
    assert control.setTcp(tcp) and control.getTCPOffset() == tcp
    robot.until(lambda: robot.receive.getActualTCPPose()[2] < robot.kinematics.forward(HOME)[2, 3] - 0.09)
    here = robot.receive.getActualTCPPose()
    np.testing.assert_allclose(control.getInverseKinematics(here), HOME, atol=1e-7)
    assert [control.getInverseKinematicsHasSolution(each) for each in (here, far)] == [True, False]
    assert control.poseTrans([1, 0, 0, 0, 0, 0], [0, 2, 0, 0, 0, 0]) == [1, 2, 0, 0, 0, 0]
    assert [control.isPoseWithinSafetyLimits(each) for each in (here, far)] == [True, False]
    assert [control.isJointsWithinSafetyLimits([angle] * 6) for angle in (0.0, 7.0)] == [True, False]
    assert control.isSteady()
    goal = robot.shifted(0, 0, -0.1)
    assert control.moveL(goal, 0.02, 0.5, True)
    robot.until(lambda: not control.isSteady())
    np.testing.assert_allclose(displacement(matrix(control.getTargetWaypoint()), matrix(goal)), 0, atol=1e-8)


@case(
    CONTROL,
    "getForwardKinematics",
    Verdict.LIBRARY,
    "with a TCP and no joints it sends 100 bytes for a recipe of 52, and the result is wrong: give both or neither",
)
def forward_kinematics(robot: Robot) -> None:
    q, tcp = [angle + 0.1 for angle in HOME], [0, 0, 0.1, 0, 0, 0]
    found = matrix(robot.control.getForwardKinematics())
    np.testing.assert_allclose(found, robot.kinematics.forward(HOME), atol=1e-8)
    found = matrix(robot.control.getForwardKinematics(q, tcp))
    np.testing.assert_allclose(found, robot.kinematics.forward(q, matrix(tcp)), atol=1e-8)
    assert not robot.faults.log()[1:]  # the program has started, no more
    robot.control.getForwardKinematics([], tcp)
    assert any("100 bytes, recipe 6 has 52" in str(line) for line in robot.faults.log())


@case(
    CONTROL,
    "getStepTime getJointTorques getActualJointPositionsHistory getActualToolFlangePose toolContact",
    Verdict.LIBRARY,
    STALE,
)
def stale_questions(robot: Robot) -> None:
    control, again = robot.control, robot.again
    assert again(control.getStepTime) == 0.002
    np.testing.assert_allclose(again(control.getActualJointPositionsHistory, 10), HOME, atol=1e-12)
    flange = matrix(again(control.getActualToolFlangePose))
    np.testing.assert_allclose(flange, robot.kinematics.forward(HOME), atol=1e-8)
    assert again(control.toolContact, [0, 0, -1, 0, 0, 0]) == 0
    robot.faults.wrench([0, 0, 10, 0, 0, 0])
    robot.until(lambda: robot.receive.getActualTCPForce()[2] == 10)
    assert again(control.toolContact, [0, 0, -1, 0, 0, 0]) > 0
    wanted = -robot.kinematics.jacobian(HOME).T @ [0, 0, 10, 0, 0, 0]
    np.testing.assert_allclose(again(control.getJointTorques), wanted, atol=1e-9)


@case(CONTROL, "getJacobian getJacobianTimeDerivative getTargetJointAccelerations", Verdict.LIBRARY, NEWER)
def newer_questions(robot: Robot) -> None:
    robot.faults.version(5, 25, 1)
    control, jacobian = robot.control, robot.kinematics.jacobian
    found = np.reshape(robot.again(control.getJacobian), (6, 6)).T
    np.testing.assert_allclose(found, jacobian(HOME), atol=1e-12)
    assert control.speedJ([0.1, 0, 0, 0, 0, 0], 5.0)
    robot.until(lambda: abs(robot.receive.getActualQd()[0] - 0.1) < 1e-9)
    rate = np.reshape(robot.again(control.getJacobianTimeDerivative), (6, 6)).T
    assert np.abs(rate[:, 1]).max() > 0.01 and np.abs(rate[:, 0]).max() < 0.1
    np.testing.assert_allclose(robot.again(control.getTargetJointAccelerations), 0, atol=1e-9)


# -- the program -----------------------------------------------------------------------------------------------------


@case(
    CONTROL,
    "isProgramRunning stopScript reuploadScript getRobotStatus isConnected disconnect reconnect initPeriod waitPeriod",
)
def program(robot: Robot) -> None:
    control = robot.control
    assert control.isProgramRunning() and control.isConnected() and control.getRobotStatus() == 0b11
    control.stopScript()
    robot.until(lambda: not robot.faults.state().program)
    assert not control.isProgramRunning() and not control.moveJ(HOME)
    assert control.reuploadScript()
    robot.until(lambda: bool(control.isProgramRunning()))
    begun, count = control.initPeriod(), 20
    assert isinstance(begun, datetime.timedelta)
    start = time.monotonic()
    for _ in range(count):
        control.waitPeriod(control.initPeriod())
    assert time.monotonic() - start > 0.8 * count * 0.002
    control.disconnect()
    assert not control.isConnected()
    assert control.reconnect() and control.isConnected()
    robot.until(lambda: bool(control.isProgramRunning()))
    assert control.moveJ(HOME)


@case(CONTROL, "")
def refused_connections(robot: Robot) -> None:
    """What the controller refuses, the library turns into errors; who is connected goes on."""
    from rtde_control import RTDEControlInterface

    robot.faults.remote_control(False)
    with pytest.raises(RuntimeError, match="remote control"):
        RTDEControlInterface(robot.host)
    robot.faults.remote_control(True)
    robot.faults.claim(["input_int_register_0"])
    with pytest.raises(RuntimeError, match="already in use"):
        RTDEControlInterface(robot.host)
    robot.faults.claim([])
    assert robot.control.isConnected()
    with pytest.raises(RuntimeError, match="already in use"):
        RTDEControlInterface(robot.host)
    assert robot.control.isSteady()


@case(CONTROL, "setCustomScriptFile")
def own_control_script(robot: Robot) -> None:
    """A user's own copy of the control script, in place of the one inside the library."""
    from tests.robot.mock.wire_client import control_script

    control = robot.control
    with TemporaryDirectory() as folder:
        path = Path(folder, "mine.script")
        path.write_text(control_script(), encoding="utf-8")
        control.setCustomScriptFile(str(path))
    robot.until(lambda: bool(control.isProgramRunning()))
    assert control.moveJ(HOME)


@case(
    CONTROL,
    "sendCustomScript sendCustomScriptFunction sendCustomScriptFile",
    Verdict.ROBOT,
    "scripts that are lists of calls (below). Any other script, and one that ends with an error, raises RuntimeError "
    "at once, because its script connection is cut (disconnect(), reconnect()); with a robot the library waits 600 s",
)
def custom_scripts(robot: Robot) -> None:
    control, receive = robot.control, robot.receive
    assert control.sendCustomScriptFunction("gripper", "set_tool_digital_out(0, True)\nsleep(0.1)")
    robot.until(lambda: receive.getActualDigitalOutputBits() == 1 << 16)
    goal = robot.shifted(0, 0, -0.05)
    move = f"def mine():\n movel(p{goal}, a=1.2, v=0.25)\n write_output_integer_register(0, 2)\nend\n"
    assert control.sendCustomScript(move)
    robot.at(goal)
    with TemporaryDirectory() as folder:
        path = Path(folder, "mine.script")
        path.write_text('def mine():\n textmsg("hello")\n write_output_integer_register(0, 2)\nend\n', "utf-8")
        assert control.sendCustomScriptFile(str(path))
    assert any("hello" in str(line) for line in robot.faults.log())
    assert control.moveJ(HOME)  # the control script is back
    with pytest.raises(RuntimeError):
        control.sendCustomScriptFunction("f", "x = 1")
    assert "syntax_error_on_line:3:" in robot.faults.state().stop_reason
    control.disconnect()
    assert control.reconnect() and control.moveJ(HOME)


# -- what the mock refuses -------------------------------------------------------------------------------------------


@case(
    CONTROL,
    "getMassMatrix getCoriolisAndCentrifugalTorques directTorque",
    Verdict.REFUSED,
    NO_DYNAMICS,
)
def dynamics(robot: Robot) -> None:
    robot.faults.version(5, 26, 0)
    control = robot.control
    for call, arguments, name in (
        (control.getMassMatrix, (), "get_mass_matrix"),
        (control.getCoriolisAndCentrifugalTorques, (), "get_coriolis_and_centrifugal_torques"),
        (control.directTorque, ([0.0] * 6,), "direct_torque"),
    ):
        with robot.refused(f"{name} is not modelled"):
            call(*arguments)
        assert not control.moveJ(HOME)  # it takes the command out of the register, which would end the next program too
        assert control.reuploadScript()
        robot.until(lambda: bool(control.isProgramRunning()))


@case(
    CONTROL,
    "ftRtdeInputEnable enableExternalFtSensor setExternalForceTorque",
    Verdict.REFUSED,
    "enabling ends the program; use `faults.wrench`. Without enabling, the values have no effect, as on a robot",
)
def external_sensor(robot: Robot) -> None:
    control = robot.control
    assert control.setExternalForceTorque([0, 0, 50, 0, 0, 0])
    time.sleep(0.2)
    assert robot.receive.getActualTCPForce() == [0] * 6
    for call in (control.ftRtdeInputEnable, control.enableExternalFtSensor):
        with robot.refused("external force sensors"):
            call(True)
        assert control.reuploadScript()
        robot.until(lambda: bool(control.isProgramRunning()))
