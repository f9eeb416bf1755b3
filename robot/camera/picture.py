"""A picture from its source, and the errors of a picture."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot.common import stamp
from robot.errors import DeviceError
from tacsim.models.hardware import CameraSensorConfig

CONNECT_TIMEOUT = 1.0  # to connect and to read the header of the answer [s]
READ_TIMEOUT = 0.5  # plus three periods: a live source without a complete frame is reopened [s]


class WrongSource(DeviceError):
    """The source answers, but not as configured: another size, not a stream, or a refused setting."""


class DamagedFrame(Exception):
    """One picture that cannot be decoded; the next may be complete."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame as the source delivered it."""

    image: NDArray[np.uint8]  # (H, W, 3) RGB, with the strip of a stamped source
    arrival: float  # time when it was complete here, monotonic clock [s]
    exposure: float | None  # by the device's time stamp, monotonic clock; None without one [s]


def frame_size(config: CameraSensorConfig) -> tuple[int, int]:
    """Rows and columns of the expected frames, including the strip of a stamped source [px]."""
    return config.height + (stamp.strip_rows(config.width) if config.stamped else 0), config.width


def decode_jpeg(data: bytes, size: tuple[int, int], description: str) -> NDArray[np.uint8]:
    """Decodes a JPEG of `size` rows, columns [px] to RGB (rows, columns, 3). `description` is used in errors.

    Raises WrongSource for another size, before decoding, and DamagedFrame if the decoder would have to guess: the JPEG
    is cut, has a gap, or does not end where its picture ends. Bytes that changed into another valid picture pass: a
    JPEG has no check sum.
    """
    padding = 16  # bytes before a marker; some cameras add them to complete pictures
    import simplejpeg  # reports warnings, which Pillow and OpenCV hide

    try:
        if not data.startswith(b"\xff\xd8"):
            raise ValueError("not a JPEG")
        actual = tuple(simplejpeg.decode_jpeg_header(data)[:2])
        if actual != size:
            raise wrong_size_error(description, actual, size)
        try:
            picture = simplejpeg.decode_jpeg(data, "RGB")
        except ValueError as warning:
            added = re.search(r"(\d+) extraneous bytes before marker", str(warning))
            if added is None or int(added[1]) > padding:
                raise
            picture = simplejpeg.decode_jpeg(data, "RGB", strict=False)
    except ValueError as error:
        raise DamagedFrame(
            f"{description}: a damaged picture ({error}); check cable, USB hub and power, or the program that sends it"
        ) from error
    return np.asarray(picture, dtype=np.uint8)


def wrong_size_error(description: str, actual: tuple[int, ...], expected: tuple[int, int]) -> WrongSource:
    """The error for a wrong frame size; `actual` and `expected` are rows, columns [px]."""
    return WrongSource(
        f"{description}: frames are {actual[1]} x {actual[0]} px, expected {expected[1]} x {expected[0]}; correct "
        "width, height or stamped in the rig file (a stamped source has its strip below `height`), or the camera"
    )
