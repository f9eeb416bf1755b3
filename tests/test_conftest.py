"""The fixture that keeps tests off real hardware does so, and lets loopback, pseudo-terminals and files through."""

from __future__ import annotations

import builtins
import os
import socket
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

OUTSIDE = ("192.0.2.1", 30004)  # TEST-NET-1 (RFC 5737): never a real machine
OUTSIDE_V6 = ("2001:db8::1", 30004, 0, 0)


def refused(match: str) -> pytest.RaisesExc[AssertionError]:
    return pytest.raises(AssertionError, match=match)


@pytest.mark.parametrize("verb", ["connect", "connect_ex"])
@pytest.mark.parametrize(("family", "address"), [(socket.AF_INET, OUTSIDE), (socket.AF_INET6, OUTSIDE_V6)])
def test_no_connection_leaves_the_machine(verb: str, family: socket.AddressFamily, address: tuple[object, ...]) -> None:
    with socket.socket(family, socket.SOCK_STREAM) as peer, refused("only loopback"):
        peer.settimeout(0.5)
        getattr(peer, verb)(address)


@pytest.mark.parametrize(
    "send",
    [
        lambda peer: peer.sendto(b"x", OUTSIDE),
        lambda peer: peer.sendto(b"x", 0, OUTSIDE),
        lambda peer: peer.sendmsg([b"x"], [], 0, OUTSIDE),
    ],
)
def test_no_datagram_leaves_the_machine(send: Callable[[socket.socket], int]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer, refused("only loopback"):
        send(peer)


def test_a_host_name_counts_as_outside() -> None:
    with socket.socket() as peer, refused("robot.example"):
        peer.connect(("robot.example", 30004))


def test_high_level_connections_are_caught_too() -> None:
    with refused("only loopback"):
        socket.create_connection(OUTSIDE, timeout=0.5)


def test_loopback_works() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as client:
        peer, _ = server.accept()
        with peer:
            client.sendall(b"hello")
            assert peer.recv(5) == b"hello"


@pytest.mark.parametrize("device", ["/dev/ttyUSB0", "/dev/ttyACM0", "/dev/video0"])
@pytest.mark.parametrize("opener", ["open", "Path.open", "os.open"])
def test_no_device_is_opened(opener: str, device: str) -> None:
    # Looked up here, not in the decorator: that runs before the guards stand.
    calls = {"open": (builtins.open, "rb"), "Path.open": (Path.open, "rb"), "os.open": (os.open, os.O_RDWR)}
    function, mode = calls[opener]
    with refused("device"):
        function(Path(device), mode)


def test_files_open(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("x", encoding="utf-8")
    assert (tmp_path / "a").read_text(encoding="utf-8") == "x"


@pytest.mark.parametrize("source", [0, 1, np.int64(0), "/dev/video0"])
def test_no_camera_is_opened(source: int | str) -> None:
    with refused("camera"):
        cv2.VideoCapture(source)
    with refused("camera"):
        cv2.VideoCapture().open(source)


def test_videos_open(tmp_path: Path) -> None:
    path = str(tmp_path / "a.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (16, 16))
    writer.write(np.zeros((16, 16, 3), np.uint8))
    writer.release()
    video = cv2.VideoCapture(path)
    found, image = video.read()
    video.release()
    assert found
    assert image.shape == (16, 16, 3)
