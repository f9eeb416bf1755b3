"""Sources that are none, and UVC cameras that do not keep settings."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from robot.camera import capture
from robot.camera.camera import Camera, StaleFrame
from robot.camera.capture import PlayedCapture, UvcCapture, source_kind
from robot.camera.mjpeg import MjpegCapture
from robot.camera.picture import WrongSource
from robot.errors import DeviceNotConnectedError
from tests.robot.camera.servers import STREAM, Server, config, encoded, says, seen
from tests.robot.waiting import until


@pytest.mark.promise(11)
@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("0", "is an index; indices change"),
        ("-1", "is an index"),
        ("/dev/video2", r"is an index; .*/dev/v4l/by-id/"),
        ("rtsp://127.0.0.1/", "only http:// streams"),
        ("https://127.0.0.1/", "only http:// streams"),
        ("ftp://127.0.0.1/", "only http:// streams"),
        ("/nowhere/at/all", "no such file or folder"),
    ],
)
def test_source_kind_unsupported_source_raises(source: str, text: str) -> None:
    with pytest.raises(WrongSource, match=text):
        Camera(config(source), "left")


@pytest.mark.parametrize(
    "source", ["http://", "http://host:99999/", "http://user:secret@127.0.0.1/", "http://127.0.0.1/a b", "http://[::1/"]
)
def test_open_invalid_address_raises(source: str) -> None:
    with pytest.raises(WrongSource, match="address"):
        Camera(config(source), "left")


def test_source_kind_uvc_settings_elsewhere_raise() -> None:
    with pytest.raises(WrongSource, match="exposure and white_balance can be set for UVC cameras only"):
        source_kind(config("http://127.0.0.1/", exposure=100.0), "left")
    with pytest.raises(WrongSource, match="UVC cameras only"):
        source_kind(config("/tmp", white_balance=4000.0), "left")


# UVC. No camera here: what OpenCV's capture would answer


class FakeCapture:
    """Replaces cv2.VideoCapture: accepts settings, except those in its list of fixed ones."""

    keeps: dict[int, float] = {}
    opened = True
    image: np.ndarray | None = np.zeros((48, 64, 3), dtype=np.uint8)
    jpeg: Callable[[int], bytes] | None = None  # in place of `image`, if pictures come as the camera encoded them
    stamp: float | None = 0.01  # age of the buffer's time stamp; None: the driver gives 0 [s]
    ready = True
    made: list[FakeCapture] = []

    def __init__(self, source: str, backend: int) -> None:
        self.settings: dict[int, float] = {}
        self.order: list[int] = []
        self.count = 0
        self.released = False
        self.made.append(self)

    def isOpened(self) -> bool:
        return self.opened

    def set(self, setting: int, value: float) -> bool:
        self.order.append(setting)
        self.settings[setting] = self.keeps.get(setting, value)
        return setting not in self.keeps

    def get(self, setting: int) -> float:
        import cv2

        if setting == cv2.CAP_PROP_POS_MSEC:
            return 0.0 if self.stamp is None else 1e3 * (time.monotonic() - self.stamp)
        return self.settings.get(setting, 0.0)

    @staticmethod
    def waitAny(captures: list[FakeCapture], timeoutNs: int) -> tuple[bool, list[int]]:
        assert timeoutNs > 0
        time.sleep(0.005)
        return FakeCapture.ready, [0]

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        import cv2

        self.count += 1
        if self.image is None:
            return False, None
        if self.jpeg is not None and self.settings.get(cv2.CAP_PROP_CONVERT_RGB) == 0:
            return True, np.frombuffer(FakeCapture.jpeg(self.count), dtype=np.uint8)[None]  # type: ignore[misc]
        rng = np.random.default_rng(self.count)
        return True, self.image ^ rng.integers(0, 2, self.image.shape, dtype=np.uint8)  # with noise, as a camera's

    def release(self) -> None:
        self.released = True


@pytest.fixture
def uvc(monkeypatch: pytest.MonkeyPatch) -> type[FakeCapture]:
    import cv2

    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    for name, value in (
        ("keeps", {}),
        ("opened", True),
        ("stamp", 0.01),
        ("ready", True),
        ("jpeg", None),
        ("made", []),
    ):
        monkeypatch.setattr(FakeCapture, name, value)
    monkeypatch.setattr(FakeCapture, "image", np.full((48, 64, 3), (255, 0, 0), dtype=np.uint8))
    return FakeCapture


DEVICE = "/dev/null"  # any path in /dev that is there


def test_uvc_settings_set_format_before_size(uvc: type[FakeCapture]) -> None:
    import cv2

    with Camera(config(DEVICE, exposure=150.0, white_balance=4500.0), "left") as camera:
        frame = camera.read(20.0)
        assert np.abs(frame.image[0, 0].astype(int) - (0, 0, 255)).max() <= 1  # RGB
        assert camera.status.clock == "device" and abs(time.monotonic() - frame.time) < 20.0
    order = uvc.made[0].order
    assert order.index(cv2.CAP_PROP_FOURCC) < order.index(cv2.CAP_PROP_FRAME_WIDTH)
    assert order.index(cv2.CAP_PROP_AUTO_EXPOSURE) < order.index(cv2.CAP_PROP_EXPOSURE)
    assert uvc.made[0].settings[cv2.CAP_PROP_AUTO_WB] == 0
    assert uvc.made[0].released


def test_uvc_jpeg_is_decoded_strictly(uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of them lost the end: OpenCV would decode them with a grey lower half."""
    whole = [encoded(seen(100, number)) for number in range(100)]
    monkeypatch.setattr(uvc, "jpeg", lambda n: whole[n % 100] if n % 2 else whole[n % 100][:800] + b"\xff\xd9")
    with Camera(config(DEVICE), "left") as camera:
        until(lambda: camera.status.frames > 5 and camera.status.damaged > 5)
        assert np.abs(camera.read(20.0).image.astype(int) - 100).max() < 12
        assert camera.status.reopened == 0


def test_uvc_frozen_camera_raises_stale_frame(uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver stamps each buffer; in low light it may give each picture twice, which is not a loss."""
    pictures = [encoded(seen(100, number)) for number in range(100)]
    monkeypatch.setattr(uvc, "jpeg", lambda n: pictures[n // 2 % 100])
    with Camera(config(DEVICE, max_age=0.2, fps=200.0), "left") as camera:
        until(lambda: camera.status.frames > 10)
        status = camera.status
        assert status.error is None and status.repeated >= 9 and status.clock == "device"
        monkeypatch.setattr(uvc, "jpeg", lambda n: pictures[-1])
        until(lambda: "the same picture for" in (camera.status.error or ""))
        with pytest.raises(StaleFrame):
            camera.read(0.0)


def test_uvc_unset_settings_are_not_changed(uvc: type[FakeCapture]) -> None:
    import cv2

    capture = UvcCapture(config(DEVICE), "left")
    capture.close()
    assert not {cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_AUTO_WB} & set(uvc.made[0].order)


@pytest.mark.promise(11)
@pytest.mark.parametrize(
    ("setting", "value", "text"),
    [
        ("CAP_PROP_FRAME_WIDTH", 640.0, r"width \[px\] was set to 64 and reads back 640 \(refused\)"),
        ("CAP_PROP_FRAME_HEIGHT", 480.0, "height"),
        ("CAP_PROP_FPS", 25.0, "fps was set to 30 and reads back 25"),
        ("CAP_PROP_AUTO_EXPOSURE", 3.0, "automatic exposure"),
        ("CAP_PROP_EXPOSURE", 166.0, "exposure was set to 150 and reads back 166"),
        ("CAP_PROP_AUTO_WB", 1.0, "automatic white balance"),
        ("CAP_PROP_WB_TEMPERATURE", float("nan"), "white_balance"),
    ],
)
def test_uvc_setting_with_other_readback_raises(
    uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch, setting: str, value: float, text: str
) -> None:
    import cv2

    monkeypatch.setattr(uvc, "keeps", {getattr(cv2, setting): value})
    with pytest.raises(WrongSource, match=text):
        Camera(config(DEVICE, exposure=150.0, white_balance=4500.0), "left")
    assert all(made.released for made in uvc.made)


@pytest.mark.parametrize("age", [None, -5.0, 1e6])
def test_uvc_stamp_of_other_clock_uses_arrival(
    uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch, age: float | None
) -> None:
    monkeypatch.setattr(uvc, "stamp", age)
    with Camera(config(DEVICE, latency=0.5), "left") as camera:
        assert time.monotonic() - camera.read(20.0).time > 0.5
        assert camera.status.clock == "arrival"


def test_uvc_stall_or_disconnection_reopens(uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch) -> None:
    with Camera(config(DEVICE, max_age=0.2), "left") as camera:
        camera.read(20.0)
        monkeypatch.setattr(uvc, "ready", False)
        while camera.status.reopened < 1:
            time.sleep(0.005)
        monkeypatch.setattr(uvc, "ready", True)
        camera.read(20.0)
        monkeypatch.setattr(uvc, "image", None)
        while camera.status.reopened < 3:
            time.sleep(0.005)
        assert camera.status.error is not None and "disconnected" in camera.status.error
        monkeypatch.setattr(uvc, "image", np.zeros((48, 64, 3), dtype=np.uint8))
        camera.read(20.0)
    assert len(uvc.made) >= 4 and all(made.released for made in uvc.made)


def test_uvc_wrong_size_raises(uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uvc, "image", np.zeros((60, 64, 3), dtype=np.uint8))
    with pytest.raises(WrongSource, match="frames are 64 x 60 px, expected 64 x 48"):
        Camera(config(DEVICE), "left")


def test_uvc_not_openable_raises(uvc: type[FakeCapture], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uvc, "opened", False)
    with pytest.raises(DeviceNotConnectedError, match="another program uses it"):
        Camera(config(DEVICE), "left", connect_timeout=0.5)
    with pytest.raises(DeviceNotConnectedError, match="is it connected"):
        Camera(config("/dev/v4l/by-id/usb-none-video-index0"), "left", connect_timeout=0.5)


def test_open_capture_source_selects_kind(server: Server, uvc: type[FakeCapture], tmp_path: object) -> None:
    server.talk = says(STREAM)
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(f"{tmp_path}/a.png")
    for source, kind in ((server.url, MjpegCapture), (DEVICE, UvcCapture), (str(tmp_path), PlayedCapture)):
        opened = capture.open_capture(config(source), "left", threading.Event())
        assert isinstance(opened, kind)
        opened.close()
