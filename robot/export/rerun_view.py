"""An episode in the Rerun viewer, or in a file for it."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from errno import EEXIST
from importlib import util
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calibration.bundle import read_bundle
from robot.common.whole_file import put_new
from robot.export.rerun_log import EpisodeLog, blueprint
from robot.rig.recorded import observe_episode
from tacsim.models.rig import RigConfig
from tacsim.optics.markers import rest_positions

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "tacsim"


def view_episode(path: Path, file: Path | None, on_step: Callable[[int, int], None] = lambda done, total: None) -> None:
    """Shows the episode in a viewer that it starts; with a `file` (.rrd) it writes that instead: whole, or not at all.

    Raises ValueError without rerun-sdk or for an empty episode, EpisodeError, FileExistsError, OSError, RuntimeError of
    a viewer that cannot be started, and what normalising raises.
    """
    require_rerun()
    import rerun as rr

    observed = observe_episode(path)
    steps, spec = observed.episode.steps, observed.episode.meta.spec
    if not steps:
        raise ValueError(f"{path}: no step can be read, there is nothing to show")
    recording = rr.RecordingStream(APPLICATION)
    log = EpisodeLog(recording, spec, observed.canonical, lattices(observed.rig))
    with shown(recording) if file is None else written(recording, file) as check:
        recording.send_blueprint(blueprint(spec))
        for done, (step, observation) in enumerate(observed.steps(), start=1):
            log.step(step, observation)
            check()
            on_step(done, len(steps))


def require_rerun() -> None:
    """Raises ValueError without rerun-sdk."""
    if util.find_spec("rerun") is None:
        raise ValueError("views are made by rerun-sdk, which is not installed: pip install 'tacsim[viz]'")


@contextmanager
def shown(recording: rr.RecordingStream) -> Iterator[Callable[[], None]]:
    """In a viewer that it starts."""
    recording.spawn()
    yield lambda: None
    recording.disconnect()


@contextmanager
def written(recording: rr.RecordingStream, file: Path) -> Iterator[Callable[[], None]]:
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
        put_new(partial, file)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


class _Copy(threading.Thread):
    """Copies from a pipe into a file until the pipe is closed. Rerun writes into the pipe: of a disk that is full it
    would say nothing, or wait for ever."""

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
                except OSError as failure:  # what follows is read, and goes nowhere
                    self._error = OSError(failure.errno, failure.strerror, str(self._file))

    def check(self) -> None:
        """Raises what went wrong."""
        if self._error is not None:
            raise self._error


def lattices(rig: RigConfig | None) -> Mapping[str, NDArray[np.float64]]:
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
