"""Frames of one sensor and its picture without contact: from a folder of pictures, a video, or an episode's sensor.

A calibration uses one frame set, a comparison two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.errors import BadFrames
from calibration.lens.rectification import metric_rectification, rectification_of_corners, region_mask
from calibration.lens.view import BadCorners, Corners, GelView
from calibration.reference import contact_area, is_contact_image_swapped
from calibration.tuning import MAX_REFERENCE_CHANGE, MIN_CONTACT_SHARE, SATURATED_LEVEL
from tacsim.interface import Image, SurfaceMap, short_repr
from tacsim.models.sensor import PictureRegion
from tacsim.optics.grid import PixelGrid
from tacsim.record.episode import EpisodeError
from tacsim.record.images import read_image, reference_image
from tacsim.record.ros_bag import is_ros_bag, open_topic
from tacsim.record.sources import (
    EPISODES,
    VIDEOS,
    episode_frames,
    episode_meta,
    list_pictures,
    select_name,
    unknown_source_error,
    video_images,
)

UNTOUCHED_NAMES = ("background", "reference", "ref", "empty", "no_contact", "bg", "frame0")  # of pictures, best first
MAX_FRAMES = 500


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture."""

    __repr__ = short_repr
    name: str
    image: Image  # (H, W, 3) RGB
    surface: SurfaceMap | None = None  # only from simulations


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """The frames of one sensor, all of one size."""

    __repr__ = short_repr
    name: str
    reference: Image  # (H, W, 3) RGB without contact
    reference_from: str  # description of its source
    frames: tuple[Frame, ...]
    untouched: tuple[Frame, ...] = ()  # more frames without contact
    estimated: bool = False  # the reference is the median of `frames`
    simulated: bool = False  # True for rendered frames
    same_pixels: bool = False  # made in the pixels of the frames that it is compared with, under their names
    notes: tuple[str, ...] = ()  # notes

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (self.reference.shape[0], self.reference.shape[1])

    @property
    def untouched_images(self) -> tuple[Image, ...]:
        """All pictures without contact, the reference first; empty if it is only estimated."""
        return () if self.estimated else (self.reference, *(frame.image for frame in self.untouched))


def read_frame_set(path: Path, reference: Path | None = None, sensor: str = "") -> FrameSet:
    """Reads a folder of pictures, a video, an episode's `sensor` (not needed where there is one only), or the topic
    `sensor` of a ROS 2 bag.

    `reference`: the picture without contact; None: the episode's own, a picture of the folder with one of
    UNTOUCHED_NAMES, or the median of all frames. Raises BadFrames.
    """
    try:
        if is_ros_bag(path):
            topic = open_topic(path, sensor or None, "sensor")
            frames = _read_limited(path, (Frame(f"message {each.index}", each.image) for each in topic.frames()))
            return _make_frame_set(path, frames, reference, None)
        if path.is_dir():
            return read_folder(path, reference)
        if path.is_file() and path.suffix.lower() in EPISODES:
            meta = episode_meta(path)
            name = select_name(list(meta.spec.sensors), sensor, path, "sensor")
            recorded = (frame for frame, _ in episode_frames(path, name))
            frames = _read_limited(
                path, (Frame(f"step {k}", each.image, each.surface) for k, each in enumerate(recorded))
            )
            return _make_frame_set(path, frames, reference, reference_image(meta.attachments, name))
        if path.is_file() and path.suffix.lower() in VIDEOS:
            frames = _read_limited(path, (Frame(f"frame {k}", image) for k, image in enumerate(video_images(path))))
            return _make_frame_set(path, frames, reference, None)
        raise unknown_source_error(path)
    except EpisodeError as error:
        raise BadFrames(str(error)) from None


def read_folder(folder: Path, reference: Path | None = None, max_frames: int = MAX_FRAMES) -> FrameSet:
    """Reads all pictures of a folder. `reference` as for :func:`read_frame_set`; all other pictures with one of
    UNTOUCHED_NAMES show no contact either. Raises BadFrames, which names the pictures that cannot be read."""
    if not folder.is_dir():
        raise BadFrames(f"{folder} is no folder; name the folder that holds the frames")
    try:
        paths = list_pictures(folder)
        untouched = select_untouched(paths)
        if reference is None and untouched:
            reference = untouched[0]
        given = None if reference is None else reference.resolve()
        untouched = [path for path in untouched if path.resolve() != given]
        others = [path for path in paths if path.resolve() != given and path not in untouched]
        frames = _read_images(folder, others, max_frames)
        return _make_frame_set(folder, frames, reference, None, tuple(_read_images(folder, untouched, max_frames)))
    except EpisodeError as error:
        raise BadFrames(str(error)) from None


def select_untouched(paths: Iterable[Path]) -> list[Path]:
    """Pictures without contact by their names: background.png, background_2.png, ...; frame0.png only with just this
    name. In the order of UNTOUCHED_NAMES, those with a number last."""
    rank = {name: place for place, name in enumerate(UNTOUCHED_NAMES)}
    numbered = UNTOUCHED_NAMES[: rank["frame0"]]
    found = [
        path for path in paths
        if (stem := path.stem.lower()) in rank or stem.rstrip("0123456789").rstrip("_- ") in numbered
    ]  # fmt: skip
    return sorted(found, key=lambda path: (rank.get(path.stem.lower(), len(rank)), path))


def frame_warnings(
    image: NDArray[np.floating], reference: NDArray[np.floating], contact: NDArray[np.bool_]
) -> list[str]:
    """Errors of a frame, as text, from its picture and reference (H, W, 3) [grey levels], and its contact (H, W)."""
    max_saturated_share = 0.05  # of a contact
    found = []
    if not contact.any():
        found.append("no contact")
    else:
        saturated = float((image[contact] >= SATURATED_LEVEL).any(axis=1).mean())
        if saturated > max_saturated_share:
            found.append(f"saturated: {saturated:.0%} of the contact")
    change = (image - reference)[~contact]
    if len(change) and (drift := float(np.abs(np.median(change, axis=0)).max())) > MAX_REFERENCE_CHANGE:
        if is_contact_image_swapped(image.astype(np.float32), reference.astype(np.float32), ~contact):
            return [*found, "red and blue are swapped: the untouched gel is that of the reference in the other order"]
        found.append(f"stale reference: the untouched gel has changed by {drift:.0f} grey levels")
    return found


def find_touched_references(of: FrameSet) -> list[str]:
    """Notes on pictures without contact that differ from the reference as by a contact, so that one of the two shows a
    contact. Empty if the reference is the only one."""
    mean = np.maximum(of.reference.mean(axis=(0, 1)), 1.0).astype(np.float32)
    everywhere = np.zeros(of.shape, dtype=np.bool_)
    found = []
    for frame in of.untouched:
        change = (frame.image.astype(np.float32) - of.reference) / mean
        if contact_area(change, everywhere, 1.0) > MIN_CONTACT_SHARE * everywhere.size:
            found.append(
                f"{of.name}: {of.reference_from} and {frame.name} differ as by a contact: does the reference show one?"
            )
    return found


def metric_image_map(view: GelView) -> Callable[[Image], Image]:
    """Native picture (H, W, 3) -> metric picture of the gel, both uint8. If the camera has a much finer resolution, its
    picture is first reduced by an integer factor, as means over areas."""
    import cv2

    pixel = np.array([(0.0, 0.0), (view.pixel_pitch, 0.0), (0.0, view.pixel_pitch)])
    middle = view.project(pixel)
    factor = int(np.linalg.norm(middle[1:] - middle[0], axis=1).min())
    if factor < 2:
        rectify = metric_rectification(view)
        return lambda image: np.rint(rectify(image)).astype(np.uint8)
    lens = view.lens
    columns, rows = lens.width // factor, lens.height // factor
    x, y = columns / lens.width, rows / lens.height
    small = lens.model_copy(
        update={
            "width": columns,
            "height": rows,
            "focal": (lens.focal[0] * x, lens.focal[1] * y),
            "centre": ((lens.centre[0] + 0.5) * x - 0.5, (lens.centre[1] + 0.5) * y - 0.5),
        }
    )
    rectify = metric_rectification(view.model_copy(update={"lens": small}))

    def reduced(image: Image) -> Image:
        if image.shape[:2] != view.image_shape:
            raise BadFrames(
                f"the picture has {image.shape[1]} x {image.shape[0]} px, its view {lens.width} x {lens.height}"
            )
        less = np.asarray(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        return np.rint(rectify(less)).astype(np.uint8)

    return reduced


def require_view_size(image_shape: tuple[int, int], view: GelView) -> None:
    """Raises BadFrames unless pictures of `image_shape` (rows, columns) are those of the view."""
    if image_shape != view.image_shape:
        raise BadFrames(
            f"the frames are {image_shape[1]} x {image_shape[0]} px, the view was calibrated on {view.lens.width} x "
            f"{view.lens.height} px; use the same sensor and one setting of its camera"
        )


def rectified_by_view(frame_set: FrameSet, view: GelView) -> FrameSet:
    """The same as metric pictures of the gel. Raises BadFrames for pictures of another size than the view's."""
    require_view_size(frame_set.shape, view)
    return _map_images(frame_set, metric_image_map(view))


def restrict_to_region(frame_set: FrameSet, region: PictureRegion) -> FrameSet:
    """The same for the polygon `region` [px] only: outside it all pictures are uniform, and none differs from the
    reference by more than the median difference of the gel. Raises BadCorners."""
    shown = region_mask(region, frame_set.shape)
    reference = frame_set.reference
    level = reference[shown].mean(axis=0)

    def even(image: Image) -> Image:
        drift = np.median(image[shown].astype(np.int16) - reference[shown], axis=0)
        filled = image.copy()
        filled[~shown] = np.rint(np.clip(level + drift, 0, 255))
        return filled

    return _map_images(frame_set, even)


def rectified_by_corners(frame_set: FrameSet, corners: Corners, shape: tuple[int, int]) -> FrameSet:
    """The same after rectification: the quadrangle of the gel's corners becomes a picture of `shape` (rows, columns).

    Raises BadCorners.
    """
    import cv2

    rows, columns = shape
    grid = PixelGrid(rows, columns, 1.0, -(columns - 1) / 2, -(rows - 1) / 2)
    rectify = rectification_of_corners(corners, (float(columns), float(rows)), frame_set.shape, grid)
    if not rectify.valid.all():
        raise BadCorners(f"corners {corners!r} are outside the picture; all of the gel must be visible")
    return _map_images(frame_set, lambda image: np.asarray(cv2.convertScaleAbs(rectify(image)), dtype=np.uint8))


def rectified_shape(corners: Corners) -> tuple[int, int]:
    """Rows and columns of the picture that the quadrangle of a gel's corners fills, without loss of detail."""
    points = np.array(corners, dtype=np.float64)
    sides = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    return max(16, round(max(sides[1], sides[3]))), max(16, round(max(sides[0], sides[2])))


def _map_images(of: FrameSet, change: Callable[[Image], Image]) -> FrameSet:
    """All pictures changed."""
    frames, untouched = (
        tuple(Frame(frame.name, change(frame.image), frame.surface) for frame in part)
        for part in (of.frames, of.untouched)
    )
    return replace(of, reference=change(of.reference), frames=frames, untouched=untouched)


def _read_images(folder: Path, paths: list[Path], max_frames: int) -> list[Frame]:
    """Raises BadFrames that names every picture which cannot be read."""
    unreadable: list[str] = []

    def frames() -> Iterator[Frame]:
        for path in paths:
            try:
                yield Frame(path.name, read_image(path))
            except EpisodeError as error:
                unreadable.append(str(error))

    read = _read_limited(folder, frames(), max_frames)
    if unreadable:
        raise BadFrames("\n".join(unreadable))
    return read


def _read_limited(path: Path, frames: Iterable[Frame], max_frames: int = MAX_FRAMES) -> list[Frame]:
    """All frames. Raises BadFrames as soon as there are too many."""
    max_memory = 2 << 30  # of all pictures together [bytes]
    read: list[Frame] = []
    memory = 0
    for frame in frames:
        read.append(frame)
        memory += frame.image.nbytes
        if len(read) > max_frames or memory > max_memory:
            raise BadFrames(
                f"{path} holds more than {max_frames} frames, or {max_memory >> 30} GiB of them; give a part of it"
            )
    return read


def _make_frame_set(
    path: Path, frames: list[Frame], reference: Path | None, own: Image | None, untouched: tuple[Frame, ...] = ()
) -> FrameSet:
    """The reference is the picture that was named, the recording's `own`, or the median."""
    median_count = 5  # the median of this number of frames with contacts in different places is the untouched gel
    if not frames:
        raise BadFrames(f"{path} holds no frame except the one without contact")
    estimated = reference is None and own is None
    if reference is not None:
        picture, source = read_image(reference), reference.name
    elif own is not None:
        picture, source = own, "the recording's own"
    elif len(frames) >= median_count:
        picture = np.median(np.stack([frame.image for frame in frames]), axis=0).astype(np.uint8)
        source = f"median of {len(frames)} frames"
    else:
        raise BadFrames(
            f"{path} holds no frame without contact; name one (--reference; of two sources --reference-a, "
            f"--reference-b), or call it {UNTOUCHED_NAMES[0]}.png. Without, {median_count} frames with contacts in "
            "different places are needed, whose median stands for it"
        )
    other = next((frame for frame in (*frames, *untouched) if frame.image.shape != picture.shape), None)
    if other is not None:
        raise BadFrames(
            f"{path}: {other.name} is {other.image.shape[1]} x {other.image.shape[0]} px, the picture without contact "
            f"({source}) {picture.shape[1]} x {picture.shape[0]}; all must be of one camera and one setting"
        )
    simulated = all(frame.surface is not None for frame in frames)  # a camera measures no surface
    return FrameSet(str(path), picture, source, tuple(frames), untouched, estimated, simulated)
