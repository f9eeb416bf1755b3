"""Programs of a user: lists of calls are done, all others refused with the line, as by a compiler."""

from __future__ import annotations

import math
import struct
from socket import create_connection

import numpy as np
import pytest

from robot.mock import MockUR
from robot.mock.ur.machine.arm import HOME, PERIOD
from robot.mock.ur.machine.load import Mass
from robot.mock.ur.wire import primary
from tests.robot.mock.machine_bench import Bench
from tests.robot.mock.wire_client import TIMEOUT


def program(*lines: str) -> str:
    return "\n".join(["def mine():", *(f"\t{line}" for line in lines), "end", ""])


def test_calls_are_done_in_their_order(bench: Bench) -> None:
    joints = [angle + 0.1 for angle in HOME]
    begun = bench.machine.ticks
    assert bench.machine.start(
        program(
            "write_output_integer_register(0 +12, 1)",
            f"movej({joints}, a=1.4, v=1.05)  # leading joint 0.1 rad",
            "set_tool_digital_out(1, True)",
            "set_tcp(p[0, 0, 0.1, 0, 0, 0])",
            "set_payload(0.5, [0, 0, 0.05])",
            'textmsg("done: ", 3)',
            "sleep(0.5)",
            "write_output_float_register(13, -2.5)",
            "write_output_integer_register(0 +12, 2)",
        )
    )
    bench.tick()
    assert bench.machine.out_int[12] == 1
    bench.until(lambda: bench.machine.program is None)
    took = (bench.machine.ticks - begun) * PERIOD
    assert took == pytest.approx(2 * math.sqrt(0.1 / 1.4) + 0.5, abs=5 * PERIOD)
    np.testing.assert_allclose(bench.arm.target_q, joints, atol=1e-12)
    assert bench.machine.outputs.digital == 1 << 17 and bench.arm.tool[2, 3] == 0.1
    assert bench.machine.load.told == Mass(0.5, (0, 0, 0.05))
    assert bench.machine.out_double[13] == -2.5 and bench.machine.out_int[12] == 2
    assert any("done: 3" in text for _, text in bench.machine.log) and "come to its end" in bench.machine.stop_reason


@pytest.mark.parametrize(
    "line",
    [
        "x = 3",
        "while True:",
        "movec(p[0,0,0,0,0,0], p[0,0,0,0,0,0])",
        "movej(get_inverse_kin(p[0,0,0,0,0,0]))",
        "movej([0,0,0,0,0,1e999])",
        "sleep(9**9**9)",
        "sleep(" + "(" * 500 + "1" + ")" * 500 + ")",
        "textmsg(" + "-" * 990 + "1)",
        "__import__('os').system('true')",
        "textmsg(open('/etc/passwd'))",
        "movej(",
        "\0",
    ],
)
def test_a_line_that_is_no_such_call_is_refused_before_anything_is_done(bench: Bench, line: str) -> None:
    bench.call(10, [0.05, 0, 0, 0, 0, 0, 0.5, 0])
    assert not bench.machine.start(program("set_tool_digital_out(0, True)", line))
    assert bench.machine.program is None and "line 3" in bench.machine.stop_reason
    bench.until(lambda: bench.arm.rests)
    assert bench.machine.outputs.digital == 0
    assert "compile_error:line 3" in bench.machine.script_errors[-1]


@pytest.mark.parametrize(
    "line",
    [
        "movej([0,0,0])",
        "movej(p[5,0,0,0,0,0])",
        "movej(3)",
        "movej()",
        "set_tool_digital_out(7, True)",
        "write_output_integer_register(48, 1)",
        "set_payload(-1)",
        "sleep('long')",
        "stopl(0)",
        "movel(p[-0.4,-0.2,0.3,0,3.14,0], a=0)",
    ],
)
def test_numbers_that_make_no_sense_end_the_program(bench: Bench, line: str) -> None:
    assert bench.machine.start(program(line))
    bench.until(lambda: bench.machine.program is None)
    assert bench.machine.script_errors[-1].startswith("runtime_error:")


def test_who_listens_to_the_primary_interface_is_told(mock: MockUR) -> None:
    with create_connection((mock.host, 30001), TIMEOUT) as listener, create_connection((mock.host, 30003)) as line:
        listener.settimeout(TIMEOUT)
        mock.faults.state()  # both are accepted
        line.sendall(program("socket_open(1)").encode())
        data = b""
        while len(data) < 4 or len(data) < struct.unpack_from(">i", data)[0]:
            data += listener.recv(4096)
    kind, _, _, what = struct.unpack_from(">BQBB", data, 4)
    assert (kind, what) == (primary.ROBOT_MESSAGE, primary.RUNTIME_EXCEPTION)
    assert b"compile_error:line 2: 'socket_open(1)'" in data
    assert "socket_open" in mock.faults.state().stop_reason
