"""Child processes of this program (`python -m MODULE`), and the messages between them and their parent.

A message is one line of JSON. Arrays follow it as bytes: the key "arrays" of the line gives name, type and shape of
each. A message with the key "error" gives the reason why the child could not handle a request; with "kind", a class of
robot.errors, it is the complete text of that error.

A child ends when its standard input ends or its parent is gone, so it never outlives the parent. Only the parent gets
the signals that end a program (Ctrl-C, SIGTERM, a lost terminal); it ends its children in order. The processes of a
pool (robot.common.process_pool) behave in the same way.

Children are not started by multiprocessing: its spawn runs the main module of the user's program again, so a script
without `if __name__ == "__main__"` could not open an arm.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from robot import errors
from robot.common import Closing
from robot.errors import DeviceError, DeviceNotConnectedError

Arrays = Mapping[str, NDArray[Any]]
Message = tuple[dict[str, Any], Arrays]  # the JSON object, and its arrays

MAX_ARRAY = 256 * 2**20  # of an array [bytes]
MAX_LINE = 2**20  # of a line [bytes]
END_TIMEOUT = 1.0  # from a request to end until a child is killed [s]
PARENT = "TACSIM_PARENT"  # environment variable of a child: its parent's process id at the start
END_SIGNALS = {getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)}


@contextlib.contextmanager
def blocking_signals() -> Iterator[None]:
    """Processes that this thread starts in the block never get the signals that end a program: the code that starts
    them must end them. (Children inherit the blocked signals of a thread when they start; ignoring a signal would
    affect all threads.)
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, END_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Child(Closing):
    """A process `python -m module`; base of the handles of mocks. A context manager; several threads may use it.

    Args:
        name: of the process, in errors.
        error: the class of all errors that are raised.
        advice: what to do after the process has ended, in errors.
        environment: variables in addition to the parent's.
        ready_timeout: time to wait for the child's first message [s], which is then in `ready`; None: do not wait.
            Raises `error` as `receive` does, and ends the process.
        first_request: is sent before that message is read.
        descriptors: file descriptors of this process that the child inherits, with the same numbers.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str] = (),
        *,
        name: str,
        error: type[DeviceError] = DeviceNotConnectedError,
        advice: str = "start another",
        environment: Mapping[str, str] | None = None,
        ready_timeout: float | None = None,
        first_request: dict[str, Any] | None = None,
        descriptors: Sequence[int] = (),
    ) -> None:
        self._name, self._error, self._advice = name, error, advice
        self._lock = threading.RLock()
        self._closed = False
        root = str(Path(__file__).resolve().parents[2])
        # An empty entry is the working folder, whose socket.py or random.py would be executed.
        path = os.pathsep.join(filter(None, [root, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]))
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the process
        with blocking_signals():
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                start_new_session=True,
                env={**os.environ, **(environment or {}), "PYTHONPATH": path, PARENT: str(os.getpid())},
                pass_fds=descriptors,
            )
        self.pid = self._process.pid
        self.ready: dict[str, Any] = {}
        if ready_timeout is not None:
            try:
                self.ready, _ = self._exchange(first_request, {}, ready_timeout)
            except BaseException:
                self.close(0.0)
                raise

    @property
    def exit_status(self) -> int | None:
        """Exit status of the process; None while it runs."""
        return self._process.poll()

    @property
    def running(self) -> bool:
        """False once the process has ended."""
        return self.exit_status is None

    @property
    def exit_report(self) -> str:
        """How the process ended, and the last line of its standard error: "killed by SIGSEGV: ..."; "" while it runs
        and after `close`."""
        if self._closed or self.running:
            return ""
        return ": ".join([self._describe_end(), *self._last_lines(1)])

    @property
    def printed(self) -> str:
        """Standard error of the process until now; empty after `close`."""
        with contextlib.suppress(ValueError):  # it is closed
            self._errors.seek(0)
            return self._errors.read().decode(errors="replace")
        return ""

    def check(self) -> None:
        """Raises `error` if the process has ended."""
        if not self.running:
            raise self._make_error(f"has ended, {self._describe_end()}")

    def wait(self, timeout: float) -> bool:
        """Waits for the end of the process, for `timeout` [s]; returns whether it has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout)
        return not self.running

    def receive(self, timeout: float) -> Message:
        """The child's next message; its first message reports that it is ready.

        Raises `error` if the child reports an error, has ended, or sends nothing within `timeout` [s] (then it is
        killed).
        """
        return self._exchange(None, {}, timeout)

    def request(self, request: dict[str, Any], arrays: Arrays | None = None, *, timeout: float) -> Message:
        """Sends a request and returns the answer. Raises `error` as `receive` does."""
        return self._exchange(request, arrays or {}, timeout)

    def close(self, timeout: float = END_TIMEOUT) -> None:
        """Ends the process, by force after `timeout` [s]; a second call does nothing."""
        if not self._lock.acquire(timeout=timeout):  # another thread waits for an answer
            self._process.kill()
            self._lock.acquire()
        try:
            for pipe in (self._process.stdin, self._process.stdout):
                assert pipe is not None
                with contextlib.suppress(OSError):  # the process has ended already
                    pipe.close()
            try:
                self._process.wait(timeout)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._closed = True
            self._errors.close()
        finally:
            self._lock.release()

    def _exchange(self, request: dict[str, Any] | None, arrays: Arrays, timeout: float) -> Message:
        with self._lock:
            if self._closed:
                raise self._error(f"{self._name} is closed; {self._advice}")
            stdin, stdout = self._process.stdin, self._process.stdout
            assert stdin is not None and stdout is not None
            deadline = time.monotonic() + timeout
            watchdog = threading.Timer(timeout, self._process.kill)  # also ends a write that a stopped child blocks
            watchdog.daemon = True
            watchdog.start()
            try:
                if request is not None:
                    write_message(stdin, request, arrays)
                answer = read_message(stdout)
                if answer is None:
                    raise EOFError
            except (OSError, EOFError) as failure:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(END_TIMEOUT)
                late = time.monotonic() >= deadline
                reason = f"gave no answer within {timeout:g} s" if late else f"has ended, {self._describe_end()}"
                raise self._end_with_error(reason) from failure
            except ValueError as failure:
                raise self._end_with_error(f"sent an invalid message: {failure}") from failure
            except BaseException:  # Ctrl-C: a late answer must not be read as the answer to the next request
                self.close(0.0)
                raise
            finally:
                watchdog.cancel()
        if "kind" in answer[0]:
            raise getattr(errors, answer[0]["kind"])(answer[0]["error"])
        if "error" in answer[0]:
            raise self._error(f"{self._name}: {answer[0]['error']}")
        return answer

    def _end_with_error(self, what: str) -> DeviceError:
        """Ends the process and returns the error to raise."""
        failure = self._make_error(what)
        self.close(0.0)
        return failure

    def _make_error(self, what: str) -> DeviceError:
        line_count = 5  # lines of an ended child's standard error, in errors
        text = f"{self._name} (process {self.pid}) {what}; {self._advice}"
        return self._error(text + "".join(f"\n  {line}" for line in self._last_lines(line_count)))

    def _describe_end(self) -> str:
        """How the process ended."""
        status = self._process.returncode
        return (
            f"killed by {signal.Signals(-status).name}"
            if status is not None and status < 0
            else f"exit status {status}"
        )

    def _last_lines(self, number: int) -> list[str]:
        """The last lines of its standard error, at most `number`."""
        return self.printed.strip().splitlines()[-number:]


class Parent:
    """The parent, as seen by a child: messages go to standard output; everything else that is printed goes to standard
    error."""

    def __init__(self) -> None:
        self._answers = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)

    def receive(self) -> dict[str, Any]:
        """The parent's next message. Raises EOFError when there is none."""
        message = read_message(sys.stdin.buffer)
        if message is None:
            raise EOFError("the parent has closed the pipe")
        return message[0]

    def send(self, message: dict[str, Any], arrays: Arrays | None = None) -> None:
        write_message(self._answers, message, arrays)

    def serve(self, answer: Callable[[dict[str, Any], Arrays], Message]) -> None:
        """Answers requests until standard input ends. An exception of `answer` is sent to the parent as an error.

        When the parent is gone, the process ends, also during an answer, and also if a fork of the parent keeps the
        other end of standard input open.
        """
        end_with_parent(int(os.environ[PARENT]))
        while True:
            try:
                request = read_message(sys.stdin.buffer)
                if request is None:
                    return
                self.send(*answer(*request))
            except Exception as failure:
                self.send({"error": f"{type(failure).__name__}: {failure}"})


class ParentMonitor:
    """Checks in a child whether its parent (process id) still runs.

    A killed process first releases its memory, which takes 50 ms per gigabyte and four times as long on a busy machine.
    Only then do its children get another parent. Linux shows earlier that it exits: proc_pid_stat(5).
    """

    def __init__(self, parent: int) -> None:
        self._parent = parent
        self._status: int | None = None
        with contextlib.suppress(OSError):  # no /proc: only the child's parent is checked
            self._status = os.open(f"/proc/{parent}/stat", os.O_RDONLY)

    def is_parent_gone(self) -> bool:
        """True if the parent has ended or is exiting. Takes 8 us."""
        exiting_flag = 0x4  # of a process's flags in Linux: PF_EXITING
        if os.getppid() != self._parent:
            return True
        if self._status is None:
            return False
        try:
            fields = os.pread(self._status, 1024, 0)
        except ProcessLookupError:
            return True
        flags = fields[fields.rindex(b")") :].split()[7]  # the name before it may contain any character
        return bool(int(flags) & exiting_flag)


def end_with_parent(parent: int) -> None:
    """Makes this process end at most 0.2 s after its parent (process id)."""
    check_interval = 0.2  # between two checks of the parent [s]
    monitor = ParentMonitor(parent)

    def watch() -> None:
        while not monitor.is_parent_gone():
            time.sleep(check_interval)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


@contextlib.contextmanager
def without_working_folder() -> Iterator[None]:
    """Python processes that are started in the block do not execute a random.py or socket.py of the working folder.
    Processes of multiprocessing search that folder first until they get the path of their parent."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def write_message(pipe: IO[bytes], message: dict[str, Any], arrays: Arrays | None = None) -> None:
    if arrays:
        message = {**message, "arrays": [[name, array.dtype.str, array.shape] for name, array in arrays.items()]}
    pipe.write(json.dumps(message).encode() + b"\n")
    for array in (arrays or {}).values():
        pipe.write(array.tobytes())
    pipe.flush()


def read_message(pipe: IO[bytes]) -> Message | None:
    """The next message; None at the end of the pipe, also within a message. Raises ValueError for bytes that are no
    message."""
    line = pipe.readline(MAX_LINE)
    if not line.endswith(b"\n") and len(line) < MAX_LINE:
        return None
    message = json.loads(line)
    if not isinstance(message, dict):
        raise ValueError(f"{line[:80]!r}")
    arrays = {}
    for name, kind, shape in message.pop("arrays", ()):
        try:
            dtype = np.dtype(kind)
        except TypeError as failure:
            raise ValueError(str(failure)) from failure
        size = int(np.prod(shape)) * dtype.itemsize
        if not 0 <= size <= MAX_ARRAY:
            raise ValueError(f"array '{name}' of {size} bytes; the limit is {MAX_ARRAY}")
        data = pipe.read(size)
        if len(data) < size:
            return None
        arrays[name] = np.frombuffer(data, dtype).reshape(shape)
    return message, arrays
