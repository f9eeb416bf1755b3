"""What a worker may not do once it is connected, tried in processes of their own."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

NO_MORE = """
import errno, os, select, socket
from robot.arm.confinement import forbid_later_connections
server = socket.create_server(("127.0.0.1", 0))
with forbid_later_connections():
    first = socket.create_connection(server.getsockname())
    second = socket.create_connection(server.getsockname())
def refused(make):
    try:
        make()
    except OSError as failure:
        return failure.errno == errno.EMFILE
makers = [socket.socket, os.pipe, select.epoll, lambda: os.dup(0), lambda: os.open(os.devnull, os.O_RDONLY)]
print(*map(refused, makers))
first.close()
print(*map(refused, makers))
second.sendall(b"x")  # open connections still work
listening = select.poll()
listening.register(second, select.POLLOUT)
print(listening.poll(1000) == [(second.fileno(), select.POLLOUT)])
"""


def test_forbid_later_connections_after_block_opens_no_descriptor() -> None:
    done = subprocess.run([sys.executable, "-c", NO_MORE], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == (f"{' '.join(['True'] * 5)}\n" * 2 + "True\n", "")


TOO_LONG = """
import signal, time
from robot.arm.confinement import TimeLimit, enable_time_limits
enable_time_limits()
limit = TimeLimit(30.0)
for _ in range(3):
    with limit:
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 0.0
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)  # no limit runs on
print("so far", flush=True)
with TimeLimit(0.2):
    {wait}
"""
WAITS = {"sleeping": "time.sleep(60)", "holding the interpreter": "import ctypes; ctypes.PyDLL(None).sleep(60)"}


@pytest.mark.parametrize("name", WAITS)
def test_time_limit_slow_block_ends_process(name: str) -> None:
    def ignore() -> None:
        signal.signal(signal.SIGALRM, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})

    code = TOO_LONG.format(wait=WAITS[name])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, preexec_fn=ignore)
    assert (done.stdout, done.stderr, done.returncode) == ("so far\n", "", -signal.SIGALRM)
