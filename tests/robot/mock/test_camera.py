"""The mock camera's process: what it serves, how it is broken, how it ends."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from robot.errors import DeviceError, DeviceNotConnectedError
from robot.mock.camera.camera import MockCamera
from robot.mock.camera.stream import FrameSource
from tests.robot.mock.camera_client import HOST, Client, get
from tests.robot.waiting import alive, until

FPS = 200.0


@pytest.fixture(scope="module")
def shared() -> Iterator[MockCamera]:
    with MockCamera(host=HOST, fps=FPS) as camera:
        yield camera


@pytest.fixture
def camera(shared: MockCamera) -> Iterator[MockCamera]:
    """The camera of the module; whole again after each test."""
    yield shared
    for fault in (shared.stall, shared.freeze, shared.corrupt, shared.cut, shared.refuse):
        fault(False)
    shared.flip(0)
    shared.drop(0.0)
    shared.delay(0.0)
    shared.resize(320, 240)
    shared.brightness(1.0)
    shared.disconnect()
    until(lambda: shared.state().clients == 0)


def test_stream_matches_mjpg_streamer(camera: MockCamera) -> None:
    with Client(camera) as client:
        assert client.head[0].endswith("200 OK")
        assert "Content-Type: multipart/x-mixed-replace;boundary=boundarydonotcross" in client.head
        before = time.monotonic_ns() // 1000
        marks = [client.frame()[1] for _ in range(5)]
    numbers = [mark.frame for mark in marks]
    assert numbers == sorted(set(numbers))
    clocks = [mark.clock for mark in marks]
    assert clocks == sorted(clocks) and before - 10**6 < clocks[0] and clocks[-1] <= time.monotonic_ns() // 1000
    assert camera.url == f"http://{HOST}:{camera.port}/?action=stream"


def test_snapshot_path_returns_jpeg_and_others_404(camera: MockCamera) -> None:
    until(lambda: camera.state().frames > 1)
    status, kind, data = get(camera, "/?action=snapshot")
    assert (status, kind) == (200, "image/jpeg") and Image.open(io.BytesIO(data)).size == (320, 256)
    assert get(camera, "/nothing")[0] == 404


def test_pushed_image_has_its_number_in_stamp(camera: MockCamera) -> None:
    with Client(camera) as client:
        for value in (10, 200, 90):
            number = camera.push(np.full((240, 320, 3), (value, 20, 30), dtype=np.uint8))
            picture, mark = client.frame()
            while mark.image < number:
                picture, mark = client.frame()
            assert mark.image == number
            assert np.abs(picture.reshape(-1, 3).mean(axis=0) - (value, 20, 30)).max() < 3
    assert camera.state().images == number


def test_pushed_image_is_sent_at_once() -> None:
    with MockCamera(host=HOST, fps=0.1) as camera, Client(camera) as client:
        clocks = []
        for value in range(5):
            number = camera.push(np.full((240, 320, 3), value, dtype=np.uint8))
            while (mark := client.frame()[1]).image != number:
                pass
            clocks.append(mark.clock)
    assert clocks[-1] - clocks[0] < 20e6  # by ticks it would be 40 s


def test_camera_keeps_frame_rate(camera: MockCamera) -> None:
    with Client(camera) as client:
        marks = [client.frame()[1] for _ in range(60)]
    rate = 1e6 * (marks[-1].frame - marks[0].frame) / (marks[-1].clock - marks[0].clock)
    assert 2.0 < rate < 1.1 * FPS  # a loaded machine may be slower, none is faster


def test_camera_without_stamp_sends_plain_image() -> None:
    with MockCamera(host=HOST, width=64, height=48, stamped=False, quality=100, noise=0) as camera:
        camera.push(np.full((48, 64, 3), 77, dtype=np.uint8))
        with Client(camera) as client:
            client.jpeg()  # perhaps exposed just before the push
            image = np.array(Image.open(io.BytesIO(client.jpeg())))
    assert image.shape == (48, 64, 3) and np.abs(image.astype(int) - 77).max() <= 1


def test_camera_clients_are_independent(camera: MockCamera) -> None:
    with Client(camera) as slow, Client(camera) as quick:
        first = slow.frame()[1].frame
        for _ in range(120):
            quick.frame()
        assert camera.state().clients == 2
        assert slow.frame()[1].frame > first


def test_slow_camera_client_loses_frames() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (768, 1024, 3), dtype=np.uint8)
    with MockCamera(host=HOST, width=1024, height=768, fps=60, quality=100) as camera, Client(camera):
        camera.push(noise)
        camera.push(noise)

        def sent() -> int:
            return camera.state().sent

        until(lambda: camera.state().clients == 1 and camera.state().frames > 20)
        stuck = sent()
        frames = camera.state().frames
        until(lambda: camera.state().frames > frames + 15)
        assert sent() <= stuck + 1  # one frame hangs in the socket; no other was handed out


def test_camera_without_stamp_has_noise() -> None:
    with MockCamera(host=HOST, width=64, height=48, stamped=False) as camera:
        camera.push(np.full((48, 64, 3), 77, dtype=np.uint8))
        with Client(camera) as client:
            client.jpeg()
            one, two = (np.array(Image.open(io.BytesIO(client.jpeg()))).astype(int) for _ in range(2))
    assert (one != two).mean() > 0.1 and np.abs(one - 77).max() < 12


def test_after_stall_no_older_frame_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither what waits for its delay nor what is just being encoded: without stamps it would count as of now."""
    source = FrameSource(32, 24, fps=0.5, quality=90, stamped=False, noise=0)
    exposing, goes_on = threading.Event(), threading.Event()
    encode = source._encode

    def slowly(picture: np.ndarray | None, *rest: Any) -> bytes:
        jpeg = encode(picture, *rest)
        if picture is not None and picture.max() == 0:
            exposing.set()
            assert goes_on.wait(10.0)
        return jpeg

    monkeypatch.setattr(source, "_encode", slowly)
    thread = threading.Thread(target=source.run)
    thread.start()
    try:
        sent = source.newest[0]
        source.set_fault("delay", 0.05)
        source.push(np.zeros((24, 32, 3), np.uint8))
        assert exposing.wait(10.0)
        source.set_fault("stall", True)
        goes_on.set()
        source.push(np.full((24, 32, 3), 200, np.uint8))
        time.sleep(0.1)
        assert source.newest[0] - sent <= 1  # the camera's own first frame
        source.set_fault("stall", False)
        seen = source.newest
        until(lambda: source.newest != seen, "a frame after the stall")
        assert np.asarray(Image.open(io.BytesIO(source.newest[1]))).mean() == pytest.approx(200, abs=2)
        assert source.counts["dropped"] >= 1
    finally:
        goes_on.set()
        source.close()
        thread.join()


def test_resize_and_brightness_change_image(camera: MockCamera) -> None:
    camera.push(np.full((240, 320, 3), 100, dtype=np.uint8))
    with Client(camera) as client:
        camera.resize(160, 120)
        camera.brightness(1.5)
        until(lambda: client.frame()[0].shape == (120, 160, 3))
        until(lambda: abs(client.frame()[0].mean() - 150) < 3)
        camera.resize(320, 240)
        until(lambda: client.frame()[0].shape == (240, 320, 3))
        assert camera.state().size is None


def test_refuse_closes_and_reopens_port(camera: MockCamera) -> None:
    with Client(camera) as client:
        client.frame()
        camera.refuse(True)
        camera.refuse(True)
        with pytest.raises(ConnectionRefusedError):
            Client(camera)
        client.frame()  # who is there stays
    camera.refuse(False)
    with Client(camera) as client:
        client.frame()


def test_too_many_camera_clients_get_503(camera: MockCamera) -> None:
    clients = [Client(camera) for _ in range(16)]
    try:
        until(lambda: camera.state().clients == 16)
        assert get(camera, "/?action=stream")[0] == 503
    finally:
        for client in clients:
            client.close()


def test_pushes_of_threads_keep_their_numbers(camera: MockCamera) -> None:
    numbers: list[int] = []

    def push() -> None:
        for _ in range(20):
            numbers.append(camera.push(np.zeros((240, 320, 3), dtype=np.uint8)))

    threads = [threading.Thread(target=push) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(numbers) == list(range(min(numbers), min(numbers) + 60))


@pytest.mark.parametrize(
    "image",
    [np.zeros((240, 321, 3), np.uint8), np.zeros((240, 320), np.uint8), np.zeros((0, 0, 3), np.uint8)]
    + [np.zeros((240, 320, 3), np.float32)],
)
def test_push_of_other_shape_is_refused(camera: MockCamera, image: np.ndarray) -> None:
    pushed = camera.state().images
    with pytest.raises(ValueError, match=r"push needs \(240, 320, 3\) uint8"):
        camera.push(image)
    assert camera.state().images == pushed


def test_camera_invalid_faults_are_refused(camera: MockCamera) -> None:
    for ask in (
        lambda: camera.drop(1.5),
        lambda: camera.drop(float("nan")),
        lambda: camera.delay(-1.0),
        lambda: camera.resize(0, 10),
        lambda: camera.brightness(-1.0),
        lambda: camera.flip(-1),
    ):
        with pytest.raises(ValueError, match="must be within"):
            ask()


@pytest.mark.parametrize(
    "options",
    [
        {"width": 0},
        {"height": 5000},
        {"fps": 0.0},
        {"fps": float("nan")},
        {"quality": 10},
        {"port": 70000},
        {"noise": 50},
    ],
)
def test_camera_invalid_options_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be within"):
        MockCamera(host=HOST, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.0.5", "camera.example", ""])
def test_camera_refuses_network_address(host: str) -> None:
    with pytest.raises(ValueError, match="not a loopback address"):
        MockCamera(host=host)


def test_camera_port_in_use_raises(camera: MockCamera) -> None:
    with pytest.raises(DeviceError, match="cannot serve"):
        MockCamera(host=HOST, port=camera.port)


def test_camera_close_twice_leaves_no_process() -> None:
    camera = MockCamera(host=HOST)
    with Client(camera):
        camera.close()
        camera.close()
    assert not alive(camera.pid)
    with pytest.raises(DeviceNotConnectedError, match="closed"):
        camera.push(np.zeros((240, 320, 3), dtype=np.uint8))


def test_killed_camera_process_is_reported() -> None:
    with MockCamera(host=HOST) as camera:
        os.kill(camera.pid, signal.SIGKILL)
        with pytest.raises(DeviceNotConnectedError, match="has ended, killed by SIGKILL"):
            camera.push(np.zeros((240, 320, 3), dtype=np.uint8))


def test_silent_camera_process_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    with MockCamera(host=HOST) as camera:
        monkeypatch.setattr("robot.mock.camera.camera.ANSWER_TIMEOUT", 0.5)  # not before: to start takes longer
        os.kill(camera.pid, signal.SIGSTOP)
        with pytest.raises(DeviceNotConnectedError, match=r"no answer within 0\.5 s"):
            camera.push(np.zeros((240, 320, 3), dtype=np.uint8))


def test_camera_ends_with_its_parent() -> None:
    code = (
        "import time; from robot.mock.camera.camera import MockCamera\n"
        f"camera = MockCamera(host={HOST!r}); print(camera.pid, flush=True); time.sleep(100)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert alive(pid)
        parent.kill()
    until(lambda: not alive(pid))


def test_camera_unknown_command_is_refused(camera: MockCamera) -> None:
    with pytest.raises(DeviceNotConnectedError, match="no command 'fly'"):
        camera._ask("fly")
    assert camera.state().frames >= 0
