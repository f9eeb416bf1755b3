"""An episode, or a rig while it runs, in the Rerun viewer or in a file for it.

A running rig is shown at no cost to the control loop: steps are handed to a process of their own, and those that it
cannot take in time are left out.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import queue
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
WAITING = 2  # steps that wait to be handed over; a longer queue would show the past

Shown = tuple[Step, Observation, Truth | None]
Log = Callable[[Step, Observation, Truth | None], None]


def view_episode(path: Path, file: Path | None, on_step: Callable[[int, int], None] = lambda done, total: None) -> None:
    """Shows the episode in a viewer that it starts; with a `file` (.rrd) it writes that instead: whole, or not at all.

    Raises ValueError without rerun-sdk or for an empty episode, EpisodeError, FileExistsError, OSError, RuntimeError of
    a viewer that cannot be started, and what normalising raises.
    """
    require_rerun()
    observed = observe_episode(path)
    steps, spec = observed.episode.steps, observed.episode.meta.spec
    if not steps:
        raise ValueError(f"{path}: no step can be read, there is nothing to show")
    with logged(spec, observed.canonical, observed.rig, file) as log:
        for done, (step, observation) in enumerate(observed.steps(), start=1):
            log(step, observation, None)
            on_step(done, len(steps))


class LiveView(Closing):
    """Call it with each step. It never waits, and no failure of the viewer reaches the caller.

    file: (.rrd) is written instead of a viewer started; whole also when this program is killed.

    Raises ValueError without rerun-sdk, FileExistsError, OSError and RuntimeError when the viewer does not start.
    """

    def __init__(self, spec: RigSpec, config: RigConfig, file: Path | None) -> None:
        require_rerun()
        self._line: queue.Queue[Shown | None] = queue.Queue(WAITING)
        self.left_out = 0  # steps
        self._ended = False  # the process has
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_show, args=(other, spec, config, file), name="view", daemon=True)
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
        """The viewer, or what feeds it, has ended by itself: nothing more is shown."""
        return self._ended

    def close(self) -> None:
        """Waits for what was handed over, at most MAX_END for each part. A second call does nothing."""
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
            raise RuntimeError(f"the viewer did not begin within {start_timeout:g} s")
        try:
            failure = self._pipe.recv()
        except EOFError:
            raise RuntimeError("the process of the viewer ended before it began") from None
        if failure is not None:
            raise failure

    def _hand_over(self) -> None:
        while (step := self._line.get()) is not None:
            if self._ended:
                self.left_out += 1
                continue
            try:
                self._pipe.send(step)
            except Exception:  # whatever the reason, the process can show no more
                self._ended = True
        with contextlib.suppress(OSError):
            self._pipe.send(None)


def _show(pipe: Connection, spec: RigSpec, config: RigConfig, file: Path | None) -> None:
    """The process: logs steps until None comes or the program at the other end is gone."""
    started = False
    try:
        with logged(spec, config.canonical, config, file) as log:
            pipe.send(None)
            started = True
            while (step := _receive(pipe)) is not None:
                log(*step)
    except (OSError, RuntimeError, ValueError) as failure:
        if started:
            raise
        pipe.send(failure)


def _receive(pipe: Connection) -> Shown | None:
    """A step; None at the end, also where the program was killed within a message."""
    try:
        step: Shown | None = pipe.recv()
    except (EOFError, OSError):
        return None
    return step


@contextmanager
def logged(spec: RigSpec, canonical: CanonicalGrid, rig: RigConfig | None, file: Path | None) -> Iterator[Log]:
    """Gives what logs a step: into a viewer that it starts, or into a new `file`, which is whole in the end or absent.

    Raises FileExistsError, OSError that names the file, RuntimeError of a viewer that cannot be started.
    """
    import rerun as rr

    recording = rr.RecordingStream(APPLICATION)
    episode = EpisodeLog(recording, spec, canonical, _lattices(rig))
    with _viewer(recording) if file is None else _file(recording, file) as check:
        recording.send_blueprint(blueprint(spec))
        check()

        def log(step: Step, observation: Observation, truth: Truth | None) -> None:
            episode.step(step, observation, truth)
            check()

        yield log


@contextmanager
def _viewer(recording: rr.RecordingStream) -> Iterator[Callable[[], None]]:
    recording.spawn()
    yield lambda: None
    recording.disconnect()


@contextmanager
def _file(recording: rr.RecordingStream, file: Path) -> Iterator[Callable[[], None]]:
    """Whole, or not at all. Gives what raises the OSError that has ended the writing."""
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
    """Copies from a pipe, into which Rerun writes, into a file until the pipe is closed: Rerun itself reports no full
    disk, or waits without end. Its binary stream is no way out: read more than once, it makes a damaged file (0.41)."""

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
                except OSError as failure:  # what follows is read and discarded
                    self._error = OSError(failure.errno, failure.strerror, str(self._file))

    def check(self) -> None:
        """Raises what went wrong."""
        if self._error is not None:
            raise self._error


def require_rerun() -> None:
    """Raises ValueError without rerun-sdk."""
    if util.find_spec("rerun") is None:
        raise ValueError("views are made by rerun-sdk, which is not installed: pip install 'tacsim[viz]'")


def _lattices(rig: RigConfig | None) -> Mapping[str, NDArray[np.float64]]:
    """Where the markers of each sensor rest, of those that the rig knows."""
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
