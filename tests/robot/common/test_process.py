"""Child processes and the messages between them and their parent: what goes over, how it fails, what is left."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from robot.common import process
from robot.common.process import MAX_ARRAY, Child, read_message, write_message
from robot.errors import DeviceError
from tests.robot.waiting import PATIENCE, alive, until

ROOT = Path(__file__).resolve().parents[3]


# -- messages --------------------------------------------------------------------------------------------------------


def message(said: dict[str, object], arrays: dict[str, np.ndarray] | None = None) -> bytes:
    pipe = io.BytesIO()
    write_message(pipe, said, arrays)
    return pipe.getvalue()


def test_message_round_trip_is_equal() -> None:
    arrays = {
        "image": np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
        "turned": np.arange(6.0).reshape(2, 3).T,  # not contiguous
        "none": np.zeros((0, 3), np.float32),
    }
    pipe = io.BytesIO(message({"do": "move", "x": [1, 2.5]}, arrays) + message({"second": True}))
    found = read_message(pipe)
    assert found is not None
    said, back = found
    assert said == {"do": "move", "x": [1, 2.5]}
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)
    assert read_message(pipe) == ({"second": True}, {})
    assert read_message(pipe) is None


def test_read_message_truncated_input_returns_none() -> None:
    whole = message({"do": "move"}, {"a": np.ones(5)})
    assert all(read_message(io.BytesIO(whole[:length])) is None for length in range(len(whole)))
    assert read_message(io.BytesIO(whole)) is not None


@pytest.mark.parametrize(
    "line",
    [
        b'{"arrays": [["a", "|u1", [%d]]]}' % (MAX_ARRAY + 1),  # nothing of that size is read
        b'{"arrays": [["a", "|u1", [-1]]]}',
        b'{"arrays": [["a", "no such type", [2]]]}',
        b'{"arrays": [["a", "|O", [1]]]}',
        b'{"arrays": [["a"]]}',
        b"\xff\xfe",
        b"[1, 2",
        b"[1, 2]",
        b" " * process.MAX_LINE,
    ],
)
def test_read_message_invalid_input_raises_value_error(line: bytes) -> None:
    with pytest.raises(ValueError):
        read_message(io.BytesIO(line + b"\n" + bytes(16)))


# -- children --------------------------------------------------------------------------------------------------------

STAND_IN = """
import os, signal, sys, time
from robot.common.process import Parent
parent = Parent()
parent.send({"ready": True})
def answer(request, arrays):
    act()
    return {"echo": request}, arrays
parent.serve(answer)
"""


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Child]:
    """Starts a child that does `act` at each request, and then sends it back."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def start(act: str = "pass", stand_in: str = STAND_IN) -> Child:
        (tmp_path / "stand_in.py").write_text(stand_in.replace("act()", act))
        return Child("stand_in", name="stand-in", error=DeviceError, advice="start another")

    return start


def test_child_answers_until_close_and_leaves_no_process(child: Callable[[str], Child]) -> None:
    with child("print('words that are no message')") as running:
        assert running.receive(PATIENCE) == ({"ready": True}, {})
        answer, arrays = running.request({"x": 1}, {"a": np.arange(3)}, timeout=PATIENCE)
        assert answer == {"echo": {"x": 1}} and arrays["a"].tolist() == [0, 1, 2]
        assert os.getsid(running.pid) != os.getsid(0)  # Ctrl-C in a terminal does not reach it
        running.check()
    assert not running.running and not alive(running.pid)
    running.close()
    with pytest.raises(DeviceError, match="stand-in is closed; start another"):
        running.request({}, timeout=PATIENCE)


@pytest.mark.parametrize(
    ("act", "words"),
    [
        ("raise ValueError('so and so')", "^stand-in: ValueError: so and so$"),
        ("print('last words', flush=True); os._exit(7)", "(?s)has ended, exit status 7; start another.*last words"),
        ("parent._answers.write(b'x' * 8 + b'\\n'); parent._answers.flush()", "sent an invalid message"),
        ("parent._answers.close(); time.sleep(600)", "has ended, exit status None"),  # closed its end, but lives on
    ],
)
def test_child_failure_raises_error_in_parent(child: Callable[[str], Child], act: str, words: str) -> None:
    with child(act) as running:
        running.receive(PATIENCE)
        with pytest.raises(DeviceError, match=words):
            running.request({}, timeout=PATIENCE)
    assert not alive(running.pid)


LAST = """
import os, signal
from robot.common.process import Parent
parent = Parent()
parent.send({"ready": True})
print("one", flush=True)
print("two", flush=True)
act()
"""


@pytest.mark.parametrize(
    ("act", "words"),
    [("os._exit(7)", "exit status 7: two"), ("os.kill(os.getpid(), signal.SIGSEGV)", "killed by SIGSEGV: two")],
)
def test_exit_report_contains_status_and_last_line(child: Callable[..., Child], act: str, words: str) -> None:
    with child(act, LAST) as running:
        running.receive(PATIENCE)
        until(lambda: not running.running, "end of the child")
        assert running.exit_report == words
        with pytest.raises(DeviceError, match=f"has ended, {words.partition(':')[0]}; start another"):
            running.check()
    assert running.exit_report == ""


def test_child_that_does_not_start_raises_error_with_reason(child: Callable[..., Child]) -> None:
    why = r"(?s)exit status 1.*No module named 'no_such_module'"
    with child(stand_in="import no_such_module") as running, pytest.raises(DeviceError, match=why):
        running.receive(PATIENCE)


@pytest.mark.parametrize("size", [0, 2**20])  # more than a pipe holds: the request itself is stuck
def test_silent_child_is_killed(child: Callable[[str], Child], size: int) -> None:
    with child("pass") as running:
        running.receive(PATIENCE)
        os.kill(running.pid, signal.SIGSTOP)
        with pytest.raises(DeviceError, match=r"gave no answer within 0\.2 s"):
            running.request({}, {"a": np.zeros(size)}, timeout=0.2)
        assert not alive(running.pid)


def test_stopped_child_is_killed_by_close(child: Callable[[str], Child]) -> None:
    running = child("pass")
    running.receive(PATIENCE)
    os.kill(running.pid, signal.SIGSTOP)
    running.close(0.1)
    assert not alive(running.pid)


def test_interrupted_request_answer_is_not_reused(child: Callable[[str], Child]) -> None:
    with child("os.kill(os.getppid(), signal.SIGINT); time.sleep(1)") as running:
        running.receive(PATIENCE)
        with pytest.raises(KeyboardInterrupt):
            running.request({"old": True}, timeout=PATIENCE)
        with pytest.raises(DeviceError, match="is closed"):
            running.request({"new": True}, timeout=PATIENCE)


def test_close_during_request_of_other_thread_succeeds(child: Callable[[str], Child]) -> None:
    running = child("time.sleep(600)")
    running.receive(PATIENCE)
    failures: list[str] = []

    def ask() -> None:
        try:
            running.request({}, timeout=PATIENCE)
        except DeviceError as failure:
            failures.append(str(failure))

    waiting = threading.Thread(target=ask)
    waiting.start()

    def asks() -> bool:
        free = running._lock.acquire(blocking=False)
        if free:
            running._lock.release()
        return not free

    until(asks, "it asks")
    running.close(0.1)
    waiting.join(PATIENCE)
    assert len(failures) == 1 and not alive(running.pid)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_signal_to_process_group_reaches_parent_only(child: Callable[..., Child], number: signal.Signals) -> None:
    """A lost terminal, `systemctl stop`, Ctrl-C; also before the child has come to set anything up."""
    early = f"import os, time\nos.kill(os.getpid(), {int(number)})\ntime.sleep(0.05)\n"
    with child(stand_in=early + STAND_IN.replace("act()", "pass")) as running:
        assert running.receive(PATIENCE)[0] == {"ready": True}
        os.kill(running.pid, number)
        assert running.request({"x": 1}, timeout=PATIENCE)[0] == {"echo": {"x": 1}}
    assert running.exit_status == 0
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == set()  # here they come as before


WAITING = """
import os, sys, time
from robot.common.process import Child, write_message
child = Child("stand_in", name="stand-in")
child.receive(60.0)
again = os.fork() if sys.argv[1] == "forked" else 1  # as multiprocessing does: a copy of the pipe stays open
if sys.argv[1] == "busy":
    write_message(child._process.stdin, {})
if again:
    print(child.pid, again, flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize(
    ("end", "state"),
    [(signal.SIGKILL, "waits"), (signal.SIGTERM, "waits"), (signal.SIGHUP, "busy"), (signal.SIGKILL, "forked")],
)
def test_child_ends_with_its_parent(tmp_path: Path, end: signal.Signals, state: str) -> None:
    late = STAND_IN.replace("parent.serve", "time.sleep(0.2)\nparent.serve")  # by then its parent is gone
    (tmp_path / "stand_in.py").write_text(late.replace("act()", "time.sleep(600)"))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    words = [sys.executable, "-c", WAITING, state]
    with subprocess.Popen(words, stdout=subprocess.PIPE, env=environment) as parent:
        assert parent.stdout is not None
        pid, copy = map(int, parent.stdout.readline().split())
        assert alive(pid)
        parent.send_signal(end)
        parent.wait()
        try:
            until(lambda: not alive(pid), "the end of the child")
        finally:
            if copy > 1:
                os.kill(copy, signal.SIGKILL)


def test_parent_monitor_detects_exiting_parent_early(monkeypatch: pytest.MonkeyPatch) -> None:
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as parent:
        monkeypatch.setattr(os, "getppid", lambda: parent.pid)  # as long as nobody has waited for it
        monitor = process.ParentMonitor(parent.pid)
        assert not monitor.is_parent_gone()
        parent.kill()
        until(monitor.is_parent_gone, "its end")
        assert parent.returncode is None  # it has an entry still, as while it gives its memory back
    assert monitor.is_parent_gone()


def test_parent_monitor_without_proc_uses_parent_id(monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = process.ParentMonitor(2**22 + 1)  # beyond the largest process id
    assert monitor.is_parent_gone()
    monkeypatch.setattr(os, "getppid", lambda: 2**22 + 1)
    assert not monitor.is_parent_gone()
