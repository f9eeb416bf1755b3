"""Pictures from disk: what 8-bit RGB cannot hold is refused, and a picture is turned as its orientation says."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tacsim.models.sensor import Lighting, SensorGeometry, SensorModel
from tacsim.optics.render import Renderer
from tacsim.record.episode import EpisodeError
from tacsim.record.images import image_size, read_image
from tacsim.record.sources import list_pictures

ROWS, COLUMNS = 24, 32
RANDOM = np.random.default_rng(0)
DEEP = RANDOM.integers(0, 4096, (ROWS, COLUMNS, 4), dtype=np.uint16)  # 12 bits in 16


def saved(path: Path, image: Image.Image, kind: str, **more: object) -> Path:
    image.save(path, kind, **more)
    return path


def encoded(path: Path, values: np.ndarray, ending: str) -> Path:
    path.write_bytes(cv2.imencode(ending, values)[1].tobytes())
    return path


def gradient() -> Image.Image:
    """No two corners are alike."""
    v, u = np.mgrid[:ROWS, :COLUMNS]
    return Image.fromarray(np.stack([8 * u, 10 * v, 0 * u + 60], axis=-1).astype(np.uint8))


TOO_DEEP: dict[str, Callable[[Path], Path]] = {
    "16-bit colour PNG": lambda folder: encoded(folder / "p.png", DEEP[..., :3], ".png"),
    "16-bit colour PNG with alpha": lambda folder: encoded(folder / "p.png", DEEP, ".png"),
    "16-bit grey PNG": lambda folder: encoded(folder / "p.png", DEEP[..., 0], ".png"),
    "16-bit TIFF called PNG": lambda folder: encoded(folder / "p.png", DEEP[..., :3], ".tiff"),
    "float TIFF called PNG": lambda folder: encoded(folder / "p.png", DEEP[..., 0].astype(np.float32), ".tiff"),
    "CMYK": lambda folder: saved(folder / "p.jpg", gradient().convert("CMYK"), "JPEG"),
}


@pytest.mark.parametrize("name", TOO_DEEP)
def test_a_picture_of_more_than_8_bits_is_refused_wherever_it_is_read(name: str, tmp_path: Path) -> None:
    path = TOO_DEEP[name](tmp_path)
    for read in (read_image, image_size, lambda path: list_pictures(path.parent)):
        with pytest.raises(EpisodeError, match=r"p\.(png|jpg): .*(8 bits a channel|8-bit PNG)"):
            read(path)
    model = SensorModel(
        geometry=SensorGeometry(width=COLUMNS, height=ROWS, pixel_pitch=1e-4),
        lighting=Lighting(background=str(path)), texture=0.0,
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"lighting.background: .*(8 bits a channel|8-bit PNG)"):
        Renderer(model, (20e-3, 20e-3))


def test_grey_palette_and_opaque_pictures_are_read(tmp_path: Path) -> None:
    grey = gradient().convert("L")
    opaque = gradient().convert("RGBA")
    for image, expected in (
        (grey, grey.convert("RGB")),
        (opaque, gradient()),
        (grey.convert("P"), grey.convert("RGB")),
    ):
        assert np.array_equal(read_image(saved(tmp_path / "p.png", image, "PNG")), np.array(expected))


def test_transparent_pixels_are_refused(tmp_path: Path) -> None:
    image = gradient().convert("RGBA")
    image.putpixel((3, 3), (0, 0, 0, 0))
    with pytest.raises(EpisodeError, match=r"p\.png: has transparent pixels"):
        read_image(saved(tmp_path / "p.png", image, "PNG"))
    with pytest.raises(EpisodeError, match=r"p\.png: has transparent pixels"):
        read_image(saved(tmp_path / "p.png", gradient().convert("P"), "PNG", transparency=bytes(256)))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("kind", "ending"), [("JPEG", "jpg"), ("PNG", "png")])
def test_the_orientation_is_applied_as_viewers_do(kind: str, ending: str, orientation: int, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = saved(tmp_path / f"p.{ending}", gradient(), kind, exif=exif)
    shown = cv2.imread(str(path), cv2.IMREAD_COLOR)  # applies it
    assert shown is not None
    picture = read_image(path)
    assert picture.shape == shown.shape and image_size(path) == picture.shape[:2]
    assert np.abs(picture.astype(int) - shown[..., ::-1]).max() <= 3
    assert (picture.shape[0] == COLUMNS) == (orientation >= 5)


def test_a_folder_with_one_turned_picture_is_refused(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    saved(tmp_path / "0.jpg", gradient(), "JPEG")
    saved(tmp_path / "1.jpg", gradient(), "JPEG", exif=exif)
    with pytest.raises(EpisodeError, match=r"1\.jpg: 24 x 32 pixels, but 0\.jpg has 32 x 24"):
        list_pictures(tmp_path)


def test_a_format_that_is_not_read_is_named(tmp_path: Path) -> None:
    data = io.BytesIO()
    gradient().save(data, "GIF")
    (tmp_path / "p.png").write_bytes(data.getvalue())
    with pytest.raises(EpisodeError, match=r"p\.png: no readable picture .*: the file is GIF; save it as 8-bit PNG"):
        read_image(tmp_path / "p.png")
