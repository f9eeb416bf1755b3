"""A height map in false colours with a scale. By Pillow and OpenCV, which a press needs anyway: importing matplotlib
takes longer than the press."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

WIDTH, MARGIN, BAR, TEXT = 800, 60, 20, 16  # of the whole, round the map, of the scale, of a letter [px]
TICKS = 5
TITLE = "height into the gel [mm]; contact outlined"


def write_height_picture(path: Path, height: NDArray[np.float32], contact: NDArray[np.bool_], pitch: float) -> None:
    """A PNG of `height` (H, W) [m], with the border of `contact` (H, W); `pitch`: of its pixels [m]. Raises OSError."""
    import cv2
    from PIL import Image, ImageDraw, ImageFont

    rows, columns = height.shape
    wide = WIDTH - 3 * MARGIN - BAR
    high = round(wide * rows / columns)
    low, top = float(height.min()), float(height.max())
    levels = np.rint((height - low) * (255 / max(top - low, 1e-12))).astype(np.uint8)
    large = cv2.resize(levels, (wide, high), interpolation=cv2.INTER_LINEAR)
    scale = np.repeat(np.linspace(255, 0, high).astype(np.uint8)[:, None], BAR, axis=1)
    colours, bar = (cv2.applyColorMap(each, cv2.COLORMAP_VIRIDIS)[..., ::-1] for each in (large, scale))
    colours = np.ascontiguousarray(colours)
    touching = cv2.resize(contact.astype(np.uint8), (wide, high), interpolation=cv2.INTER_NEAREST)
    borders, _ = cv2.findContours(touching, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if not contact.all():
        cv2.drawContours(colours, borders, -1, (255, 255, 255), 1, cv2.LINE_AA)

    picture = Image.new("RGB", (WIDTH, high + 2 * MARGIN), "white")
    picture.paste(Image.fromarray(colours), (MARGIN, MARGIN))
    left = MARGIN + wide + MARGIN // 2
    picture.paste(Image.fromarray(np.ascontiguousarray(bar)), (left, MARGIN))
    pen = ImageDraw.Draw(picture, "RGB")
    pen.font = ImageFont.load_default(TEXT)
    pen.text((MARGIN + wide / 2, MARGIN / 2), TITLE, "black", anchor="mm")
    half = columns * pitch * 5e2, rows * pitch * 5e2  # [mm]
    for share in np.linspace(0.0, 1.0, TICKS):
        x, y = MARGIN + share * wide, MARGIN + share * high
        pen.text((x, MARGIN + high + MARGIN / 4), f"{(2 * share - 1) * half[0]:.3g}", "black", anchor="mm")
        pen.text((MARGIN - 8, y), f"{(2 * share - 1) * half[1]:.3g}", "black", anchor="rm")
        pen.text((left + BAR + 8, y), f"{(top - share * (top - low)) * 1e3:.3f}", "black", anchor="lm")
    pen.text((MARGIN + wide / 2, 1.65 * MARGIN + high), "x [mm]; y downwards", "black", anchor="mm")
    picture.save(path, compress_level=4)
