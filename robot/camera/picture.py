"""A picture as its source delivers it, and what can be wrong with it."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot.common import stamp
from robot.errors import DeviceError
from tacsim.models.hardware import CameraSensorConfig

CONNECT_TIMEOUT = 1.0  # to connect and to read the header of the answer [s]
READ_TIMEOUT = 0.5  # a live source without a complete frame for this time plus three periods is reopened [s]


class WrongSource(DeviceError):
    """The source answers, but not as configured: another size, no stream, a setting it does not take."""


class DamagedFrame(Exception):
    """One picture that cannot be decoded; the next may be sound."""


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame as the source delivered it."""

    image: NDArray[np.uint8]  # (H, W, 3) RGB, with the strip of a stamped source
    arrival: float  # when it was complete here, monotonic clock [s]
    exposure: float | None  # by the device's own stamp, monotonic clock; None without one [s]


def frame_size(config: CameraSensorConfig) -> tuple[int, int]:
    """Rows and columns of the expected frames, including the strip of a stamped source [px]."""
    return config.height + (stamp.strip_rows(config.width) if config.stamped else 0), config.width


def decode_jpeg(data: bytes, size: tuple[int, int], what: str) -> NDArray[np.uint8]:
    """The picture (rows, columns, 3) RGB of a JPEG of `size` rows, columns [px]; `what` is named in errors.

    Raises WrongSource for another size, before anything is decoded, and DamagedFrame for whatever the decoder would
    have to guess: a JPEG that is cut, has a hole, or does not end where its picture does. Bytes that were altered into
    another valid picture pass: a JPEG has no check sum, so what sends it must not alter it.
    """
    padding = 16  # bytes that a camera may add before a marker: some do, and their pictures are whole
    import simplejpeg  # strict about warnings, which Pillow and OpenCV keep to themselves

    try:
        if not data.startswith(b"\xff\xd8"):
            raise ValueError("no JPEG")
        found = tuple(simplejpeg.decode_jpeg_header(data)[:2])
        if found != size:
            raise wrong_size(what, found, size)
        try:
            picture = simplejpeg.decode_jpeg(data, "RGB")
        except ValueError as warning:
            added = re.search(r"(\d+) extraneous bytes before marker", str(warning))
            if added is None or int(added[1]) > padding:
                raise
            picture = simplejpeg.decode_jpeg(data, "RGB", strict=False)
    except ValueError as error:
        raise DamagedFrame(
            f"{what}: a damaged picture ({error}); look at cable, USB hub and power, or at what sends it"
        ) from error
    return np.asarray(picture, dtype=np.uint8)


def wrong_size(what: str, got: tuple[int, ...], expected: tuple[int, int]) -> WrongSource:
    """`got` and `expected` are rows, columns [px]."""
    return WrongSource(
        f"{what}: frames are {got[1]} x {got[0]} px, expected are {expected[1]} x {expected[0]}; correct width, height "
        "or stamped in the rig file (a stamped source has its strip below `height`), or the camera"
    )
