"""One side of a comparison: the frames of one sensor, and what it shows without contact.

A side is a folder of pictures, a video, or one sensor of an episode. Simulated presses make theirs by themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.lens.rectification import BadCorners, Corners
from calibration.lens.view import GelView
from calibration.light.image_folder import MEDIAN_OF, UNTOUCHED, metric_picture, named_untouched
from calibration.reference import SATURATED
from tacsim.interface import SurfaceMap
from tacsim.record.episode import EpisodeError
from tacsim.record.images import read_image, reference_image
from tacsim.record.sources import (
    EPISODES,
    VIDEOS,
    episode_frames,
    episode_meta,
    list_pictures,
    only_or_named,
    unknown_source,
    video_images,
)

Image = NDArray[np.uint8]

MOST = 500  # frames of a side
LARGEST = 2 << 30  # [bytes] of the pictures of a side
BURNT = 0.05  # share of a contact that may be saturated
DRIFTED = 4.0  # median change of the gel outside contact that makes a reference stale [grey levels]


class BadSide(ValueError):
    """Frames that cannot be compared: what is wrong, with which, and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One frame."""

    name: str
    image: Image  # (H, W, 3) RGB
    surface: SurfaceMap | None = None  # only from simulations, which know it


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """The frames of one sensor. All pictures have one size."""

    name: str
    reference: Image  # (H, W, 3) RGB without contact
    reference_from: str  # where it comes from, in words
    shots: tuple[Shot, ...]
    untouched: tuple[Shot, ...] = ()  # more frames without contact, that somebody has named so

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (self.reference.shape[0], self.reference.shape[1])


def read_side(path: Path, reference: Path | None = None, sensor: str = "") -> Side:
    """Reads a folder of pictures, a video, or an episode's `sensor` (not needed where there is one only).

    `reference`: the picture without contact; None: the episode's own, a picture of the folder with a name of
    calibration.light.image_folder.UNTOUCHED, or the median of all frames. Raises BadSide.
    """
    try:
        if path.is_dir():
            return _of_folder(path, reference)
        if path.is_file() and path.suffix.lower() in EPISODES:
            return _of_episode(path, reference, sensor)
        if path.is_file() and path.suffix.lower() in VIDEOS:
            shots = _kept(path, (Shot(f"frame {k}", image) for k, image in enumerate(video_images(path))))
            return _side(path, shots, reference, None)
        raise unknown_source(path)
    except EpisodeError as error:
        raise BadSide(str(error)) from None


def doubts(image: NDArray[np.floating], reference: NDArray[np.floating], contact: NDArray[np.bool_]) -> list[str]:
    """What is wrong with a frame, in words: its picture and reference (H, W, 3) [grey levels], its contact (H, W)."""
    found = []
    if not contact.any():
        found.append("no contact")
    else:
        burnt = float((image[contact] >= SATURATED).any(axis=1).mean())
        if burnt > BURNT:
            found.append(f"saturated: {burnt:.0%} of the contact")
    change = (image - reference)[~contact]
    if len(change) and (drift := float(np.abs(np.median(change, axis=0)).max())) > DRIFTED:
        found.append(f"stale reference: the untouched gel has changed by {drift:.0f} grey levels")
    return found


def through_corners(side: Side, corners: Corners, shape: tuple[int, int]) -> Side:
    """The side seen straight on: the quadrangle of its gel's corners becomes a picture of `shape` (rows, columns).

    Raises calibration.lens.rectification.BadCorners.
    """
    import cv2

    from calibration.lens.rectification import from_corners
    from tacsim.optics.grid import PixelGrid

    rows, columns = shape
    grid = PixelGrid(rows, columns, 1.0, -(columns - 1) / 2, -(rows - 1) / 2)
    rectify = from_corners(corners, (float(columns), float(rows)), side.shape, grid)
    if not rectify.valid.all():
        raise BadCorners(f"corners {corners!r} reach beyond the picture; all of the gel must be seen")

    return _seen(side, lambda image: np.asarray(cv2.convertScaleAbs(rectify(image)), dtype=np.uint8))


def through_view(side: Side, view: GelView) -> Side:
    """The side as metric pictures of the gel. Raises BadSide for pictures of another size than the view's."""
    if side.shape != view.image_shape:
        raise BadSide(
            f"{side.name} is {side.shape[1]} x {side.shape[0]} px, the view of its calibration is of {view.lens.width} "
            f"x {view.lens.height}; it belongs to another sensor or setting"
        )
    return _seen(side, metric_picture(view))


def _seen(side: Side, through: Callable[[Image], Image]) -> Side:
    """All pictures of a side, changed."""

    def shots(of: tuple[Shot, ...]) -> tuple[Shot, ...]:
        return tuple(Shot(shot.name, through(shot.image), shot.surface) for shot in of)

    return Side(side.name, through(side.reference), side.reference_from, shots(side.shots), shots(side.untouched))


def rectangle(corners: Corners) -> tuple[int, int]:
    """Rows and columns of the picture that the quadrangle of a gel's corners fills, without loss of detail."""
    points = np.array(corners, dtype=np.float64)
    sides = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    return max(16, round(max(sides[1], sides[3]))), max(16, round(max(sides[0], sides[2])))


def _of_folder(folder: Path, reference: Path | None) -> Side:
    paths = list_pictures(folder)
    named = named_untouched(paths)
    if reference is None and named:
        reference = named.pop(0)
    given = reference.resolve() if reference is not None else None
    wanted = [path for path in paths if path.resolve() != given and path not in named]
    shots = _read(folder, wanted)
    return _side(folder, shots, reference, None, tuple(_read(folder, named)))


def _read(folder: Path, paths: list[Path]) -> list[Shot]:
    """Pictures of a folder. Raises BadSide that names every one which cannot be read."""
    unreadable: list[str] = []

    def shots() -> Iterator[Shot]:
        for path in paths:
            try:
                yield Shot(path.name, read_image(path))
            except EpisodeError as error:
                unreadable.append(str(error))

    read = _kept(folder, shots())
    if unreadable:
        raise BadSide("\n".join(unreadable))
    return read


def _of_episode(path: Path, reference: Path | None, sensor: str) -> Side:
    meta = episode_meta(path)
    name = only_or_named(list(meta.spec.sensors), sensor, path, "sensor")
    frames = (frame for frame, _ in episode_frames(path, name))
    shots = _kept(path, (Shot(f"step {k}", frame.image, frame.surface) for k, frame in enumerate(frames)))
    return _side(path, shots, reference, reference_image(meta.attachments, name))


def _kept(path: Path, shots: Iterable[Shot]) -> list[Shot]:
    """All frames, as long as they are not too many."""
    kept: list[Shot] = []
    memory = 0
    for shot in shots:
        kept.append(shot)
        memory += shot.image.nbytes
        if len(kept) > MOST or memory > LARGEST:
            raise BadSide(
                f"{path} holds more than {MOST} frames, or more than {LARGEST >> 30} GiB of them; compare a part of it"
            )
    return kept


def _side(
    path: Path, shots: list[Shot], reference: Path | None, own: Image | None, untouched: tuple[Shot, ...] = ()
) -> Side:
    """Puts a side together: its reference is the picture that was named, the recording's own, or the median."""
    if not shots:
        raise BadSide(f"{path} holds no frame beside the one without contact")
    if reference is not None:
        picture, source = read_image(reference), reference.name
    elif own is not None:
        picture, source = own, "the recording's own"
    elif len(shots) >= MEDIAN_OF:
        picture, source = _median(shots), f"median of {len(shots)} frames"
    else:
        raise BadSide(
            f"{path} holds no frame without contact; name one (--reference-a, --reference-b), or call it "
            f"{UNTOUCHED[0]}.png. Without, {MEDIAN_OF} frames with contacts in different places are needed, whose "
            "median stands for it"
        )
    other = next((shot for shot in (*shots, *untouched) if shot.image.shape != picture.shape), None)
    if other is not None:
        raise BadSide(
            f"{path}: {other.name} is {other.image.shape[1]} x {other.image.shape[0]} px, the picture without contact "
            f"({source}) {picture.shape[1]} x {picture.shape[0]}; all must be of one camera and one setting"
        )
    return Side(str(path), picture, source, tuple(shots), untouched)


def _median(shots: list[Shot]) -> Image:
    median: Image = np.median(np.stack([shot.image for shot in shots]), axis=0).astype(np.uint8)
    return median
