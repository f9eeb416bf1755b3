"""Made-up sources: the same presses of a ball, as one hidden sensor sees them, and in a simulation of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from calibration.bundle import Calibration
from calibration.frame_set import Frame, FrameSet
from calibration.light.calibrator import calibrate_light
from tests.calibration.presses import BALL, BALL_PX, PITCH, HiddenSensor

PLACES = [(70, 60), (190, 140), (130, 100), (60, 150), (200, 60), (100, 50)]
DEPTHS = [0.5e-3, 0.35e-3, 0.65e-3, 0.45e-3, 0.55e-3, 0.3e-3]


def side(
    sensor: HiddenSensor, count: int = 5, name: str = "made", places: list[tuple[int, int]] | None = None
) -> FrameSet:
    """Presses, the same for every sensor, and two more pictures without contact."""
    presses = [
        sensor.press(depth, x, y) for depth, (x, y) in zip(DEPTHS[:count], (places or PLACES)[:count], strict=True)
    ]
    frames = tuple(Frame(f"press_{k}.png", press.image) for k, press in enumerate(presses))
    still = tuple(Frame(f"background_{k}.png", sensor.empty()) for k in (2, 3))
    return FrameSet(name, sensor.empty(), "made up", frames, still)


def changed(of: FrameSet, change: object, what: str = "frames") -> FrameSet:
    """The side with `change` (image -> image) applied to all its pictures; `what`: "all" also changes its reference."""
    assert callable(change)
    frames = tuple(Frame(frame.name, change(frame.image)) for frame in of.frames)
    reference = change(of.reference) if what == "all" else of.reference
    return FrameSet(of.name, reference, of.reference_from, frames, of.untouched if what == "frames" else ())


def blank(like: FrameSet) -> FrameSet:
    """A simulation that draws no contact at all."""
    return FrameSet(
        "blank", like.reference, "made up", tuple(Frame(frame.name, like.reference) for frame in like.frames)
    )


def shifted(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """The picture moved right by x and down by y [px], by Fourier's shift theorem: exact, and unlike any resampling of
    the code under test. Wraps round."""
    frequency_y = np.fft.fftfreq(image.shape[0])[:, None, None]
    frequency_x = np.fft.fftfreq(image.shape[1])[None, :, None]
    spectrum = np.fft.fft2(image.astype(float), axes=(0, 1))
    moved = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * (frequency_x * x + frequency_y * y)), axes=(0, 1)).real
    return np.clip(np.rint(moved), 0, 255).astype(np.uint8)


def save_picture(path: Path, image: np.ndarray) -> None:
    Image.fromarray(image).save(path)


def write_presses(folder: Path) -> Path:
    """A folder of five presses and the picture without contact, called Background, beside what is no picture."""
    sensor = HiddenSensor(2)
    folder.mkdir()
    for i, press in enumerate(sensor.presses(5)):
        save_picture(folder / f"press_{i}.png", press.image)
    save_picture(folder / "Background.png", sensor.empty())
    (folder / "notes.txt").write_text("not a picture", encoding="utf-8")
    return folder


def save(of: FrameSet, folder: Path, reference: str = "background.png") -> Path:
    """Writes a side as a folder of pictures."""
    folder.mkdir(parents=True)
    for name, image in (
        (reference, of.reference),
        *((frame.name, frame.image) for frame in (*of.frames, *of.untouched)),
    ):
        Image.fromarray(image).save(folder / name)
    return folder


def calibrated(sensor: HiddenSensor) -> tuple[Calibration, np.ndarray]:
    """The calibration of a made-up sensor from presses of its own, and its reference."""
    frames = [(f"{k}.png", made.image) for k, made in enumerate(sensor.presses(8))]
    fit = calibrate_light(sensor.empty(), frames, BALL_PX)
    return fit.to_calibration("made", BALL, PITCH), fit.reference
