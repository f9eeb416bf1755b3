"""The camera of a tactile sensor: real, mock, or a folder or video in its place.

A thread reads every frame as it comes and keeps the newest, so a consumer that pauses gets no old ones. A source that
fails is closed and opened again, with back-off. A frame beyond its age limit is never delivered. One that shows the
picture of the last again is no new one: a frozen camera grows old like a silent one.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robot.camera.capture import Capture, open_capture, source_kind
from robot.camera.picture import DamagedFrame, Picture, WrongSource
from robot.camera.tuning import MIN_CHANGED_SHARE
from robot.common import Closing
from robot.common import stamp as strip
from robot.errors import DeviceError, DeviceNotConnectedError, StaleObservationError
from tacsim.interface import EndOfEpisode, SensorSpec, TactileFrame
from tacsim.models.hardware import CameraSensorConfig

BACK_OFF = (0.05, 0.8)  # first and longest wait before a source is opened again: back within a second [s]
CLOSE_TIMEOUT = 5.0  # only a name server that does not answer takes longer than a read or a connection [s]

ClockSource = Literal["stamp", "device", "arrival"]


class StaleFrame(StaleObservationError, TimeoutError):
    """No frame within the age limit came in time; a TimeoutError, as TactileSource demands."""


@dataclass(frozen=True, slots=True)
class CameraStatus:
    open: bool  # frames may come; False while it is being reopened, and after the end
    fps: float | None  # measured over the last frames; None before the second since opening [Hz]
    age: float | None  # of the newest frame, since exposure; None before the first [s]
    clock: ClockSource | None  # source of its exposure time; `arrival`: that minus the calibrated latency
    frames: int  # new pictures received
    repeated: int  # frames that showed the same picture again
    dropped: int  # lost before arrival, as far as known (see Camera); each is a gap in `index`
    damaged: int  # received, but not readable
    reopened: int  # how often the source was opened again
    error: str | None  # why it is not open, or what ended the last opening


class Camera(Closing):
    """A `TactileSource` that reads the source its configuration names.

    `read` gives the newest frame, at once if it is within the age limit. Between two exposures that is the same frame
    with the same `index`.

    `index` grows by one for each new picture and by one more for each lost frame: counted by the numbers of the stamps;
    without stamps by the device's clock; without that, only damaged frames count as lost. An interruption counts with
    all three, at the configured rate. Thread-safe.
    """

    def __init__(self, config: CameraSensorConfig, name: str, connect_timeout: float = 5.0) -> None:
        """Opens the source and waits for the first frame, at most `connect_timeout` [s].

        Raises WrongSource (a DeviceError) when the source is not as configured, DeviceNotConnectedError when no frame
        came.
        """
        window = 60  # frames over which the rate is measured
        played = source_kind(config, name) in ("folder", "video")
        self._may_repeat = config.repeats or played
        self._config, self._name = config, name
        self.spec = SensorSpec(image_shape=(config.height, config.width), height=False, flow=False, arm=config.arm)
        self._stop = threading.Event()
        self._changed = threading.Condition()  # guards all that follows
        self._capture: Capture | None = None
        self._frame: TactileFrame | None = None
        self._stamp: strip.Stamp | None = None  # of _frame
        self._clock: ClockSource | None = None
        self._arrivals: deque[float] = deque(maxlen=window)
        self._received = self._dropped = self._damaged = self._repeated = self._openings = 0
        self._repeats = 0  # since the last new picture
        self._unread = 0  # damaged since the last whole frame
        self._refusal: str | None = None  # why the source is wrong now
        self._error: str | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)
        # A thread that still runs when the interpreter goes would be cut in the middle of native code.
        atexit.register(self.close)
        self._thread.start()
        try:
            self._await_first(connect_timeout)
        except BaseException:
            self.close()
            raise

    def read(self, timeout: float) -> TactileFrame:
        """The newest frame, (height, width, 3) without the strip. Waits at most `timeout` [s] for one within the age
        limit, else raises StaleFrame (a TimeoutError). Raises WrongSource while the source is not as configured,
        EndOfEpisode when a video or folder is over, DeviceNotConnectedError after `close`."""
        return self._wait_until(timeout, image=None)

    def wait_for(self, image_number: int, timeout: float) -> TactileFrame:
        """A frame that shows the picture `image_number` of the mock camera (MockCamera.push) or a later one.

        Raises as `read`, and ValueError for a source without stamps.
        """
        if not self._config.stamped:
            raise ValueError(f"sensor '{self._name}': wait_for needs a stamped source; this one has no picture numbers")
        return self._wait_until(timeout, image=image_number)

    @property
    def stamp(self) -> strip.Stamp | None:
        """The stamp of the newest frame; None without stamps."""
        with self._changed:
            return self._stamp

    @property
    def status(self) -> CameraStatus:
        """The present state."""
        with self._changed:
            fps = None
            if len(self._arrivals) > 1 and self._arrivals[-1] > self._arrivals[0]:
                fps = (len(self._arrivals) - 1) / (self._arrivals[-1] - self._arrivals[0])
            return CameraStatus(
                open=self._capture is not None,
                fps=fps,
                age=None if self._frame is None else time.monotonic() - self._frame.time,
                clock=self._clock,
                frames=self._received,
                repeated=self._repeated,
                dropped=self._dropped,
                damaged=self._damaged,
                reopened=max(0, self._openings - 1),
                error=self._error,
            )

    def close(self) -> None:
        """Ends the thread and releases the source. A second call does nothing."""
        self._stop.set()
        with self._changed:
            if self._capture is not None:
                self._capture.interrupt()
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(CLOSE_TIMEOUT)
        atexit.unregister(self.close)

    def _await_first(self, timeout: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not None or self._refusal is not None or self._ended, timeout)
            if self._refusal is not None:
                raise WrongSource(self._refusal)
            if self._frame is None and not self._ended:
                raise DeviceNotConnectedError(
                    f"sensor '{self._name}': no picture from {self._config.source} within {timeout:.3g} s; "
                    f"{self._error or 'the source is silent'}"
                )

    def _wait_until(self, timeout: float, image: int | None) -> TactileFrame:
        deadline = time.monotonic() + timeout
        with self._changed:
            while True:
                now = time.monotonic()
                if self._stop.is_set():
                    raise DeviceNotConnectedError(f"sensor '{self._name}': the camera is closed")
                if self._refusal is not None:
                    raise WrongSource(self._refusal)
                if self._ended:
                    raise EndOfEpisode(self._error)
                frame = self._frame
                shown = image is None or (self._stamp is not None and self._stamp.image >= image)
                if frame is not None and shown and now - frame.time <= self._config.max_age:
                    return frame
                if now >= deadline:
                    raise StaleFrame(self._stale_text(now, timeout, image))
                self._changed.wait(deadline - now)

    def _stale_text(self, now: float, timeout: float, image: int | None) -> str:
        what = (
            f"sensor '{self._name}': no frame {'' if image is None else f'of picture {image} '}within {timeout:.3g} s"
        )
        if self._frame is None:
            newest = "none came yet"
        else:
            newest = (
                f"the newest is {1e3 * (now - self._frame.time):.0f} ms old, limit {1e3 * self._config.max_age:.0f} ms"
            )
            if image is not None and self._stamp is not None:
                newest += f", and shows picture {self._stamp.image}"
        return f"{what}: {newest}; {self._error or 'the source is open'} ({self._config.source})"

    # -- in the thread ---------------------------------------------------------------------------------------------

    def _run(self) -> None:
        wait = BACK_OFF[0]
        while not self._stop.is_set():
            received = self._received
            live = self._read_source()
            if not live:
                return
            wait = BACK_OFF[0] if self._received > received else min(2.0 * wait, BACK_OFF[1])
            self._stop.wait(wait)

    def _read_source(self) -> bool:
        """Opens the source and reads frames until it fails; False when it is not to be opened again."""
        capture: Capture | None = None
        refused = False
        try:
            capture = open_capture(self._config, self._name, self._stop)
            with self._changed:
                self._capture = capture
                self._openings += 1
                self._arrivals.clear()
            while not self._stop.is_set():
                try:
                    self._accept(capture.read())
                except DamagedFrame as damage:
                    with self._changed:
                        self._damaged += 1
                        self._unread += 1
                        self._error = str(damage)
        except EndOfEpisode as end:
            with self._changed:
                self._ended, self._error = True, str(end)
                self._changed.notify_all()
            return False
        except Exception as failure:  # OpenCV raises errors of its own; the thread must live
            refused = isinstance(failure, WrongSource)
            self._set_failure(failure, refused)
        finally:
            with self._changed:
                self._capture = None
            if capture is not None:
                capture.close()
        return capture is None or capture.live

    def _accept(self, picture: Picture) -> None:
        max_stamp_age = 60.0  # a stamp beyond it is of another machine's clock [s]
        image, mark = picture.image, None
        if self._config.stamped:
            image, mark = strip.split(image)
            if mark is None:
                raise DamagedFrame(
                    f"sensor '{self._name}': a frame of {self._config.source} without a readable stamp; it is damaged, "
                    "or the source burns none in (stamped: false)"
                )
        clock: ClockSource
        if mark is not None:
            exposure, clock = mark.clock * 1e-6, "stamp"
            if not 0.0 <= picture.arrival - exposure <= max_stamp_age:
                raise WrongSource(
                    f"sensor '{self._name}': a stamp {picture.arrival - exposure:.3g} s before arrival: the clock of "
                    "another machine. Stamped sources must run on this one"
                )
        elif picture.exposure is not None:
            exposure, clock = picture.exposure, "device"
        else:
            exposure, clock = picture.arrival - self._config.latency, "arrival"
        image.flags.writeable = False  # the same frame may be given to several readers
        if self._frame is not None and self._is_same(image, mark, self._frame):
            self._count_repeat(picture.arrival - self._frame.time)
            return
        with self._changed:
            lost = self._count_lost(mark, exposure, clock)
            index = 0 if self._frame is None else self._frame.index + 1 + lost
            self._frame, self._stamp, self._clock = TactileFrame(image=image, time=exposure, index=index), mark, clock
            self._received += 1
            self._dropped += lost
            self._unread = self._repeats = 0
            self._arrivals.append(picture.arrival)
            self._refusal = self._error = None
            self._changed.notify_all()

    def _is_same(self, image: NDArray[np.uint8], mark: strip.Stamp | None, last: TactileFrame) -> bool:
        """Whether a frame shows the picture that came last: the camera has frozen, is slower than its frames, or greets
        a new client with what it has."""
        if mark is not None and self._stamp is not None:
            return mark.clock <= self._stamp.clock
        return not self._may_repeat and bool(np.count_nonzero(image != last.image) < MIN_CHANGED_SHARE * image.size)

    def _count_repeat(self, age: float) -> None:
        with self._changed:
            self._repeated += 1
            self._repeats += 1
            if age > self._config.max_age:
                hint = "" if self._config.stamped else " (a source that may repeat itself says so: repeats: true)"
                self._error = (
                    f"sensor '{self._name}': {self._config.source} has shown the same picture for {age:.1f} s: it has "
                    f"frozen, or is covered, dark or overexposed; look at its light, restart the camera{hint}"
                )

    def _count_lost(self, mark: strip.Stamp | None, exposure: float, clock: ClockSource) -> int:
        """How many frames are missing before this one."""
        if self._frame is None:
            return 0
        numbered = -1
        if mark is not None and self._stamp is not None:
            numbered = mark.frame - self._stamp.frame - 1
        if self._arrivals and clock != "device":
            return max(numbered, 0) if mark is not None else self._unread
        # After an interruption the numbers may have restarted: a restarted camera counts from 1.
        return max(numbered, self._unread, round((exposure - self._frame.time) * self._config.fps) - 1 - self._repeats)

    def _set_failure(self, failure: Exception, refused: bool) -> None:
        text = str(failure) or type(failure).__name__
        if not isinstance(failure, DeviceError) and self._name not in text:
            text = f"sensor '{self._name}': {self._config.source}: {text}"
        with self._changed:
            self._error = text
            self._refusal = text if refused else None
            self._changed.notify_all()
