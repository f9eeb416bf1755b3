"""A rig in the Rerun viewer while it runs, or in a file for it, at no cost to the control loop: steps are handed to a
process of their own, and what that cannot take in time is left out.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import queue
import threading
from multiprocessing.connection import Connection
from pathlib import Path

from robot.common import Closing
from robot.common.process import shielded
from robot.export.rerun_log import EpisodeLog, blueprint
from robot.export.rerun_view import APPLICATION, lattices, require_rerun, shown, written
from tacsim.interface import Observation, RigSpec, Truth
from tacsim.models.rig import RigConfig
from tacsim.record.episode import Step

Seen = tuple[Step, Observation, Truth | None]

WAITING = 2  # steps that wait to be handed over; a longer line would show the past
BEGINS = 60.0  # longest wait for the viewer [s]
ENDS = 20.0  # and for the last steps [s]


class LiveView(Closing):
    """Call it with each step. It never waits, and nothing that befalls the viewer reaches the caller.

    file: (.rrd) is written instead of a viewer started; whole also when this program is killed.

    Raises ValueError without rerun-sdk, FileExistsError, OSError and RuntimeError when the viewer does not begin.
    """

    def __init__(self, spec: RigSpec, config: RigConfig, file: Path | None) -> None:
        require_rerun()
        self._line: queue.Queue[Seen | None] = queue.Queue(WAITING)
        self.left_out = 0  # steps
        self._ended = False  # the process has
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_show, args=(other, spec, config, file), name="view", daemon=True)
        with shielded():
            self._process.start()
        other.close()
        self._thread = threading.Thread(target=self._hand_over, name="view", daemon=True)
        try:
            self._await_begin()
        except BaseException:
            self._process.kill()
            raise
        self._thread.start()

    def __call__(self, step: Step, observation: Observation, truth: Truth | None) -> None:
        try:
            self._line.put_nowait((step, observation, truth))
        except queue.Full:
            self.left_out += 1

    @property
    def ended(self) -> bool:
        """The viewer, or what feeds it, has ended by itself: nothing more is shown."""
        return self._ended

    def close(self) -> None:
        """Waits for what was handed over, but not for ever. A second call does nothing."""
        with contextlib.suppress(queue.Full):
            self._line.put(None, timeout=ENDS)
        self._thread.join(ENDS)
        self._process.join(ENDS)
        if self._process.is_alive():
            self._process.kill()
        self._pipe.close()

    def _await_begin(self) -> None:
        if not self._pipe.poll(BEGINS):
            raise RuntimeError(f"the viewer did not begin within {BEGINS:g} s")
        try:
            failure = self._pipe.recv()
        except EOFError:
            raise RuntimeError("the process of the viewer ended before it began") from None
        if failure is not None:
            raise failure

    def _hand_over(self) -> None:
        while (seen := self._line.get()) is not None:
            if self._ended:
                self.left_out += 1
                continue
            try:
                send(self._pipe, seen)
            except Exception:  # whatever befalls it, it is gone
                self._ended = True
        with contextlib.suppress(OSError):
            send(self._pipe, None)


def send(pipe: Connection, seen: Seen | None) -> None:
    """Arrays go as they lie, without a copy: a copy would keep the control loop from running meanwhile."""
    arrays: list[memoryview] = []
    rest = pickle.dumps(seen, protocol=5, buffer_callback=lambda array: arrays.append(array.raw()))
    pipe.send(len(arrays))
    pipe.send_bytes(rest)
    for array in arrays:
        pipe.send_bytes(array)


def _receive(pipe: Connection) -> Seen | None:
    """What `send` sent; None at the end, which a program that is killed tells by its silence, also within a message."""
    try:
        number = pipe.recv()
        rest = pipe.recv_bytes()
        arrays = [pipe.recv_bytes() for _ in range(number)]
    except (EOFError, OSError):
        return None
    found: Seen | None = pickle.loads(rest, buffers=arrays)  # noqa: S301  # of `send`
    return found


def _show(pipe: Connection, spec: RigSpec, config: RigConfig, file: Path | None) -> None:
    """The process: logs what comes, until the end is told or the other end is gone."""
    import rerun as rr

    recording = rr.RecordingStream(APPLICATION)
    begun = False
    try:
        log = EpisodeLog(recording, spec, config.canonical, lattices(config))
        with shown(recording) if file is None else written(recording, file) as check:
            recording.send_blueprint(blueprint(spec))
            check()
            pipe.send(None)
            begun = True
            while (seen := _receive(pipe)) is not None:
                step, observation, truth = seen
                log.step(step, observation, truth)
                check()
    except (OSError, RuntimeError, ValueError) as failure:
        if begun:
            raise
        pipe.send(failure)
