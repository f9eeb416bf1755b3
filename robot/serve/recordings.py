"""Recorded episodes of a served rig: numbered folders; the last waits until the operator keeps or discards it."""

from __future__ import annotations

import shutil
import threading
from concurrent.futures import CancelledError, Future
from pathlib import Path

from robot.common import Closing
from robot.common.process_pool import ProcessPool
from robot.serve.errors import Refused, describe


def write_report_of(folder: Path) -> None:
    """Writes the report of the episode in `folder`; raises what reading and writing it raise."""
    from robot.rig.recorded import RecordedSurfaces
    from tacsim.record.reader import read_episode
    from tacsim.report.report import write_report

    episode = read_episode(folder / "episode.mcap")
    surfaces = RecordedSurfaces(episode.meta)
    write_report(episode, folder, surfaces, surfaces.gels)


class Recordings(Closing):
    """Episodes below `folder`: 000, 001, ... All methods may be called in any thread.

    A process of its own writes the reports: plots made in this one would delay a STOP. `close` waits for them.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._pool = ProcessPool(1)
        self._pending: Path | None = None
        self._writing: dict[Path, Future[None]] = {}
        self._report: Path | None = None
        self._failure = ""

    @property
    def pending(self) -> Path | None:
        """The episode that waits to be kept or discarded."""
        return self._pending

    @property
    def report(self) -> Path | None:
        """Folder of the last report that is complete."""
        return self._report

    @property
    def report_state(self) -> str:
        """Text about the report being written, or about one that could not be; "" without."""
        return "the report is being written" if self._writing else self._failure

    def next_folder(self) -> Path:
        """The next free number; not made yet."""
        taken = [int(path.name) for path in self._folder.glob("[0-9]*") if path.name.isdecimal()]
        return self._folder / f"{max(taken, default=-1) + 1:03d}"

    def add(self, folder: Path) -> None:
        """A closed recording, which waits from now on; its report is begun."""
        future = self._pool.submit(write_report_of, folder)
        with self._lock:
            self._pending, self._writing[folder] = folder, future
        future.add_done_callback(lambda done: self._note_report(folder, done))

    def keep(self, note: str) -> Path:
        """Keeps the episode that waits, with a note in `note.txt`. Returns its folder. Raises Refused without one."""
        folder = self._take()
        if note.strip():
            (folder / "note.txt").write_text(note.strip() + "\n", encoding="utf-8")
        return folder

    def discard(self) -> None:
        """Deletes the episode that waits, after its report is written or cancelled. Raises Refused without one."""
        folder = self._take()
        with self._lock:
            future = self._writing.get(folder)
        if future is not None and not future.cancel():
            future.exception()  # waits
        with self._lock:
            self._writing.pop(folder, None)
            if self._report == folder:
                self._report = None
        shutil.rmtree(folder)

    def close(self) -> None:
        self._pool.shutdown()

    def _note_report(self, folder: Path, done: Future[None]) -> None:
        with self._lock:
            if self._writing.pop(folder, None) is None:  # discarded
                return
            try:
                done.result()
                self._report, self._failure = folder, ""
            except CancelledError:
                pass
            except Exception as failure:
                self._failure = f"no report of {folder.name}: {describe(failure)}"

    def _take(self) -> Path:
        with self._lock:
            folder, self._pending = self._pending, None
        if folder is None:
            raise Refused("no recording waits to be kept or discarded")
        return folder
