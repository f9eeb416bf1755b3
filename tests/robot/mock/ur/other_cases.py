"""Every method of RTDEReceiveInterface, RTDEIOInterface and DashboardClient."""

from __future__ import annotations

import datetime
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from robot.common.kinematics import matrix
from robot.mock import MOCK_SERIAL
from robot.mock.ur.machine.arm import HOME
from robot.mock.ur.machine.forces import GRAVITY
from tests.robot.mock.ur.cases import Robot, Verdict, case
from tests.robot.mock.wire_client import RtdeClient

RECEIVE, IO, DASHBOARD = "RTDEReceiveInterface", "RTDEIOInterface", "DashboardClient"

# -- what is received ------------------------------------------------------------------------------------------------


@case(
    RECEIVE,
    "getActualQ getActualQd getActualTCPPose getActualTCPSpeed getTargetQ getTargetQd getTargetQdd getTargetTCPPose "
    "getTargetTCPSpeed getTimestamp getActualExecutionTime",
)
def motion(robot: Robot) -> None:
    receive = robot.receive
    np.testing.assert_allclose(receive.getActualQ(), HOME)
    frame = robot.kinematics.forward(HOME)
    for found in (receive.getActualTCPPose(), receive.getTargetTCPPose()):
        np.testing.assert_allclose(matrix(found), frame, atol=1e-9)
    before, then = receive.getTimestamp(), receive.getTargetQ()
    assert robot.control.speedL([0, 0, -0.02, 0, 0, 0], 0.05)
    robot.until(lambda: np.abs(receive.getTargetQdd()).max() > 0.01)
    robot.until(lambda: abs(receive.getActualTCPSpeed()[2] + 0.02) < 1e-4)
    assert abs(receive.getTargetTCPSpeed()[2] + 0.02) < 1e-4
    wanted = robot.kinematics.jacobian(receive.getTargetQ()) @ receive.getTargetQd()
    np.testing.assert_allclose(wanted, receive.getTargetTCPSpeed(), atol=1e-3)
    assert np.abs(np.subtract(receive.getActualQd(), receive.getTargetQd())).max() < 1e-3
    assert receive.getTimestamp() > before and receive.getTargetQ() != then
    assert 0 < receive.getActualExecutionTime() < 1


@case(RECEIVE, "getActualTCPForce getFtRawWrench getPayload getPayloadCog getPayloadInertia getActualToolAccelerometer")
def load(robot: Robot) -> None:
    receive, wrench = robot.receive, [1, 2, 3, 0.1, 0.2, 0.3]
    robot.faults.wrench(wrench)
    robot.until(lambda: receive.getActualTCPForce() == wrench)
    turn = robot.kinematics.forward(HOME)[:3, :3]
    np.testing.assert_allclose(receive.getFtRawWrench(), [*(turn.T @ wrench[:3]), *(turn.T @ wrench[3:])], atol=1e-9)
    assert receive.getPayload() == 0 and receive.getPayloadCog() == [0] * 3 and receive.getPayloadInertia() == [0] * 6
    np.testing.assert_allclose(receive.getActualToolAccelerometer(), [0, 0, -GRAVITY], atol=1e-9)  # it hangs down


@case(
    RECEIVE,
    "getRobotMode getRobotStatus getRuntimeState getSafetyMode getSafetyStatusBits getJointMode isProtectiveStopped "
    "isEmergencyStopped getActualJointVoltage getActualMainVoltage getActualRobotVoltage",
)
def states(robot: Robot) -> None:
    receive = robot.receive

    def seen() -> list[object]:
        modes = [receive.getRobotMode(), receive.getSafetyMode()]
        return [*modes, receive.getSafetyStatusBits(), receive.getRobotStatus()]

    assert seen() == [7, 1, 1, 1] and receive.getRuntimeState() == 1 and receive.getJointMode() == [253] * 6
    assert robot.control.isProgramRunning()
    robot.until(lambda: seen() == [7, 1, 1, 3] and receive.getRuntimeState() == 2)
    robot.faults.protective_stop()
    robot.until(lambda: bool(receive.isProtectiveStopped()) and seen() == [7, 3, 1 << 2 | 1 << 10, 1])
    robot.faults.recover()
    assert not receive.isEmergencyStopped() and receive.getActualJointVoltage() == [48.0] * 6
    robot.faults.estop()
    robot.until(lambda: bool(receive.isEmergencyStopped()) and receive.getRobotMode() == 3)
    assert (
        receive.getActualMainVoltage() == receive.getActualRobotVoltage() == 0 and receive.getJointMode() == [239] * 6
    )


@case(RECEIVE, "getSpeedScaling getTargetSpeedFraction getSpeedScalingCombined")
def scaling(robot: Robot) -> None:
    receive = robot.receive
    assert receive.getSpeedScaling() == receive.getTargetSpeedFraction() == 1
    assert robot.io.setSpeedSlider(0.5)
    # The scaling is the trajectory limiter's share of the target speed: a lowered slider leaves it at 1.
    robot.until(lambda: receive.getTargetSpeedFraction() == 0.5 and abs(receive.getSpeedScaling() - 1.0) < 1e-9)
    assert receive.getSpeedScalingCombined() == receive.getSpeedScaling() * receive.getTargetSpeedFraction()


@case(
    RECEIVE,
    "getActualDigitalOutputBits getDigitalOutState getStandardAnalogOutput0 getStandardAnalogOutput1",
)
def outputs(robot: Robot) -> None:
    receive, io = robot.receive, robot.io
    assert io.setStandardDigitalOut(3, True) and io.setAnalogOutputVoltage(0, 0.25)
    robot.until(lambda: receive.getActualDigitalOutputBits() == 1 << 3 and receive.getDigitalOutState(3))
    robot.until(lambda: receive.getStandardAnalogOutput0() == 2.5)
    assert receive.getStandardAnalogOutput1() == 0.004  # 0 of 4 to 20 mA


@case(
    RECEIVE,
    "getActualCurrent getTargetCurrent getTargetMoment getJointControlOutput getActualMomentum getActualRobotCurrent "
    "getJointTemperatures getActualDigitalInputBits getDigitalInState getStandardAnalogInput0 getStandardAnalogInput1",
    Verdict.CONSTANT,
    "not modelled: 0, and temperatures of 30 degrees",
)
def constants(robot: Robot) -> None:
    receive = robot.receive
    assert robot.control.moveJ([angle + 0.1 for angle in HOME], 1.0, 1.0)
    zeros = (receive.getActualCurrent, receive.getTargetCurrent, receive.getTargetMoment, receive.getJointControlOutput)
    assert [call() for call in zeros] == [[0] * 6] * 4
    assert receive.getJointTemperatures() == [30] * 6
    assert receive.getActualMomentum() == receive.getActualRobotCurrent() == 0
    assert receive.getActualDigitalInputBits() == 0 and not receive.getDigitalInState(0)
    assert receive.getStandardAnalogInput0() == receive.getStandardAnalogInput1() == 0


@case(RECEIVE, "getOutputIntRegister getOutputDoubleRegister")
def output_registers(robot: Robot) -> None:
    receive, script = robot.receive, "write_output_integer_register(12, 7)\nwrite_output_float_register(19, 2.5)"
    assert robot.control.sendCustomScriptFunction("registers", script)
    robot.until(lambda: receive.getOutputIntRegister(12) == 7 and receive.getOutputDoubleRegister(19) == 2.5)
    with pytest.raises(ValueError, match="12-19"):
        receive.getOutputIntRegister(0)


@case(RECEIVE, "isConnected disconnect reconnect initPeriod waitPeriod startFileRecording stopFileRecording")
def receiving(robot: Robot) -> None:
    receive = robot.receive
    assert receive.isConnected() and isinstance(receive.initPeriod(), datetime.timedelta)
    receive.waitPeriod(receive.initPeriod())
    with TemporaryDirectory() as folder:
        path = Path(folder, "rows.csv")
        assert receive.startFileRecording(str(path), ["timestamp", "actual_q"])
        begun = receive.getTimestamp()
        robot.until(lambda: receive.getTimestamp() > begun + 0.5)
        assert receive.stopFileRecording()
        lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("timestamp,actual_q_0") and len(lines) > 10
    receive.disconnect()
    assert not receive.isConnected()
    assert receive.reconnect() and receive.isConnected()
    before = receive.getTimestamp()
    robot.until(lambda: receive.getTimestamp() > before)


# -- inputs and outputs ----------------------------------------------------------------------------------------------


@case(
    IO,
    "setStandardDigitalOut setConfigurableDigitalOut setToolDigitalOut setAnalogOutputVoltage setAnalogOutputCurrent "
    "setSpeedSlider",
)
def io_outputs(robot: Robot) -> None:
    receive, io = robot.receive, robot.io
    assert io.setStandardDigitalOut(1, True) and io.setConfigurableDigitalOut(2, True) and io.setToolDigitalOut(1, True)
    robot.until(lambda: receive.getActualDigitalOutputBits() == 1 << 1 | 1 << 10 | 1 << 17)
    assert io.setStandardDigitalOut(1, False)
    robot.until(lambda: receive.getActualDigitalOutputBits() == 1 << 10 | 1 << 17)
    assert io.setAnalogOutputVoltage(0, 0.25) and io.setAnalogOutputCurrent(1, 0.5)
    robot.until(lambda: receive.getStandardAnalogOutput0() == 2.5)
    robot.until(lambda: abs(receive.getStandardAnalogOutput1() - 0.012) < 1e-12)
    assert io.setSpeedSlider(0.5)
    robot.until(lambda: abs(receive.getSpeedScalingCombined() - 0.5) < 1e-9)
    start = time.monotonic()
    begun = receive.getTimestamp()
    assert robot.control.moveL(robot.shifted(0, 0, -0.1), 0.1, 1.0)
    assert receive.getTimestamp() - begun > 2 * 0.1 / 0.1 and time.monotonic() > start


@case(IO, "setInputIntRegister setInputDoubleRegister")
def io_registers(robot: Robot) -> None:
    assert robot.io.setInputIntRegister(18, 42) and robot.io.setInputDoubleRegister(19, 2.5)
    with RtdeClient(robot.host) as client:
        client.protocol()
        client.outputs("input_int_register_18", "input_double_register_19")
        client.start()
        robot.until(lambda: client.newest() == {"input_int_register_18": (42,), "input_double_register_19": (2.5,)})


@case(IO, "isConnected disconnect reconnect")
def io_connection(robot: Robot) -> None:
    io = robot.io
    assert io.isConnected()
    io.disconnect()
    assert not io.isConnected() and io.reconnect()
    assert io.setStandardDigitalOut(0, True)
    robot.until(lambda: bool(robot.receive.getDigitalOutState(0)))


# -- dashboard -------------------------------------------------------------------------------------------------------


@case(
    DASHBOARD,
    "connect isConnected disconnect send receive quit polyscopeVersion getSerialNumber getRobotModel isInRemoteControl "
    "robotmode safetymode safetystatus programState running getLoadedProgram",
)
def dashboard_questions(robot: Robot) -> None:
    dashboard = robot.dashboard
    assert dashboard.isConnected() and "5.11.0.108150" in dashboard.polyscopeVersion()
    assert dashboard.getSerialNumber() == MOCK_SERIAL and dashboard.getRobotModel() == "UR5"
    assert dashboard.isInRemoteControl() and dashboard.robotmode() == "Robotmode: RUNNING"
    assert dashboard.safetymode() == "Safetymode: NORMAL" and dashboard.safetystatus() == "Safetystatus: NORMAL"
    assert dashboard.getLoadedProgram() == "No program loaded"
    assert not dashboard.running() and dashboard.programState().startswith("STOPPED")
    assert robot.control.isProgramRunning()
    assert dashboard.running() and dashboard.programState().startswith("PLAYING")
    dashboard.send("robotmode\n")
    assert dashboard.receive() == "Robotmode: RUNNING"
    dashboard.quit()
    dashboard.disconnect()
    assert not dashboard.isConnected()
    dashboard.connect()
    assert dashboard.robotmode() == "Robotmode: RUNNING"


@case(DASHBOARD, "pause play stop powerOff powerOn brakeRelease unlockProtectiveStop restartSafety")
def dashboard_commands(robot: Robot) -> None:
    dashboard, receive, control = robot.dashboard, robot.receive, robot.control
    assert control.speedJ([0.1, 0, 0, 0, 0, 0], 1.0)
    robot.until(lambda: receive.getActualQd()[0] > 0.09)
    dashboard.pause()
    robot.rest()
    dashboard.play()
    robot.until(lambda: receive.getActualQd()[0] > 0.09)
    dashboard.stop()
    robot.until(lambda: receive.getRuntimeState() == 1)
    robot.faults.protective_stop()
    robot.until(lambda: bool(receive.isProtectiveStopped()))
    dashboard.unlockProtectiveStop()
    robot.until(lambda: not receive.isProtectiveStopped())
    for command, mode in ((dashboard.powerOff, 3), (dashboard.powerOn, 5), (dashboard.brakeRelease, 7)):
        command()
        robot.until(lambda mode=mode: receive.getRobotMode() == mode)
    dashboard.restartSafety()
    robot.until(lambda: receive.getRobotMode() == 3)


@case(
    DASHBOARD,
    "popup closePopup closeSafetyPopup addToLog isProgramSaved shutdown",
    Verdict.CONSTANT,
    "answered without effect (`isProgramSaved` is False); after `shutdown` the mock continues",
)
def dashboard_answers(robot: Robot) -> None:
    dashboard = robot.dashboard
    dashboard.popup("hello")
    dashboard.addToLog("noted")
    dashboard.closePopup()
    dashboard.closeSafetyPopup()
    assert any("hello" in str(line) for line in robot.faults.log())
    assert not dashboard.isProgramSaved()
    dashboard.shutdown()
    assert robot.faults.state().mode == "RUNNING"


@case(DASHBOARD, "setUserRole", Verdict.NOT_THERE, "the wheel does not export the type of its argument")
def user_role(robot: Robot) -> None:
    for role in (0, "none"):
        with pytest.raises(TypeError):
            robot.dashboard.setUserRole(role)


@case(DASHBOARD, "loadURP", Verdict.REFUSED, '"File not found": no program tree')
def load_program(robot: Robot) -> None:
    with pytest.raises(RuntimeError, match="File not found"):
        robot.dashboard.loadURP("pick.urp")
