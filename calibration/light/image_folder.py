"""A folder of frames of presses: which is the one without contact, and what is no picture."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.lens.view import GelView
from calibration.light.ball_press import BadPresses
from tacsim.record.episode import EpisodeError
from tacsim.record.images import read_image

Image = NDArray[np.uint8]

PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
UNTOUCHED = (
    "background",
    "reference",
    "ref",
    "empty",
    "no_contact",
    "bg",
    "frame0",
)  # names of a frame without contact
MOST = 200  # frames that are read
MEDIAN_OF = 5  # frames whose median shows the gel without contact, if they are pressed in different places


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """What a folder holds."""

    reference: Image  # (H, W, 3) RGB
    presses: tuple[tuple[str, Image], ...]  # names and pictures
    estimated: bool  # True: no frame without contact was given, the median of the presses stands for it
    untouched: tuple[Image, ...] = ()  # all frames without contact, `reference` among them, in the order taken


def named_untouched(paths: Iterable[Path]) -> list[Path]:
    """Those whose name says that nothing touches: background.png, background_2.png, ...; frame0.png only with just this
    name. In the order of UNTOUCHED, those with a number last."""
    rank = {name: place for place, name in enumerate(UNTOUCHED)}
    numbered = UNTOUCHED[: rank["frame0"]]
    found = [
        path for path in paths
        if (stem := path.stem.lower()) in rank or stem.rstrip("0123456789").rstrip("_- ") in numbered
    ]  # fmt: skip
    return sorted(found, key=lambda path: (rank.get(path.stem.lower(), len(rank)), path))


def rectified(frames: Frames, view: GelView) -> Frames:
    """The same frames as metric pictures of the gel. Raises BadPresses for pictures of another size than the view's."""
    all_images = (frames.reference, *frames.untouched, *(image for _, image in frames.presses))
    check_size({image.shape[:2] for image in all_images}, view)
    metric = metric_picture(view)
    return Frames(
        metric(frames.reference),
        tuple((name, metric(image)) for name, image in frames.presses),
        frames.estimated,
        tuple(metric(image) for image in frames.untouched),
    )


def check_size(sizes: Collection[tuple[int, ...]], view: GelView) -> None:
    """Raises BadPresses unless pictures of `sizes` (rows, columns) are those of the view."""
    if set(sizes) != {view.image_shape}:
        odd = ", ".join(f"{columns} x {rows}" for rows, columns in sorted(sizes))
        raise BadPresses(
            f"the frames are {odd} px, the view was calibrated on {view.lens.width} x {view.lens.height} px; use one "
            "setting of the camera"
        )


def metric_picture(view: GelView) -> Callable[[Image], Image]:
    """Native picture (H, W, 3) -> metric picture of the gel, both uint8."""
    from calibration.lens.rectification import to_metric

    rectify = to_metric(view)

    def metric(image: Image) -> Image:
        return np.rint(rectify(image)).astype(np.uint8)

    return metric


def read_presses(folder: Path, reference: Path | None = None) -> Frames:
    """Reads all pictures of a folder. `reference`: the one without contact; None: the one with a name of UNTOUCHED, or
    the median of all. Others with such a name show no contact either. Raises BadPresses, naming every file that is no
    picture."""
    if not folder.is_dir():
        raise BadPresses(f"{folder} is no folder; name the folder that holds the frames")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    untouched = named_untouched(paths)
    if reference is None and untouched:
        reference = untouched[0]
    if reference is not None:
        untouched = [reference, *(path for path in untouched if path.resolve() != reference.resolve())]
    known = {path.resolve() for path in untouched}
    pressed = [path for path in paths if path.resolve() not in known]
    if not pressed:
        raise BadPresses(f"{folder} holds no frame of a press ({', '.join(PICTURES)})")
    if len(pressed) > MOST:
        raise BadPresses(f"{folder} holds {len(pressed)} pictures; 5 to 8 presses are enough, {MOST} the most")
    images: dict[Path, Image] = {}
    unreadable = []
    for path in [*untouched, *pressed]:
        try:
            images[path] = read_image(path)
        except EpisodeError as error:
            unreadable.append(str(error))
    if unreadable:
        raise BadPresses("\n".join(unreadable))
    if reference is not None:
        presses = tuple((path.name, images[path]) for path in pressed)
        return Frames(images[reference], presses, False, tuple(images[path] for path in untouched))
    shapes = {image.shape for image in images.values()}
    if len(pressed) < MEDIAN_OF or len(shapes) > 1:
        raise BadPresses(
            f"{folder} holds no frame without contact; name it with --reference, or call it {UNTOUCHED[0]}.png. "
            f"Without, {MEDIAN_OF} presses of one size in different places are needed, whose median stands for it"
        )
    median = np.median(np.stack(list(images.values())), axis=0).astype(np.uint8)
    return Frames(median, tuple((path.name, images[path]) for path in pressed), estimated=True)
