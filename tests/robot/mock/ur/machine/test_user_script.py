"""Programs of a user: lists of calls are done, all others refused with the line, as by a compiler."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
from pathlib import Path
from socket import create_connection

import numpy as np
import pytest

from robot.mock import MockUR
from robot.mock.ur import messages
from robot.mock.ur.machine.arm import HOME, PERIOD
from robot.mock.ur.machine.forces import Mass
from tests.robot.mock.machine_bench import Bench
from tests.robot.mock.wire_client import TIMEOUT


def program(*lines: str) -> str:
    return "\n".join(["def mine():", *(f"\t{line}" for line in lines), "end", ""])


def test_user_script_calls_run_in_order(bench: Bench) -> None:
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
    assert bench.machine.load.configured_payload == Mass(0.5, (0, 0, 0.05))
    assert bench.machine.out_double[13] == -2.5 and bench.machine.out_int[12] == 2
    assert any("done: 3" in text for _, text in bench.machine.log) and "it has ended" in bench.machine.stop_reason


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
def test_user_script_invalid_line_is_refused_before_start(bench: Bench, line: str) -> None:
    bench.call(10, [0.05, 0, 0, 0, 0, 0, 0.5, 0])
    assert not bench.machine.start(program("set_tool_digital_out(0, True)", line))
    assert bench.machine.program is None and "line 3;" in bench.machine.stop_reason
    bench.until(lambda: bench.arm.rests)
    assert bench.machine.outputs.digital == 0
    error = bench.machine.script_errors[-1]
    kind = "compile_error_name_not_found:movec:" if line.startswith("movec") else "syntax_error_on_line:3:\t"
    assert error.text.startswith(kind) and (error.line, error.column) == (3, 2) and error.users


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
def test_user_script_invalid_numbers_end_program(bench: Bench, line: str) -> None:
    assert bench.machine.start(program(line))
    bench.until(lambda: bench.machine.program is None)
    assert bench.machine.script_errors[-1].text.startswith("runtime_error:") and bench.machine.script_errors[-1].users


def test_primary_interface_reports_script_error(mock: MockUR) -> None:
    with create_connection((mock.host, 30001), TIMEOUT) as listener, create_connection((mock.host, 30003)) as line:
        listener.settimeout(TIMEOUT)
        mock.faults.state()  # both are accepted
        line.sendall(program("sync()", "  socket_open(1)").encode())
        data = b""
        while len(data) < 4 or len(data) < struct.unpack_from(">i", data)[0]:
            data += listener.recv(4096)
    kind, _, _, what, row, column = struct.unpack_from(">BQBBii", data, 4)
    assert (kind, what, row, column) == (messages.ROBOT_MESSAGE, messages.RUNTIME_EXCEPTION, 3, 4)
    assert b"compile_error_name_not_found:socket_open:" in data
    assert "socket_open" in mock.faults.state().stop_reason


WAITS = """
import sys
import rtde_control
control = rtde_control.RTDEControlInterface(sys.argv[1])
try:
    print(getattr(control, sys.argv[2])(*sys.argv[3:]))
except RuntimeError as error:
    print("RuntimeError:", error)
control.disconnect()
control.reconnect()
print(control.isSteady())
"""


@pytest.mark.parametrize("body", ["x = 1", "while True:\n\tsync()\nend", "if 1 > 0:\n\tsync()\nend", "movej([0,0])"])
@pytest.mark.parametrize("call", ["sendCustomScript", "sendCustomScriptFunction", "sendCustomScriptFile"])
def test_ur_rtde_does_not_wait_for_failed_program(mock: MockUR, tmp_path: Path, call: str, body: str) -> None:
    """A controller leaves it waiting for 600 s. Here the call raises, and a new connection works."""
    pytest.importorskip("rtde_control")
    given = [program(*body.splitlines())]
    if call == "sendCustomScriptFunction":
        given = ["mine", body]
    elif call == "sendCustomScriptFile":
        file = tmp_path / "mine.script"
        file.write_text(given[0], encoding="utf-8")
        given = [str(file)]
    command = [sys.executable, "-c", WAITS, mock.host, call, *given]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=True)
    assert done.stdout.startswith("RuntimeError: write: ") and done.stdout.endswith("\nTrue\n"), done


def test_client_that_reads_reports_stays_connected(mock: MockUR) -> None:
    with create_connection((mock.host, 30002), TIMEOUT) as line:
        for name in ("first_thing", "second_thing"):
            line.sendall(program(f"{name}()").encode())
            data = b""
            while name.encode() not in data:
                data += line.recv(4096)
                assert data, "the connection was closed"
