"""Pictures from disk: the one place that opens PNG, JPEG and BMP files, and refuses what 8-bit RGB cannot hold."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from PIL.Image import Image

FORMATS = ("PNG", "JPEG", "BMP")
MAX_SIDE = 4096  # [px] of a picture, along each axis
TRANSPOSED = range(5, 9)  # values of that tag that exchange rows and columns
MODES = ("RGB", "RGBA", "L", "LA", "P")  # of Pillow, with up to 8 bits a channel
# First bytes of formats that cameras write and that are not read here: they may hold 16 bits or floats.
OTHER_FORMATS = {b"II*\0": "TIFF", b"MM\0*": "TIFF", b"GIF8": "GIF", b"RIFF": "WebP", b"\x76\x2f\x31\x01": "OpenEXR"}


class BadPicture(ValueError):
    """A picture that cannot be read as 8-bit RGB, with its name, and what to do."""


@contextmanager
def open_picture(source: Path | io.BytesIO, what: str, formats: tuple[str, ...] = FORMATS) -> Iterator[Image]:
    """A picture of an allowed size and pixel type, not yet decoded. Raises BadPicture that names `what`, also for
    whatever the decoder raises in the block."""
    from PIL import Image

    try:
        with Image.open(source, formats=formats) as picture:
            check_size(*picture.size, what)
            _check_depth(picture, what)
            yield picture
    except BadPicture:
        raise
    except Exception as failure:  # a decoder that is fed damaged bytes may raise anything
        raise BadPicture(
            f"{what}: no readable picture ({', '.join(formats)}): {_describe_format(source) or failure}"
        ) from failure


def upright_size(picture: Image) -> tuple[int, int]:
    """(rows, columns) of an opened picture after its EXIF orientation is applied, from its header alone."""
    orientation_tag = 0x0112  # EXIF tag
    from PIL import Image

    # not PngImageFile.getexif, which decodes the whole picture to look behind it
    transposed = Image.Image.getexif(picture).get(orientation_tag) in TRANSPOSED
    return (picture.width, picture.height) if transposed else (picture.height, picture.width)


def upright_rgb(picture: Image, what: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of an opened picture, turned as its EXIF orientation says, as viewers and OpenCV's `imread`
    show it. Raises BadPicture for a picture with transparent pixels."""
    from PIL import ImageOps

    if picture.has_transparency_data:
        coloured = picture.convert("RGBA")
        if coloured.getchannel("A").getextrema()[0] != 255:
            raise BadPicture(f"{what}: has transparent pixels, whose colours mean nothing; save it without alpha")
    return np.array(ImageOps.exif_transpose(picture).convert("RGB"))


def check_size(columns: int, rows: int, what: str) -> None:
    """Raises BadPicture for a picture without pixels, or with a side longer than MAX_SIDE."""
    if not (0 < columns <= MAX_SIDE and 0 < rows <= MAX_SIDE):
        raise BadPicture(
            f"{what}: {columns} x {rows} pixels; at least 1 and at most {MAX_SIDE} are allowed along each side"
        )


def _check_depth(picture: Image, what: str) -> None:
    """Pillow opens a PNG of 16 bits a channel as 8-bit RGB and drops the lower bits: a camera's 12 bits in 16 would
    become 4."""
    tiles: Any = getattr(picture, "tile", ())
    raw = str(tiles[0].args) if picture.format == "PNG" and tiles else ""
    if ";16" in raw or picture.mode not in MODES:
        found = "16 bits a channel" if ";16" in raw else f"pixel type '{picture.mode}'"
        raise BadPicture(
            f"{what}: {found}; 8 bits a channel are read, grey or colour. Convert the pictures first: divide by what "
            "the camera's full scale is over 255 (12 bits in 16: by 4095 / 255), round, and save as 8-bit PNG"
        )


def _describe_format(source: Path | io.BytesIO) -> str:
    """In words, which other format the data have; empty for none that is known."""
    try:
        if isinstance(source, io.BytesIO):
            head = source.getvalue()[:4]
        else:
            with source.open("rb") as file:
                head = file.read(4)
    except OSError:
        return ""
    name = OTHER_FORMATS.get(head)
    return f"the file is {name}; save it as 8-bit PNG" if name else ""
