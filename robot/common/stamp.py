"""The stamp of tacsim's mock camera: a strip of black and white blocks below the image of the gel.

It contains the frame number, the image number, and the clock at exposure, so that latency and lost frames are measured
end to end. Blocks of 4 x 8 pixels stay readable in JPEG with colour at half resolution (4:2:0) down to quality 50. A
check sum distinguishes a strip from other images and from a damaged strip.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BLOCK = (8, 4)  # rows, columns of a bit [px]
_FIELDS = struct.Struct(">IIQ")  # frame, image, clock
_CHECK = struct.Struct(">I")  # CRC-32 of the fields
BITS = 8 * (_FIELDS.size + _CHECK.size)


@dataclass(frozen=True, slots=True)
class Stamp:
    """Contents of the strip of one frame."""

    frame: int  # number of the frame; each frame adds 1, a gap is a lost frame
    image: int  # number of the last pushed image, 0 before the first
    clock: int  # monotonic clock of the camera's machine at exposure [us]


def strip_rows(width: int) -> int:
    """Rows that the strip adds to images of `width` columns [px]. Raises ValueError below the width of a block."""
    if width < BLOCK[1]:
        raise ValueError(f"a stamp needs pictures at least {BLOCK[1]} px wide, got {width}")
    return -(-BITS // (width // BLOCK[1])) * BLOCK[0]


def draw(image: NDArray[np.uint8], stamp: Stamp) -> NDArray[np.uint8]:
    """Image (H, W, 3) -> (H + strip_rows(W), W, 3), with the strip below it. Raises ValueError for numbers that do not
    fit (frame and image: 32 bits without wrapping; clock: 64 bits)."""
    try:
        fields = _FIELDS.pack(stamp.frame, stamp.image, stamp.clock)
    except struct.error as error:
        raise ValueError(f"{stamp} does not fit its strip: {error}") from None
    width = image.shape[1]
    columns = width // BLOCK[1]
    bits = np.zeros(strip_rows(width) // BLOCK[0] * columns, dtype=np.uint8)
    bits[:BITS] = np.unpackbits(np.frombuffer(fields + _CHECK.pack(zlib.crc32(fields)), dtype=np.uint8))
    blocks = np.repeat(np.repeat(255 * bits.reshape(-1, columns), BLOCK[0], axis=0), BLOCK[1], axis=1)
    strip = np.zeros((blocks.shape[0], width, 3), dtype=np.uint8)
    strip[:, : blocks.shape[1]] = blocks[:, :, None]
    return np.concatenate([image, strip])


def read(image: NDArray[np.uint8]) -> Stamp | None:
    """The stamp of an image (H + strip_rows(W), W, 3); None without a stamp or with a damaged one."""
    width = image.shape[1]
    if width < BLOCK[1] or image.shape[0] < strip_rows(width):
        return None
    columns = width // BLOCK[1]
    strip = image[image.shape[0] - strip_rows(width) :, : columns * BLOCK[1]]
    means = strip.reshape(-1, BLOCK[0], columns, BLOCK[1], 3).mean(axis=(1, 3, 4))
    data = np.packbits(means.ravel()[:BITS] > 127.5).tobytes()
    fields, check = data[: _FIELDS.size], data[_FIELDS.size :]
    if check != _CHECK.pack(zlib.crc32(fields)):
        return None
    return Stamp(*_FIELDS.unpack(fields))


def split(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Stamp | None]:
    """The image without its strip (a view), and the contents of the strip."""
    return image[: image.shape[0] - strip_rows(image.shape[1])], read(image)
