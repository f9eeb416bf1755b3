"""An episode, or a running rig, in the Rerun viewer or in a file for it.

The view of a running rig does not delay the control loop: a separate process receives the steps, and steps that it
cannot take in time are left out.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import queue
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from errno import EEXIST
from importlib import util
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calibration.bundle import read_bundle
from robot.common import Closing
from robot.common.process import blocking_signals
from robot.common.whole_file import move_to_new_path
from robot.export.rerun_log import EpisodeLog, blueprint
from robot.rig.recorded import observe_episode
from tacsim.interface import Observation, RigSpec, Truth
from tacsim.models.rig import RigConfig
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.markers import rest_positions
from tacsim.record.episode import Step

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "tacsim"
MAX_WAITING_STEPS = 2  # steps in the queue; a longer queue would show old steps
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")  # one of them is set where a window can be shown on Linux

ViewedStep = tuple[Step, Observation, Truth | None]
Log = Callable[[Step, Observation, Truth | None], None]


def view_episode(path: Path, file: Path | None, on_step: Callable[[int, int], None] = lambda done, total: None) -> None:
    """Shows the episode in a new viewer; with a `file` (.rrd), writes that file instead, completely or not at all.

    Raises:
        ValueError: rerun-sdk is not installed, there is no display, or the episode is empty.
        RuntimeError: the viewer does not start.
        EpisodeError, FileExistsError, OSError, and the errors of normalising.
    """
    require_viewer(file)
    observed = observe_episode(path)
    steps, spec = observed.episode.steps, observed.episode.meta.spec
    if not steps:
        raise ValueError(f"{path}: no step can be read, there is nothing to show")
    with open_log(spec, observed.canonical, observed.rig, file) as log:
        for done, (step, observation) in enumerate(observed.steps(), start=1):
            log(step, observation, None)
            on_step(done, len(steps))


class LiveView(Closing):
    """Shows steps while a rig runs: call it with each step. The call never waits, and the viewer raises no error in it.

    file: (.rrd) to write instead of starting a viewer; it is complete also if this program is killed.

    Raises:
        ValueError: rerun-sdk is not installed, or there is no display.
        RuntimeError: the viewer does not start.
        FileExistsError, OSError.
    """

    def __init__(self, spec: RigSpec, config: RigConfig, file: Path | None) -> None:
        require_viewer(file)
        self._line: queue.Queue[ViewedStep | None] = queue.Queue(MAX_WAITING_STEPS)
        self.left_out = 0  # steps
        self._ended = False  # the process has ended
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(
            target=_run_viewer_process, args=(other, spec, config, file), name="view", daemon=True
        )
        with blocking_signals():
            self._process.start()
        other.close()
        self._thread = threading.Thread(target=self._hand_over, name="view", daemon=True)
        try:
            self._await_start()
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
        """True if the viewer or its process has ended, so that no more steps are shown."""
        return self._ended

    def close(self) -> None:
        """Waits until the queued steps are shown, at most `end_timeout` for each part. A second call does nothing."""
        end_timeout = 20.0  # longest wait for the last steps [s]
        with contextlib.suppress(queue.Full):
            self._line.put(None, timeout=end_timeout)
        self._thread.join(end_timeout)
        self._process.join(end_timeout)
        if self._process.is_alive():
            self._process.kill()
        self._pipe.close()

    def _await_start(self) -> None:
        start_timeout = 60.0  # longest wait for the viewer [s]
        if not self._pipe.poll(start_timeout):
            raise RuntimeError(f"the viewer did not start within {start_timeout:g} s")
        try:
            failure = self._pipe.recv()
        except EOFError:
            raise RuntimeError("the process of the viewer ended before it started") from None
        if failure is not None:
            raise failure

    def _hand_over(self) -> None:
        while (step := self._line.get()) is not None:
            if self._ended:
                self.left_out += 1
                continue
            try:
                self._pipe.send(step)
            except Exception:  # after any error the process shows no more steps
                self._ended = True
        with contextlib.suppress(OSError):
            self._pipe.send(None)


def _run_viewer_process(pipe: Connection, spec: RigSpec, config: RigConfig, file: Path | None) -> None:
    """Main function of the process: logs steps until it receives None or the program at the other end has ended."""
    started = False
    try:
        with open_log(spec, config.canonical, config, file) as log:
            pipe.send(None)
            started = True
            while (step := _receive(pipe)) is not None:
                log(*step)
    except (OSError, RuntimeError, ValueError) as failure:
        if started:
            raise
        pipe.send(failure)


def _receive(pipe: Connection) -> ViewedStep | None:
    """A step; None at the end, also if the program was killed within a message."""
    try:
        step: ViewedStep | None = pipe.recv()
    except (EOFError, OSError):
        return None
    return step


@contextmanager
def open_log(spec: RigSpec, canonical: CanonicalGrid, rig: RigConfig | None, file: Path | None) -> Iterator[Log]:
    """Yields a function that logs a step into a viewer, or into a new `file`, which is complete at the end or absent.

    Raises:
        RuntimeError: the viewer does not start.
        FileExistsError, OSError: the message names the file.
    """
    import rerun as rr

    recording = rr.RecordingStream(APPLICATION)
    episode = EpisodeLog(recording, spec, canonical, _lattices(rig))
    with _show_in_viewer(recording) if file is None else _write_to_file(recording, file) as check:
        is_laid_out = False

        def log(step: Step, observation: Observation, truth: Truth | None) -> None:
            nonlocal is_laid_out
            if not is_laid_out:
                recording.send_blueprint(blueprint(spec, observation.arms))
                is_laid_out = True
            episode.step(step, observation, truth)
            check()

        yield log


@contextmanager
def _show_in_viewer(recording: rr.RecordingStream) -> Iterator[Callable[[], None]]:
    recording.spawn()
    yield lambda: None
    recording.disconnect()


@contextmanager
def _write_to_file(recording: rr.RecordingStream, file: Path) -> Iterator[Callable[[], None]]:
    """Writes the file completely or not at all. Yields a function that raises the OSError that ended the writing."""
    if file.exists():
        raise FileExistsError(EEXIST, "File exists", str(file))
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        with partial.open("xb") as target, tempfile.TemporaryDirectory() as folder:
            copy = _Copy(Path(folder) / "pipe", target, file)
            copy.start()
            recording.save(copy.pipe)
            try:
                yield copy.check
            finally:
                recording.disconnect()
                copy.join()
            copy.check()
        move_to_new_path(partial, file)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


class _Copy(threading.Thread):
    """Copies from a pipe, into which Rerun writes, into a file until the pipe is closed. On a full disk Rerun itself
    reports no error, or waits without end. Its binary stream cannot be used: read more than once, it makes a damaged
    file (0.41)."""

    def __init__(self, pipe: Path, target: BinaryIO, file: Path) -> None:
        super().__init__(daemon=True)
        os.mkfifo(pipe)
        self.pipe, self._target, self._file = pipe, target, file
        self._error: OSError | None = None

    def run(self) -> None:
        with self.pipe.open("rb") as source:
            while data := source.read(1 << 16):
                try:
                    if self._error is None:
                        self._target.write(data)
                        self._target.flush()
                except OSError as failure:  # the rest of the pipe is read and discarded
                    self._error = OSError(failure.errno, failure.strerror, str(self._file))

    def check(self) -> None:
        """Raises the error of the copy, if there is one."""
        if self._error is not None:
            raise self._error


def require_viewer(file: Path | None) -> None:
    """Raises ValueError if rerun-sdk is not installed, or if its viewer would be shown (`file` None) without a
    display."""
    if util.find_spec("rerun") is None:
        raise ValueError("a view needs rerun-sdk, which is not installed: pip install 'tacsim[viz]'")
    if file is None and sys.platform == "linux" and not any(os.environ.get(name) for name in DISPLAYS):
        raise ValueError(
            f"a view needs a display, and none of {', '.join(DISPLAYS)} is set; write a file for the viewer of another "
            "machine instead: tacsim run --save-view FILE.rrd, tacsim view --save FILE.rrd"
        )


def _lattices(rig: RigConfig | None) -> Mapping[str, NDArray[np.float64]]:
    """Rest positions of the markers of each sensor whose markers the rig file gives."""
    found: dict[str, NDArray[np.float64]] = {}
    for name, sensor in ({} if rig is None else rig.sensors).items():
        markers = None
        if sensor.bundle is not None:
            markers = read_bundle(Path(sensor.bundle))[0].markers
        elif sensor.sensor_model is not None:
            markers = sensor.sensor_model.markers
        if markers is not None:
            found[name] = rest_positions(markers)
    return found
