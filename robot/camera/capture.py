"""An open source of pictures: an MJPEG stream, a UVC camera, a folder of pictures or a video.

A capture does not recover by itself: after a failure the driver (`robot.camera.camera`) closes it and opens another. A
read of a live source waits slightly longer than `READ_TIMEOUT`.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robot.camera.mjpeg import MjpegCapture
from robot.camera.picture import READ_TIMEOUT, Picture, WrongSource, decode_jpeg, frame_size, wrong_size_error
from robot.errors import DeviceNotConnectedError
from tacsim.interface import EndOfEpisode
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.text import suggest_file


class Capture(Protocol):
    """An open source, as the driver uses it."""

    live: bool  # runs in real time, so it is reopened after a failure

    def read(self) -> Picture:
        """Waits for the next frame. Raises DamagedFrame, WrongSource, EndOfEpisode, OSError (TimeoutError: stalled);
        all except DamagedFrame end the capture."""
        ...

    def interrupt(self) -> None:
        """Makes a `read` in another thread return soon. The default, for reads that end by themselves, does nothing."""
        return

    def close(self) -> None: ...


def open_capture(config: CameraSensorConfig, name: str, stop: threading.Event) -> Capture:
    """Opens the source of sensor `name`; `stop` ends its waits. Raises WrongSource, OSError or DeviceError."""
    kind = source_kind(config, name)
    if kind == "stream":
        return MjpegCapture(config, name)
    if kind == "uvc":
        return UvcCapture(config, name)
    return PlayedCapture(config, name, stop)


def source_kind(config: CameraSensorConfig, name: str) -> str:
    """Kind of the source: "stream", "uvc", "folder" or "video". Raises WrongSource for any other source, or a setting
    that this kind does not have."""
    source, where = config.source, f"sensor '{name}': source '{config.source}'"
    if source.startswith("http://"):
        kind = "stream"
    elif "://" in source:
        raise WrongSource(f"{where}: only http:// streams (MJPEG) are supported")
    elif source.lstrip("-").isdigit() or source.startswith("/dev/video"):
        raise WrongSource(
            f"{where} is an index; indices change at boot and with each connection, so two sensors may be swapped. "
            "Use the serial number of the camera: a path in /dev/v4l/by-id/ that ends in -index0"
        )
    elif source.startswith("/dev/"):
        kind = "uvc"
    else:
        path = Path(source)
        if not path.exists():
            raise WrongSource(f"{where}: no such file or folder{suggest_file(path)}")
        kind = "folder" if path.is_dir() else "video"
    if kind != "uvc" and (config.exposure is not None or config.white_balance is not None):
        raise WrongSource(
            f"{where}: exposure and white_balance can be set for UVC cameras only; set them at the source of the "
            "picture and remove them here"
        )
    return kind


class UvcCapture(Capture):
    """A UVC camera on Linux (V4L2) by its serial path. Sets size, rate, exposure and white balance, and reads back."""

    live = True

    def __init__(self, config: CameraSensorConfig, name: str) -> None:
        import cv2

        self._description = f"sensor '{name}': {config.source}"
        self._size = frame_size(config)
        self._timeout = READ_TIMEOUT + 3.0 / config.fps
        if not Path(config.source).exists():
            raise DeviceNotConnectedError(f"{self._description}: no such device; is it connected? (ls /dev/v4l/by-id)")
        self._capture = cv2.VideoCapture(config.source, cv2.CAP_V4L2)
        try:
            if not self._capture.isOpened():
                raise DeviceNotConnectedError(
                    f"{self._description}: cannot be opened; another program uses it, or no permission (group video)"
                )
            self._configure(config)
        except BaseException:
            self._capture.release()
            raise

    def _configure(self, config: CameraSensorConfig) -> None:
        """Sets the pixel format before the size: many cameras offer large sizes only compressed."""
        import cv2

        self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._apply_setting(cv2.CAP_PROP_FRAME_WIDTH, self._size[1], "width [px]", 0.5)
        self._apply_setting(cv2.CAP_PROP_FRAME_HEIGHT, self._size[0], "height [px]", 0.5)
        self._apply_setting(cv2.CAP_PROP_FPS, config.fps, "fps", 0.05 * config.fps)
        if config.exposure is not None:
            self._apply_setting(cv2.CAP_PROP_AUTO_EXPOSURE, 1, "automatic exposure (1: off)", 0.1)
            self._apply_setting(cv2.CAP_PROP_EXPOSURE, config.exposure, "exposure", 0.01 * abs(config.exposure) + 1e-9)
        if config.white_balance is not None:
            self._apply_setting(cv2.CAP_PROP_AUTO_WB, 0, "automatic white balance", 0.1)
            self._apply_setting(cv2.CAP_PROP_WB_TEMPERATURE, config.white_balance, "white_balance [K]", 0.5)
        if self._capture.get(cv2.CAP_PROP_FOURCC) == cv2.VideoWriter.fourcc(*"MJPG"):
            self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # JPEGs undecoded: OpenCV's decoder hides damage

    def _apply_setting(self, setting: int, value: float, what: str, tolerance: float) -> None:
        is_accepted = self._capture.set(setting, value)
        actual = self._capture.get(setting)
        if not abs(actual - value) <= tolerance:
            raise WrongSource(
                f"{self._description}: {what} was set to {value:g} and reads back {actual:g}"
                f"{'' if is_accepted else ' (refused)'}; choose a value that the camera supports "
                "(v4l2-ctl --list-formats-ext, --list-ctrls)"
            )

    def read(self) -> Picture:
        import cv2

        ready, _ = cv2.VideoCapture.waitAny([self._capture], timeoutNs=int(1e9 * self._timeout))
        if not ready:
            raise TimeoutError(f"{self._description}: no frame for {self._timeout:.2g} s")
        is_retrieved, image = self._capture.retrieve()  # waitAny has grabbed it already
        arrival = time.monotonic()
        if not is_retrieved or image is None:
            raise ConnectionError(f"{self._description}: no frame; was it disconnected?")
        # V4L2 time stamp of the buffer: monotonic clock for most drivers, 0 or epoch time for others.
        exposure = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        return Picture(self._rgb(image), arrival, exposure if 0.0 <= arrival - exposure < 1.0 else None)

    def _rgb(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        import cv2

        if image.ndim == 1 or 1 in image.shape[:2]:  # the bytes of a JPEG
            return decode_jpeg(image.tobytes(), self._size, self._description)
        if image.shape != (*self._size, 3):
            raise wrong_size_error(self._description, image.shape[:2], self._size)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def close(self) -> None:
        self._capture.release()


class PlayedCapture(Capture):
    """A folder of pictures or a video, played once at its rate, in place of a camera."""

    live = False

    def __init__(self, config: CameraSensorConfig, name: str, stop: threading.Event) -> None:
        from tacsim.record.episode import EpisodeError
        from tacsim.record.sources import folder_images, list_pictures, video_images, video_rate

        self._description = f"sensor '{name}': {config.source}"
        self._size = frame_size(config)
        self._stop = stop
        path = Path(config.source)
        try:
            if path.is_dir():
                rate, self._images = config.fps, folder_images(list_pictures(path))
            else:
                rate, self._images = video_rate(path) or config.fps, video_images(path)
        except (EpisodeError, OSError) as error:
            raise WrongSource(f"{self._description}: {error}") from error
        self._period = 1.0 / rate
        self._next_time: float | None = None  # of the next picture [s]

    def read(self) -> Picture:
        from tacsim.record.episode import EpisodeError

        if self._next_time is not None and self._stop.wait(max(0.0, self._next_time - time.monotonic())):
            raise EndOfEpisode(f"{self._description}: closed")
        try:
            image = next(self._images, None)
        except (EpisodeError, OSError) as error:
            raise WrongSource(f"{self._description}: {error}") from error
        if image is None:
            raise EndOfEpisode(f"{self._description}: no more pictures")
        if image.shape != (*self._size, 3):
            raise wrong_size_error(self._description, image.shape[:2], self._size)
        now = time.monotonic()
        self._next_time = now + self._period if self._next_time is None else max(self._next_time + self._period, now)
        return Picture(image, now, None)

    def close(self) -> None:
        close = getattr(self._images, "close", None)
        if close is not None:
            close()
