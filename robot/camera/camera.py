"""The camera of a tactile sensor: real, mock, or a folder or video in its place.

A thread reads every frame when it arrives and keeps the newest, so a consumer that pauses never gets an old frame. A
source that fails is closed and opened again after a delay. A frame beyond its age limit is never delivered. A frame
with the same picture as the last is not a new frame: frames of a frozen camera exceed the age limit like those of a
silent one.
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
from robot.common import Closing
from robot.common import stamp as strip
from robot.errors import DeviceError, DeviceNotConnectedError, StaleObservationError
from tacsim.interface import EndOfEpisode, SensorSpec, TactileFrame
from tacsim.models.hardware import CameraSensorConfig

# Fraction of the values of a picture. With fewer changed values it is the same picture, except for a clock in its
# corner or hot pixels. In two films of a real gel at least 42 % differ between frames; a noise of 0.3 grey levels in a
# JPEG of quality 50 still changes 2.8 %.
MAX_SAME_IMAGE_CHANGE = 0.01
REOPEN_DELAY_RANGE = (0.05, 0.8)  # first and longest delay before a source is opened again [s]
CLOSE_TIMEOUT = 5.0  # longer than a read or a connection; only a silent name server takes longer [s]

ClockSource = Literal["stamp", "device", "arrival"]


class StaleFrame(StaleObservationError, TimeoutError):
    """No frame within the age limit arrived in time. A TimeoutError, as TactileSource requires."""


@dataclass(frozen=True, slots=True)
class CameraStatus:
    """State of a camera."""

    open: bool  # frames may arrive; False while the source is reopened, and after its end
    fps: float | None  # over the last frames; None before the second frame since opening [Hz]
    age: float | None  # of the newest frame, since exposure; None before the first [s]
    clock: ClockSource | None  # source of its exposure time; `arrival`: arrival minus the calibrated latency
    frames: int  # new pictures received
    repeated: int  # frames with the same picture as the last
    dropped: int  # known losses before arrival (see Camera); each is a gap in `index`
    damaged: int  # received but not decodable
    reopened: int  # times that the source was opened again
    error: str | None  # why the source is not open, or why it was closed last


class Camera(Closing):
    """A `TactileSource` that reads the source in its configuration.

    `read` returns the newest frame, at once if it is within the age limit. Between two exposures it returns the same
    frame with the same `index`.

    `index` grows by one for each new picture and by one more for each lost frame. Lost frames are counted by the
    numbers of the stamps; without stamps by the device's clock; without that clock only damaged frames count. An
    interruption is counted at the configured rate in all three cases. Thread-safe.
    """

    def __init__(self, config: CameraSensorConfig, name: str, connect_timeout: float = 5.0) -> None:
        """Opens the source and waits for the first frame, at most `connect_timeout` [s].

        Raises WrongSource (a DeviceError) if the source is not as configured, DeviceNotConnectedError if no frame
        arrives.
        """
        window = 60  # frames, for the measured rate
        played = source_kind(config, name) in ("folder", "video")
        self._can_repeat = config.repeats or played
        self._config, self._name = config, name
        self.spec = SensorSpec(
            image_shape=(config.height, config.width), height=False, flow=False, arm=config.arm, gripper=config.gripper
        )
        self._stop_event = threading.Event()
        self._changed = threading.Condition()  # guards the attributes below
        self._capture: Capture | None = None
        self._frame: TactileFrame | None = None
        self._stamp: strip.Stamp | None = None  # of _frame
        self._clock: ClockSource | None = None
        self._arrivals: deque[float] = deque(maxlen=window)
        self._received = self._dropped = self._damaged = self._repeated = self._openings = 0
        self._repeated_since_frame = 0  # since the last new picture
        self._damaged_since_frame = 0  # since the last complete frame
        self._wrong_source: str | None = None  # why the source is not as configured; None: it is
        self._error: str | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._run_thread, name=f"camera {name}", daemon=True)
        # At interpreter exit a running thread would be killed inside native code.
        atexit.register(self.close)
        self._thread.start()
        try:
            self._wait_for_first_frame(connect_timeout)
        except BaseException:
            self.close()
            raise

    def read(self, timeout: float) -> TactileFrame:
        """The newest frame, (height, width, 3) without the strip. Waits at most `timeout` [s] for one within the age
        limit, then raises StaleFrame (a TimeoutError). Raises WrongSource while the source is not as configured,
        EndOfEpisode after the last picture of a video or folder, DeviceNotConnectedError after `close`."""
        return self._wait_until(timeout, image=None)

    def wait_for(self, image_number: int, timeout: float) -> TactileFrame:
        """A frame with the picture `image_number` of the mock camera (MockCamera.push) or a later one.

        Raises the errors of `read`, and ValueError for a source without stamps.
        """
        if not self._config.stamped:
            raise ValueError(f"sensor '{self._name}': wait_for needs a stamped source; this one has no picture numbers")
        return self._wait_until(timeout, image=image_number)

    @property
    def stamp(self) -> strip.Stamp | None:
        """Stamp of the newest frame; None without stamps."""
        with self._changed:
            return self._stamp

    @property
    def status(self) -> CameraStatus:
        """Present state of the camera."""
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
        self._stop_event.set()
        with self._changed:
            if self._capture is not None:
                self._capture.interrupt()
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(CLOSE_TIMEOUT)
        atexit.unregister(self.close)

    def _wait_for_first_frame(self, timeout: float) -> None:
        with self._changed:
            self._changed.wait_for(
                lambda: self._frame is not None or self._wrong_source is not None or self._ended, timeout
            )
            if self._wrong_source is not None:
                raise WrongSource(self._wrong_source)
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
                if self._stop_event.is_set():
                    raise DeviceNotConnectedError(f"sensor '{self._name}': the camera is closed")
                if self._wrong_source is not None:
                    raise WrongSource(self._wrong_source)
                if self._ended:
                    raise EndOfEpisode(self._error)
                frame = self._frame
                is_shown = image is None or (self._stamp is not None and self._stamp.image >= image)
                if frame is not None and is_shown and now - frame.time <= self._config.max_age:
                    return frame
                if now >= deadline:
                    raise StaleFrame(self._describe_stale_frame(now, timeout, image))
                self._changed.wait(deadline - now)

    def _describe_stale_frame(self, now: float, timeout: float, image: int | None) -> str:
        what = (
            f"sensor '{self._name}': no frame {'' if image is None else f'of picture {image} '}within {timeout:.3g} s"
        )
        if self._frame is None:
            newest = "none has arrived"
        else:
            newest = (
                f"the newest is {1e3 * (now - self._frame.time):.0f} ms old, limit {1e3 * self._config.max_age:.0f} ms"
            )
            if image is not None and self._stamp is not None:
                newest += f" and shows picture {self._stamp.image}"
        return f"{what}: {newest}; {self._error or 'the source is open'} ({self._config.source})"

    # -- in the thread ---------------------------------------------------------------------------------------------

    def _run_thread(self) -> None:
        wait = REOPEN_DELAY_RANGE[0]
        while not self._stop_event.is_set():
            received = self._received
            is_live = self._read_source()
            if not is_live:
                return
            wait = REOPEN_DELAY_RANGE[0] if self._received > received else min(2.0 * wait, REOPEN_DELAY_RANGE[1])
            self._stop_event.wait(wait)

    def _read_source(self) -> bool:
        """Opens the source and reads frames until it fails. False if the source must not be opened again."""
        capture: Capture | None = None
        is_wrong_source = False
        try:
            capture = open_capture(self._config, self._name, self._stop_event)
            with self._changed:
                self._capture = capture
                self._openings += 1
                self._arrivals.clear()
            while not self._stop_event.is_set():
                try:
                    self._accept_picture(capture.read())
                except DamagedFrame as damage:
                    with self._changed:
                        self._damaged += 1
                        self._damaged_since_frame += 1
                        self._error = str(damage)
        except EndOfEpisode as end:
            with self._changed:
                self._ended, self._error = True, str(end)
                self._changed.notify_all()
            return False
        except Exception as failure:  # OpenCV raises its own errors; the thread must survive them
            is_wrong_source = isinstance(failure, WrongSource)
            self._set_failure(failure, is_wrong_source)
        finally:
            with self._changed:
                self._capture = None
            if capture is not None:
                capture.close()
        return capture is None or capture.live

    def _accept_picture(self, picture: Picture) -> None:
        max_stamp_age = 60.0  # an older stamp is from the clock of another machine [s]
        image, stamp = picture.image, None
        if self._config.stamped:
            image, stamp = strip.split(image)
            if stamp is None:
                raise DamagedFrame(
                    f"sensor '{self._name}': a frame of {self._config.source} has no readable stamp: it is damaged, "
                    "or the source adds no stamps (stamped: false)"
                )
        clock: ClockSource
        if stamp is not None:
            exposure, clock = stamp.clock * 1e-6, "stamp"
            if not 0.0 <= picture.arrival - exposure <= max_stamp_age:
                raise WrongSource(
                    f"sensor '{self._name}': a stamp is {picture.arrival - exposure:.3g} s before arrival: the clock "
                    "of another machine. Stamped sources must run on this machine"
                )
        elif picture.exposure is not None:
            exposure, clock = picture.exposure, "device"
        else:
            exposure, clock = picture.arrival - self._config.latency, "arrival"
        image.flags.writeable = False  # several readers may share the frame
        if self._frame is not None and self._is_same_picture(image, stamp, self._frame):
            self._count_repeat(picture.arrival - self._frame.time)
            return
        with self._changed:
            lost_count = self._count_lost(stamp, exposure, clock)
            index = 0 if self._frame is None else self._frame.index + 1 + lost_count
            self._frame, self._stamp, self._clock = TactileFrame(image=image, time=exposure, index=index), stamp, clock
            self._received += 1
            self._dropped += lost_count
            self._damaged_since_frame = self._repeated_since_frame = 0
            self._arrivals.append(picture.arrival)
            self._wrong_source = self._error = None
            self._changed.notify_all()

    def _is_same_picture(self, image: NDArray[np.uint8], stamp: strip.Stamp | None, last: TactileFrame) -> bool:
        """True if a frame has the same picture as the last one: the camera has frozen, is slower than its frame rate,
        or sends its last picture to a new client."""
        if stamp is not None and self._stamp is not None:
            return stamp.clock <= self._stamp.clock
        return not self._can_repeat and bool(np.count_nonzero(image != last.image) < MAX_SAME_IMAGE_CHANGE * image.size)

    def _count_repeat(self, age: float) -> None:
        with self._changed:
            self._repeated += 1
            self._repeated_since_frame += 1
            if age > self._config.max_age:
                hint = "" if self._config.stamped else " (if the source may repeat pictures, set repeats: true)"
                self._error = (
                    f"sensor '{self._name}': {self._config.source} has shown the same picture for {age:.1f} s: it has "
                    f"frozen, or is covered, dark or overexposed; check its light, restart the camera{hint}"
                )

    def _count_lost(self, stamp: strip.Stamp | None, exposure: float, clock: ClockSource) -> int:
        """Number of frames lost before this one."""
        if self._frame is None:
            return 0
        lost_by_number = -1
        if stamp is not None and self._stamp is not None:
            lost_by_number = stamp.frame - self._stamp.frame - 1
        if self._arrivals and clock != "device":
            return max(lost_by_number, 0) if stamp is not None else self._damaged_since_frame
        # After an interruption the numbers may have restarted: a restarted camera counts from 1.
        return max(
            lost_by_number,
            self._damaged_since_frame,
            round((exposure - self._frame.time) * self._config.fps) - 1 - self._repeated_since_frame,
        )

    def _set_failure(self, failure: Exception, is_wrong_source: bool) -> None:
        text = str(failure) or type(failure).__name__
        if not isinstance(failure, DeviceError) and self._name not in text:
            text = f"sensor '{self._name}': {self._config.source}: {text}"
        with self._changed:
            self._error = text
            self._wrong_source = text if is_wrong_source else None
            self._changed.notify_all()
