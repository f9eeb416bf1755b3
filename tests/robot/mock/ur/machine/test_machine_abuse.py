"""Numbers and programs that no arm can follow: the program stops and says why, the robot stays usable."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot.mock.ur.machine.machine import Machine
from robot.mock.ur.machine.state import Safety
from tests.robot.mock.machine_bench import DOWN, Bench
from tests.robot.mock.wire_client import control_script


def usable(machine: Machine) -> None:
    """A new program runs, and every number that is sent is one."""
    machine.recover()
    machine.in_int[0] = 0
    for _ in range(2000):
        machine.tick()
    assert machine.start(control_script())
    machine.tick()
    assert machine.program is not None and machine.out_int[0] == 1
    arm = machine.arm
    assert all(np.isfinite(values).all() for values in (arm.q, arm.qd, arm.pose, arm.twist, machine.raw_wrench))


@pytest.mark.parametrize(
    ("command", "doubles", "integers"),
    [
        (29, [1e160] * 6, []),  # setTcp
        (3, [1e200] * 6 + [0.1, 0.5], []),  # moveL
        (1, [1e200] * 6 + [0.1, 0.5], []),  # moveJ
        (4, [1e300] * 6 + [0.1, 0.5], []),  # moveL_FK
        (46, [1e300] * 6, []),  # getInverseKinematics
        (39, [1e300] * 12, []),  # poseTrans
        (44, [1e300] * 12, []),  # getForwardKinematics
        (9, [1e300] * 6 + [1e300, 0], []),  # speedJ
        (10, [1e300] * 6 + [1e300, 0], []),  # speedL
        (6, [1e300] * 18, [2, 1, 1, 1, 1, 1, 1]),  # forceMode
        (41, [1e300] * 6 + [0, 1e300, *[0] * 6], []),  # jogStart
        (17, [1e5, 0, 0, 0], []),  # setPayload
        (17, [1.0, 0, 0, 1e5], []),
        (59, [0, 0, 1e5], []),  # setGravity
        (51, [*DOWN, 0, 0, 0, 0, 0, 1e300, 1e300], []),  # moveUntilContact
    ],
)
def test_too_large_numbers_end_program(bench: Bench, command: int, doubles: list[float], integers: list[int]) -> None:
    bench.call(command, doubles, integers)
    bench.tick(50)
    assert bench.machine.program is None and "Error" not in bench.machine.stop_reason
    assert bench.machine.stop_reason
    usable(bench.machine)


@pytest.mark.parametrize(
    ("command", "doubles"),
    [
        (1, [3.0, -1.0, 1.0, -1.0, -1.0, 0.0, 1e6, 1e6]),
        (3, [*DOWN, 1e6, 1e6]),
        (9, [1e5] * 6 + [1e5, 0]),
        (10, [1e5] * 6 + [1e5, 0]),
    ],
)
def test_motion_beyond_joint_speed_is_not_started(bench: Bench, command: int, doubles: list[float]) -> None:
    begun, top = bench.arm.q.copy(), bench.arm.kinematics.joint_speeds
    bench.call(command, doubles)
    for _ in range(100):
        bench.tick()
        assert (np.abs(bench.arm.qd) <= 1.01 * top).all()
    assert bench.machine.safety is Safety.PROTECTIVE_STOP and "too fast" in bench.machine.stop_reason
    assert np.abs(bench.arm.q - begun).max() < 0.1
    usable(bench.machine)


@pytest.mark.slow
def test_arm_at_end_of_range_can_move_back(bench: Bench) -> None:
    begun = bench.arm.q.copy()
    bench.call(9, [0, 0, 0, 0, 0, 3.0, 10.0, 0])
    bench.until(lambda: bench.machine.safety is Safety.PROTECTIVE_STOP and bench.arm.rests)
    assert bench.arm.q[5] > 2 * math.pi
    usable(bench.machine)
    bench.call(1, [*begun, 1.0, 1.0])
    assert bench.machine.safety is Safety.NORMAL
    np.testing.assert_allclose(bench.arm.target_q, begun)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("movej([0.1,0.2,0.3],a=1,v=1,r=0)", "six numbers"),
        ("movel(p[0.1,0.2,0.3],a=1,v=1,r=0)", "six numbers"),
        ("movel(p[a,b,c,d,e,f],a=1,v=1,r=0)", "six numbers"),
        ("movel(p[1,2,3,4,5,6],a=fast,v=1,r=0)", "six numbers"),
        ("movej([nan,0,0,0,0,0],a=1,v=1,r=0)", "six numbers"),
        ("movej([1e999,0,0,0,0,0],a=1,v=1,r=0)", "six numbers"),
        ("signal_async_progress(" + "9" * 5000 + ")", "does not know"),
        ("movec(p[0,0,0,0,0,0])", "does not know"),
    ],
)
def test_invalid_paths_end_program(line: str, words: str) -> None:
    bench = Bench(control_script(path=[line]))
    bench.call(45, [], [0])
    assert bench.machine.program is None and words in bench.machine.stop_reason
    assert len(bench.machine.stop_reason) < 300
    usable(bench.machine)


@pytest.mark.parametrize("offset", ["25", "47", "9999", "9" * 5000])
def test_too_large_register_offset_is_refused(offset: str) -> None:
    machine = Machine()
    text = control_script().replace("register offset\n0", f"register offset\n{offset}")
    assert not machine.start(text)
    assert "register offset" in machine.stop_reason and len(machine.stop_reason) < 300
    usable(machine)


@pytest.mark.parametrize(
    "text",
    [
        "\n" * 300_000 + "end",
        "$" * 300_000 + "\nend",
        "def rtde_control():\n" + "# inject move path\n" * 20_000 + "\n" * 100_000 + "\nend",
        "def rtde_control():\n  $" + "9" * 5000 + " x\nend",
        "def mine():\n" + "textmsg(1)\n" * 90_000 + "end",
        "def mine():\n" + "\n" * 300_000 + "x\nend",
    ],
    ids=["blank", "dollars", "paths", "version", "calls", "blank lines"],
)
def test_long_or_odd_programs_are_parsed_fast(text: str) -> None:
    """Without a bound these took minutes or raised; pytest's time-out of a test ends it then."""
    machine = Machine()
    machine.start(text)
    if machine.program is not None:
        machine.tick()
        machine.in_int[0] = 45
    machine.tick()
    usable(machine)


def test_mock_error_ends_program(bench: Bench, capfd: pytest.CaptureFixture[str]) -> None:
    def broken() -> None:
        raise ZeroDivisionError("of the test")

    assert bench.machine.program is not None
    bench.machine.program.step = broken  # type: ignore[method-assign]
    bench.tick()
    assert bench.machine.program is None and "ZeroDivisionError: of the test" in bench.machine.stop_reason
    assert "Traceback" in capfd.readouterr().err  # for who mends the mock
    usable(bench.machine)


def test_uncomputable_arm_is_in_fault(bench: Bench) -> None:
    begun = bench.arm.q.copy()
    bench.arm.q = np.full(6, math.inf)
    bench.tick()
    assert bench.machine.safety is Safety.FAULT and bench.machine.program is None
    np.testing.assert_allclose(bench.machine.arm.q, begun)
    assert not bench.machine.start(control_script())
    usable(bench.machine)
