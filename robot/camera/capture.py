"""One opened source of pictures: an MJPEG stream, a UVC camera, a folder of pictures or a video.

A capture does not recover by itself: when it fails, the driver (`robot.camera.camera`) closes it and opens another. A
read of a live source waits little longer than `READ_TIMEOUT`.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robot.camera.mjpeg import MjpegCapture
from robot.camera.picture import READ_TIMEOUT, Picture, WrongSource, decode_jpeg, frame_size, wrong_size
from robot.errors import DeviceNotConnectedError
from tacsim.interface import EndOfEpisode
from tacsim.models.hardware import CameraSensorConfig


class Capture(Protocol):
    """An opened source, as the driver needs it."""

    live: bool  # goes on in real time, so it is reopened when it fails

    def read(self) -> Picture:
        """Waits for the next frame. Raises DamagedFrame, WrongSource, EndOfEpisode, OSError (TimeoutError: stalled);
        all but the first end the capture."""
        ...

    def interrupt(self) -> None:
        """Makes a `read` in another thread return soon; nothing to do where it does so anyway."""
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
    """ "stream", "uvc", "folder" or "video". Raises WrongSource for any other source, or a setting that this kind does
    not have."""
    source, where = config.source, f"sensor '{name}': source '{config.source}'"
    if source.startswith("http://"):
        kind = "stream"
    elif "://" in source:
        raise WrongSource(f"{where}: only http:// streams (MJPEG) are read")
    elif source.lstrip("-").isdigit() or source.startswith("/dev/video"):
        raise WrongSource(
            f"{where} is an index; indices change with each plug and boot, so two sensors get exchanged unnoticed. "
            "Name the camera by its serial number: a path in /dev/v4l/by-id/ that ends in -index0"
        )
    elif source.startswith("/dev/"):
        kind = "uvc"
    else:
        path = Path(source)
        if not path.exists():
            raise WrongSource(f"{where}: no such file or folder")
        kind = "folder" if path.is_dir() else "video"
    if kind != "uvc" and (config.exposure is not None or config.white_balance is not None):
        raise WrongSource(
            f"{where}: exposure and white_balance are set through UVC only; fix them where the picture is made, and "
            "leave them out here"
        )
    return kind


class UvcCapture(Capture):
    """A UVC camera of Linux (V4L2) by its serial path: size, rate, exposure, white balance are set and read back."""

    live = True

    def __init__(self, config: CameraSensorConfig, name: str) -> None:
        import cv2

        self._what = f"sensor '{name}': {config.source}"
        self._size = frame_size(config)
        self._timeout = READ_TIMEOUT + 3.0 / config.fps
        if not Path(config.source).exists():
            raise DeviceNotConnectedError(f"{self._what}: no such device; is it plugged in? (ls /dev/v4l/by-id)")
        self._capture = cv2.VideoCapture(config.source, cv2.CAP_V4L2)
        try:
            if not self._capture.isOpened():
                raise DeviceNotConnectedError(
                    f"{self._what}: cannot be opened; another program holds it, or this user may not (group video)"
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
        self._keep(cv2.CAP_PROP_FRAME_WIDTH, self._size[1], "width [px]", 0.5)
        self._keep(cv2.CAP_PROP_FRAME_HEIGHT, self._size[0], "height [px]", 0.5)
        self._keep(cv2.CAP_PROP_FPS, config.fps, "fps", 0.05 * config.fps)
        if config.exposure is not None:
            self._keep(cv2.CAP_PROP_AUTO_EXPOSURE, 1, "automatic exposure (1: off)", 0.1)
            self._keep(cv2.CAP_PROP_EXPOSURE, config.exposure, "exposure", 0.01 * abs(config.exposure) + 1e-9)
        if config.white_balance is not None:
            self._keep(cv2.CAP_PROP_AUTO_WB, 0, "automatic white balance", 0.1)
            self._keep(cv2.CAP_PROP_WB_TEMPERATURE, config.white_balance, "white_balance [K]", 0.5)
        if self._capture.get(cv2.CAP_PROP_FOURCC) == cv2.VideoWriter.fourcc(*"MJPG"):
            self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # JPEGs as they come: OpenCV's decoder hides damage

    def _keep(self, setting: int, value: float, what: str, tolerance: float) -> None:
        taken = self._capture.set(setting, value)
        got = self._capture.get(setting)
        if not abs(got - value) <= tolerance:
            raise WrongSource(
                f"{self._what}: {what} was set to {value:g} and reads back {got:g}{'' if taken else ' (refused)'}; "
                "give what the camera has (v4l2-ctl --list-formats-ext, --list-ctrls)"
            )

    def read(self) -> Picture:
        import cv2

        ready, _ = cv2.VideoCapture.waitAny([self._capture], timeoutNs=int(1e9 * self._timeout))
        if not ready:
            raise TimeoutError(f"{self._what}: no frame for {self._timeout:.2g} s")
        there, image = self._capture.retrieve()  # waitAny has grabbed it already
        arrival = time.monotonic()
        if not there or image is None:
            raise ConnectionError(f"{self._what}: no frame; was it unplugged?")
        # The buffer's time stamp by V4L2: the monotonic clock with nearly all drivers, 0 or an epoch with others.
        exposure = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        return Picture(self._rgb(image), arrival, exposure if 0.0 <= arrival - exposure < 1.0 else None)

    def _rgb(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        import cv2

        if image.ndim == 1 or 1 in image.shape[:2]:  # the bytes of a JPEG
            return decode_jpeg(image.tobytes(), self._size, self._what)
        if image.shape != (*self._size, 3):
            raise wrong_size(self._what, image.shape[:2], self._size)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def close(self) -> None:
        self._capture.release()


class PlayedCapture(Capture):
    """A folder of pictures or a video, played once at its rate, as a stand-in for a camera."""

    live = False

    def __init__(self, config: CameraSensorConfig, name: str, stop: threading.Event) -> None:
        from tacsim.record.episode import EpisodeError
        from tacsim.record.sources import folder_images, list_pictures, video_images, video_rate

        self._what = f"sensor '{name}': {config.source}"
        self._size = frame_size(config)
        self._stop = stop
        path = Path(config.source)
        try:
            if path.is_dir():
                rate, self._images = config.fps, folder_images(list_pictures(path))
            else:
                rate, self._images = video_rate(path) or config.fps, video_images(path)
        except (EpisodeError, OSError) as error:
            raise WrongSource(f"{self._what}: {error}") from error
        self._period = 1.0 / rate
        self._due: float | None = None  # when the next picture is shown

    def read(self) -> Picture:
        from tacsim.record.episode import EpisodeError

        if self._due is not None and self._stop.wait(max(0.0, self._due - time.monotonic())):
            raise EndOfEpisode(f"{self._what}: closed")
        try:
            image = next(self._images, None)
        except (EpisodeError, OSError) as error:
            raise WrongSource(f"{self._what}: {error}") from error
        if image is None:
            raise EndOfEpisode(f"{self._what} is over")
        if image.shape != (*self._size, 3):
            raise wrong_size(self._what, image.shape[:2], self._size)
        now = time.monotonic()
        self._due = now + self._period if self._due is None else max(self._due + self._period, now)
        return Picture(image, now, None)

    def close(self) -> None:
        close = getattr(self._images, "close", None)
        if close is not None:
            close()
