"""The methods of RTDEControlInterface that move the arm, or stop it."""

from __future__ import annotations

import threading
import time

import numpy as np

from robot.common.kinematics import pose
from robot.mock.ur.machine.arm import HOME
from robot.mock.ur.machine.forces import GRAVITY
from tests.robot.mock.ur.cases import Robot, Verdict, case

CONTROL = "RTDEControlInterface"

# -- moves -----------------------------------------------------------------------------------------------------------


@case(CONTROL, "moveJ moveJ_IK moveL moveL_FK")
def moves(robot: Robot) -> None:
    control, goal = robot.control, robot.shifted(0.03, 0, -0.1)
    assert control.moveL(goal, 0.25, 1.2)
    robot.at(goal)
    assert control.moveJ(HOME, 1.0, 1.0)
    robot.at(pose(robot.kinematics.forward(HOME)))
    assert control.moveJ_IK(goal, 1.0, 1.0)
    robot.at(goal)
    assert control.moveL_FK(HOME, 0.25, 1.2)
    robot.at(pose(robot.kinematics.forward(HOME)))


@case(CONTROL, "movePath getAsyncOperationProgress getAsyncOperationProgressEx")
def paths(robot: Robot) -> None:
    from rtde_control import Path as Waypoints
    from rtde_control import PathEntry

    control, home = robot.control, robot.shifted()
    a, b = robot.shifted(0, 0, -0.1), robot.shifted(0.1, 0, -0.1)
    path = Waypoints()
    for corner, blend in ((a, 0.02), (b, 0.0)):
        kind = PathEntry.MoveL, PathEntry.PositionTcpPose
        path.addEntry(PathEntry(*kind, [*corner, 0.25, 1.2, blend]))
    assert control.movePath(path, True)
    robot.until(lambda: bool(control.getAsyncOperationProgressEx().isAsyncOperationRunning()))
    robot.until(lambda: control.getAsyncOperationProgressEx().progress() == 1)
    robot.until(lambda: not control.getAsyncOperationProgressEx().isAsyncOperationRunning())
    assert control.getAsyncOperationProgress() < 0
    robot.at(b, within=1e-5)  # numbers of a path have six digits on the wire
    assert control.moveL([[*a, 0.25, 1.2, 0.02], [*home, 0.25, 1.2, 0.0]])
    robot.at(home, within=1e-5)


@case(CONTROL, "stopJ stopL")
def stops(robot: Robot) -> None:
    for stop in (robot.control.stopL, robot.control.stopJ):
        begun, goal = robot.rest(), robot.shifted(0, 0, -0.1)
        assert robot.control.moveL(goal, 0.1, 1.2, True)
        robot.until(lambda: robot.receive.getActualTCPSpeed()[2] < -0.05)
        stop(2.0)
        gone = np.abs(robot.rest() - begun)[2]
        assert 1e-3 < gone < 0.09


@case(CONTROL, "servoJ servoL servoStop")
def servo(robot: Robot) -> None:
    q = list(HOME)
    for k in range(100):
        q[0] = HOME[0] + 5e-4 * k
        assert robot.control.servoJ(q, 0, 0, 0.002, 0.05, 300)
    robot.until(lambda: abs(robot.receive.getActualQ()[0] - q[0]) < 1e-4)
    goal = robot.shifted(0, 0, -0.02)
    assert robot.control.servoL(goal, 0, 0, 0.002, 0.05, 300)
    robot.until(lambda: abs(robot.receive.getActualTCPPose()[2] - goal[2]) < 1e-5)
    assert robot.control.servoStop()
    robot.rest()


@case(
    CONTROL,
    "servoC",
    Verdict.LIBRARY,
    "moves; the next call of any kind waits 4 s and returns False, the one after it works",
)
def servo_circle(robot: Robot) -> None:
    """The library sends it as if nothing were to be waited for, its script answers as if something were."""
    control, goal = robot.control, robot.shifted(0, 0, -0.02)
    assert control.servoC(goal, 0.25, 1.2)
    robot.until(lambda: abs(robot.receive.getActualTCPPose()[2] - goal[2]) < 1e-4)
    assert not control.servoStop() and robot.faults.state().program
    assert control.servoStop()


@case(CONTROL, "speedJ speedL speedStop jogStart jogStop")
def speeds(robot: Robot) -> None:
    control, receive = robot.control, robot.receive
    assert control.speedL([0, 0, -0.05, 0, 0, 0], 0.5)
    robot.until(lambda: abs(receive.getActualTCPSpeed()[2] + 0.05) < 1e-4)
    assert control.speedStop()
    robot.rest()
    assert control.speedJ([0.2, 0, 0, 0, 0, 0], 1.0)
    robot.until(lambda: abs(receive.getActualQd()[0] - 0.2) < 1e-4)
    assert control.speedStop()
    robot.rest()
    assert control.jogStart([0, 0, 0.02, 0, 0, 0], control.FEATURE_TOOL)
    robot.until(lambda: abs(receive.getActualTCPSpeed()[2] + 0.02) < 1e-4)  # the tool points down
    assert control.jogStop()
    robot.rest()


@case(CONTROL, "setWatchdog kickWatchdog")
def watchdog(robot: Robot) -> None:
    assert robot.control.setWatchdog(1.0)
    for _ in range(20):
        assert robot.control.kickWatchdog()
        time.sleep(0.05)
    assert robot.faults.state().program
    robot.until(lambda: not robot.faults.state().program)
    assert "watchdog" in robot.faults.state().stop_reason


# -- forces ----------------------------------------------------------------------------------------------------------


@case(CONTROL, "forceMode forceModeStop forceModeSetDamping forceModeSetGainScaling")
def force_mode(robot: Robot) -> None:
    control, receive = robot.control, robot.receive
    assert control.forceModeSetDamping(0.05) and control.forceModeSetGainScaling(1.0)
    robot.faults.wall(receive.getActualTCPPose()[2] - 0.002, 5e3)
    assert control.forceMode([0] * 6, [0, 0, 1, 0, 0, 0], [0, 0, -10, 0, 0, 0], 2, [0.1, 0.1, 0.05, 1, 1, 1])
    robot.until(lambda: abs(receive.getActualTCPForce()[2] - 10) < 0.05)
    assert control.moveL(robot.shifted(0.05), 0.1, 0.5)  # along the table
    assert abs(receive.getActualTCPForce()[2] - 10) < 0.5
    assert control.forceModeStop() and robot.faults.state().program


@case(CONTROL, "zeroFtSensor setPayload setTargetPayload setGravity")
def payloads(robot: Robot) -> None:
    control, receive, centre = robot.control, robot.receive, [0.01, 0.02, 0.05]
    robot.faults.payload_mismatch(0.5, centre)

    def feels(force: float) -> None:
        robot.until(lambda: abs(receive.getActualTCPForce()[2] - force) < 1e-6)

    feels(-0.5 * GRAVITY)
    assert control.setPayload(0.5, centre)
    feels(0.0)
    assert np.abs(receive.getActualTCPForce()).max() < 1e-9
    assert control.setTargetPayload(0.7, centre, [1, 2, 3, 4, 5, 6])
    feels(0.2 * GRAVITY)
    assert receive.getPayload() == 0.7 and receive.getPayloadInertia() == [1, 2, 3, 4, 5, 6]
    assert receive.getPayloadCog() == centre
    assert control.zeroFtSensor()
    feels(0.0)
    assert control.setGravity([0, 0, 0])
    feels(-0.7 * GRAVITY)


@case(CONTROL, "moveUntilContact startContactDetection readContactDetection stopContactDetection")
def contact(robot: Robot) -> None:
    control, top = robot.control, robot.receive.getActualTCPPose()[2] - 0.02
    robot.faults.wall(top, 5000.0)
    assert control.moveUntilContact([0, 0, -0.05, 0, 0, 0])
    assert abs(robot.rest()[2] - top) < 1e-3
    assert control.moveL(robot.shifted(0, 0, 0.03), 0.25, 1.0)
    assert control.moveL(robot.shifted(0, 0, -0.1), 0.05, 0.5, True)
    control.startContactDetection([0, 0, -1, 0, 0, 0])
    assert not control.readContactDetection()
    # It rests beyond the contact for a moment, then goes back. A client that asks meanwhile keeps the script from that.
    robot.until(lambda: abs(robot.rest()[2] - top) < 0.5e-3)
    assert control.readContactDetection() and control.stopContactDetection()


@case(CONTROL, "freedriveMode endFreedriveMode getFreedriveStatus teachMode endTeachMode")
def freedrive(robot: Robot) -> None:
    control = robot.control
    for begin, arguments, end in (
        (control.freedriveMode, ([1, 0, 0, 0, 0, 0],), control.endFreedriveMode),
        (control.teachMode, (), control.endTeachMode),
    ):
        begun = robot.rest()
        assert begin(*arguments) and control.getFreedriveStatus() == 0
        robot.faults.wrench([5, 0, 0, 0, 0, 0])
        robot.until(lambda begun=begun: robot.receive.getActualTCPPose()[0] > begun[0] + 0.005)
        robot.faults.wrench([0] * 6)
        assert end()
        robot.rest()


@case(CONTROL, "triggerProtectiveStop")
def protective_stop(robot: Robot) -> None:
    robot.control.triggerProtectiveStop()  # False: the stop ends the program that should answer
    robot.until(lambda: bool(robot.receive.isProtectiveStopped()))


@case(CONTROL, "")
def stopped_on_its_way(robot: Robot) -> None:
    """A move that is broken off is False, and so is the next, until the stop is unlocked and the script is back."""
    control, goal = robot.control, robot.shifted(0, 0, -0.2)
    stop = threading.Timer(0.5, robot.faults.protective_stop)
    stop.start()
    assert not control.moveL(goal, 0.02, 0.5)
    stop.join()
    assert not control.moveL(goal, 0.02, 0.5)
    robot.dashboard.unlockProtectiveStop()
    assert control.reuploadScript()
    robot.until(lambda: bool(control.isProgramRunning()))
    time.sleep(0.1)
    assert control.moveL(robot.receive.getActualTCPPose(), 0.1, 0.5)
