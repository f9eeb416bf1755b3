"""Real group: presses of a ball on a real sensor, predicted by a calibration from other presses; and the labels of such
sets.

A folder of frames may have its own labels, `balls.yaml`; otherwise those of public sets apply
(`references/balls.yaml`). The labels give only ball radius and pixel pitch: circles, skirt and light are fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from benchmarks.cases.real.labels import BadData, Positive, read_picture
from benchmarks.harness.measure import Measurement, Timing
from benchmarks.harness.runner import Case
from tacsim.interface import Image
from tacsim.models.quantity import Config

if TYPE_CHECKING:
    from calibration.light.fit import PressPrediction
from calibration.light.fit import LightFit

CASE = "ball_presses"
OWN = "balls.yaml"
SHIPPED = Path(__file__).parents[2] / "references" / OWN
MIN_PRESSES = 3
MAX_ARCHIVE_BYTES = 1 << 30  # size of an archive [bytes]

Frames = tuple[tuple[str, Image], ...]


class BallSet(Config):
    """Presses of one ball on one sensor, and a picture without contact."""

    name: str
    source: str = ""
    frames: tuple[str, ...] = ()  # patterns below the user's folder; the first with matches is used
    backgrounds: tuple[str, ...] = ()  # relative to the folder of the frames; the first that exists is used
    archive: tuple[str, ...] = ()  # or an .npz with `images` (n, H, W, 3) and `background` (H, W, 3), uint8
    # a table next to the frames: a heading, then name, x, y, radius [px] of the clicked contacts; an archive has
    # `contact_centre_px` (n, 2) and `contact_radius_px` (n,) instead
    circles: str = ""
    blue_first: bool = False  # of an archive: its channels are B, G, R
    dots: bool = False  # are printed on the gel: removed from all pictures
    ball_radius: Positive  # [m]
    pixel_pitch: Positive  # [m]

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if bool(self.frames) == bool(self.archive):
            raise ValueError("give either frames (patterns of pictures) or archive (an .npz)")
        if self.frames and not self.backgrounds:
            raise ValueError("give backgrounds: the picture without contact")
        return self

    @property
    def wanted(self) -> str:
        """The file patterns, as text."""
        return " or ".join(self.frames or self.archive)


class BallSets(Config):
    """The content of a labels file."""

    sets: Annotated[tuple[BallSet, ...], Field(min_length=1)]


def read_sets(folder: Path) -> tuple[BallSet, ...]:
    """The sets that apply to `folder`. Raises ConfigError for labels with errors."""
    from tacsim.config import load_model

    own = folder / OWN
    return load_model(BallSets, own if own.is_file() else SHIPPED).sets


def has_frames(folder: Path, of: BallSet) -> bool:
    """True if `folder` has frames of the set."""
    return any(next(folder.rglob(pattern), None) is not None for pattern in of.frames or of.archive)


def read_balls(folder: Path, of: BallSet) -> tuple[Image, Frames]:
    """The picture without contact, and names and pictures of the presses, (H, W, 3) RGB; without dots. Raises
    BadData."""
    reference, frames = _of_archive(folder, of) if of.archive else _of_pictures(folder, of)
    if len(frames) < MIN_PRESSES:
        raise BadData(f"{of.name}: {len(frames)} presses; at least {MIN_PRESSES} are needed to leave one out")
    return _without_dots(of, reference, frames) if of.dots else (reference, frames)


@lru_cache(maxsize=4)
def calibrated(folder: Path, of: BallSet) -> tuple[LightFit, float, float]:
    """The calibration by all presses of a set, and its wall and processor time [s], with the predictions of left-out
    presses. Raises BadData."""
    from calibration.errors import BadFrames
    from calibration.light.calibrator import calibrate_light

    reference, frames = read_balls(folder, of)
    wall, cpu = perf_counter(), process_time()
    try:
        fit = calibrate_light(reference, frames, of.ball_radius / of.pixel_pitch)
    except BadFrames as error:
        raise BadData(f"{of.name}: {error}") from None
    return fit, perf_counter() - wall, process_time() - cpu


def ball_presses(folder: Path, of: BallSet, repeat: int) -> list[Measurement]:
    """Each press of a ball predicted from all others: picture and normals. Seconds: of calibration and predictions."""
    fit, wall, cpu = calibrated(folder, of)
    if not fit.predictions:
        raise BadData(f"{of.name}: only one press can be used; the others: {fit.left_out}")
    predictions, note = fit.predictions, f"{len(fit.left_out)} frames left out" if fit.left_out else ""
    timing = Timing((wall,), cpu)
    figures = {
        "ncc": _mean_of(predictions, "correlation"),
        "null_grey": _mean_of(predictions, "null_error"),
        **_interval("grey", [prediction.error for prediction in predictions]),
        "presses": float(len(predictions)),
        "left_out": float(len(fit.left_out)),
        "weights": 3.0 * fit.size.terms if fit.size else 0.0,
        "steepest": fit.forward.steepest if fit.forward else 0.0,
    }
    picture = Measurement(
        timing, _mean_of(predictions, "error"), "grey",
        "the real frame where r < 1.5 contact radii, its drift removed; "
        "light by all other presses, circles and skirt by all", f"{of.name}: picture", None, figures, note,
    )  # fmt: skip
    flat = [float(np.degrees(np.arctan(_usual_slope(prediction, of)))) for prediction in predictions]
    figures = {
        "null_deg": float(np.mean(flat)),
        **_interval("deg", [prediction.angle for prediction in predictions]),
        "untouched_deg": _mean_of(predictions, "untouched_angle"),
    }
    normals = Measurement(
        timing, _mean_of(predictions, "angle"), "deg", "normals of ball and skirt inside the contact circle",
        f"{of.name}: normals", None, figures, note,
    )  # fmt: skip
    return [picture, normals]


def cases(folder: Path) -> tuple[Case, ...]:
    """A case for each set, all but the first long; sets without frames are marked as missing. Raises ConfigError."""
    sets = read_sets(folder)
    available = [of for of in sets if has_frames(folder, of)]
    return tuple(
        Case(
            "real", CASE, "tacsim", f"{of.pixel_pitch * 1e3:.3g} mm a pixel", partial(ball_presses, folder, of),
            cpu=True,
            long=of in available[1:],
            missing="" if of in available else f"{of.name}: no {of.wanted} below {folder}",
        )
        for of in sets
    )  # fmt: skip


def _mean_of(predictions: Sequence[PressPrediction], what: str) -> float:
    return float(np.mean([getattr(prediction, what) for prediction in predictions]))


def _interval(unit: str, values: Sequence[float]) -> dict[str, float]:
    """Median, and 95 % interval of the mean by bootstrap over presses."""
    from calibration.compare.compare import bootstrap_interval

    low, high = bootstrap_interval(np.array(values))
    return {f"median_{unit}": float(np.median(values)), f"low_{unit}": low, f"high_{unit}": high}


def _usual_slope(prediction: PressPrediction, of: BallSet) -> float:
    """Slope of the ball half-way between centre and rim, by area: the error of a flat surface."""
    ball, r = of.ball_radius / of.pixel_pitch, prediction.circle.radius / np.sqrt(2)
    return float(r / np.sqrt(ball**2 - r**2))


def _without_dots(of: BallSet, reference: Image, frames: Frames) -> tuple[Image, Frames]:
    from calibration.markers.dots import DotEraser, NoLattice
    from calibration.markers.flow import find_markers

    try:
        _, radius = find_markers(reference)
    except NoLattice as error:
        raise BadData(f"{of.name}: {error}") from None
    erase = DotEraser(radius)
    return erase(reference), tuple((name, erase(image)) for name, image in frames)


def _of_pictures(folder: Path, of: BallSet) -> tuple[Image, Frames]:
    paths = next((found for pattern in of.frames if (found := sorted(folder.rglob(pattern)))), [])
    homes = {path.parent for path in paths}
    if not paths:
        raise BadData(f"{folder} and the folders below it hold no {of.wanted}")
    if len(homes) > 1:
        raise BadData(f"{of.name} exists twice: {' and '.join(map(str, sorted(homes)))}. Name one of them")
    home = homes.pop()
    background = next((path for name in of.backgrounds if (path := home / name).is_file()), None)
    if background is None:
        raise BadData(f"{home} has no frame without contact; looked for {', '.join(of.backgrounds)}")
    return read_picture(background), tuple((path.name, read_picture(path)) for path in paths if path != background)


def _of_archive(folder: Path, of: BallSet) -> tuple[Image, Frames]:
    path = next((found for pattern in of.archive for found in sorted(folder.rglob(pattern))), None)
    if path is None:
        raise BadData(f"{folder} and the folders below it hold no {of.wanted}")
    try:
        if path.stat().st_size > MAX_ARCHIVE_BYTES:
            raise BadData(f"{path} is larger than {MAX_ARCHIVE_BYTES >> 30} GiB")
        with np.load(path, allow_pickle=False) as archive:
            images, reference = archive["images"], archive["background"]
    except (OSError, ValueError, KeyError) as error:
        raise BadData(f"{path}: needs arrays `images` and `background` without pickles: {error}") from None
    if images.ndim != 4 or images.shape[1:] != reference.shape or reference.shape[-1] != 3:
        raise BadData(
            f"{path}: `images` are {images.shape}, `background` {reference.shape}; (n, H, W, 3) and (H, W, 3)"
        )
    if images.dtype != np.uint8 or reference.dtype != np.uint8:
        raise BadData(f"{path}: `images` and `background` must be uint8")
    step = -1 if of.blue_first else 1
    return (
        np.ascontiguousarray(reference[..., ::step]),
        tuple((f"press {k}", np.ascontiguousarray(image[..., ::step])) for k, image in enumerate(images)),
    )
