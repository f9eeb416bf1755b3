"""Reads and writes pictures: lossless PNG for the recorder; reads PNG, JPEG and BMP, and checks sizes before
decoding."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import TactileFrame
from tacsim.optics.picture_file import (
    FORMATS,
    MAX_SIDE,
    BadPicture,
    check_size,
    open_picture,
    upright_rgb,
    upright_size,
)
from tacsim.record.episode import EpisodeError

if TYPE_CHECKING:
    from PIL.Image import Image

_REFERENCE = "reference/{}.png"  # attachment with the contact-free picture of a sensor


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Lossless PNG of an (H, W, 3) uint8 RGB picture. Raises ValueError for any other shape, type or size."""
    import cv2

    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image must be (H, W, 3) uint8 RGB, got {image.shape} {image.dtype}")
    check_size(image.shape[1], image.shape[0], "image")
    # OpenCV's default (level 1, run lengths) is twice as fast as asking for level 1, which also resets the strategy.
    written, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not written:
        raise ValueError(f"OpenCV could not encode an image of shape {image.shape}")
    return data.tobytes()


def decode_image(
    data: bytes, what: str, formats: tuple[str, ...] = FORMATS, size: tuple[int, int] | None = None
) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB picture from an encoded one with 8 bits a channel, rotated by its EXIF orientation.

    Raises EpisodeError that names `what`, for unreadable data, and, before decoding, for pictures larger than MAX_SIDE,
    with more than 8 bits a channel, or with other rows and columns than `size`.
    """
    with _open_image(io.BytesIO(data), what, formats) as picture:
        rows, columns = upright_size(picture)
        if size is not None and (rows, columns) != size:
            found = f"{columns} x {rows} pixels"
            raise BadPicture(f"{what}: {found}, but others of this sensor have {size[1]} x {size[0]}")
        return upright_rgb(picture, what)


@contextmanager
def _open_image(source: Path | io.BytesIO, what: str, formats: tuple[str, ...]) -> Iterator[Image]:
    """See `open_picture`. Raises EpisodeError."""
    try:
        with open_picture(source, what, formats) as picture:
            yield picture
    except BadPicture as failure:
        raise EpisodeError(str(failure)) from failure.__cause__


def read_image(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB picture of a file, see `decode_image`. Raises EpisodeError that names the file."""
    try:
        size = path.stat().st_size
        if size > 4 * MAX_SIDE * MAX_SIDE:  # more than any uncompressed picture within the limit needs
            raise EpisodeError(f"{path}: {size} bytes is too much for a picture of at most {MAX_SIDE} x {MAX_SIDE}")
        data = path.read_bytes()
    except OSError as failure:
        raise EpisodeError(f"{path}: cannot be read: {failure.strerror}") from failure
    return decode_image(data, str(path))


def image_size(path: Path) -> tuple[int, int]:
    """(rows, columns) of a picture file as returned by `read_image`, from its header. Raises EpisodeError that names
    the file."""
    with _open_image(path, str(path), FORMATS) as picture:
        return upright_size(picture)


def reference_attachments(references: Mapping[str, TactileFrame]) -> dict[str, bytes]:
    """Contact-free frames by sensor, as attachments of an episode; a replay normalises with them."""
    return {_REFERENCE.format(name): encode_png(frame.image) for name, frame in references.items()}


def reference_image(attachments: Mapping[str, bytes], sensor: str) -> NDArray[np.uint8] | None:
    """The (H, W, 3) contact-free picture of a sensor among an episode's attachments; None when there is none."""
    name = _REFERENCE.format(sensor)
    return decode_image(attachments[name], f"attachment '{name}'") if name in attachments else None
