"""Labels of real presses of a ball at known depth, and the paths of their frames.

A folder of frames may have its own labels, `presses.yaml`; otherwise those of a public set apply
(`references/presses.yaml`). Frames are found by name anywhere below the folder.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from pydantic import Field

from tacsim.interface import Image
from tacsim.models.quantity import Config, Length
from tacsim.record.episode import EpisodeError
from tacsim.record.images import read_image

Positive = Annotated[Length, Field(gt=0)]

OWN = "presses.yaml"
SHIPPED = Path(__file__).parents[2] / "references" / OWN


class BadData(ValueError):
    """A folder of real frames cannot be used. The message says what is missing, and where."""


class PressLabel(Config):
    """One press of a ball straight into the gel."""

    frames: tuple[str, ...] = ()  # possible names of its frame; the first that exists is used
    ball_radius: Positive  # [m]
    depth: Positive  # commanded [m]
    radius_px: Annotated[float, Field(gt=0)] | None = None  # measured contact radius [px]

    @property
    def name(self) -> str:
        return f"R {self.ball_radius * 1e3:g} mm, {self.depth * 1e3:g} mm deep"


class PunchLabel(Config):
    """One press of a flat punch straight into the gel."""

    frames: Annotated[
        tuple[str, ...], Field(min_length=1)
    ]  # possible names of its frame; the first that exists is used
    mesh: Annotated[tuple[str, ...], Field(min_length=1)]  # names of an STL in mm whose highest face touches the gel; x
    # points right in the image and y up
    depth: Positive  # commanded [m]


class PressLabels(Config):
    """Presses on one sensor."""

    name: str
    source: str = ""
    pixel_pitch: Positive  # [m]
    gel_size: tuple[Positive, Positive]  # x, y [m]
    gel_thickness: Annotated[tuple[Positive, ...], Field(min_length=1)]  # the likeliest first [m]
    depth_uncertainty: Annotated[Length, Field(ge=0)] = 0.0  # [m]
    backgrounds: Annotated[tuple[str, ...], Field(min_length=1)]  # names of the frame without contact, seen from the
    # folder of the presses' frames; the first that exists counts
    light: str = ""  # name of the ball presses (balls.yaml) on the same sensor that its light is calibrated by
    presses: Annotated[tuple[PressLabel, ...], Field(min_length=1)]
    punches: tuple[PunchLabel, ...] = ()

    @property
    def balls(self) -> list[float]:
        """All ball radii [m], each once."""
        return list(dict.fromkeys(press.ball_radius for press in self.presses))


def read_labels(folder: Path) -> PressLabels:
    """The labels that apply to `folder`. Raises BadData without such a folder, ConfigError for labels with errors."""
    from tacsim.config import load_model

    if not folder.is_dir():
        raise BadData(f"{folder} is not a folder; name the folder with the real frames")
    own = folder / OWN
    return load_model(PressLabels, own if own.is_file() else SHIPPED)


def find_frames(folder: Path, labels: PressLabels) -> dict[PressLabel, Path]:
    """The frame of each press that has one below `folder`.

    Raises BadData if there is no frame, if a name exists twice, or for a press with neither frame nor radius.
    """
    found = {press: path for press in labels.presses if (path := find(folder, press.frames)) is not None}
    if not found:
        wanted = ", ".join(press.frames[0] for press in labels.presses if press.frames) or "(the labels name no frame)"
        raise BadData(
            f"{folder} and the folders below it hold no frame of '{labels.name}': {wanted}. "
            f"Name the folder that holds them, or describe your own frames in {folder / OWN}"
        )
    unused = [press.name for press in labels.presses if press not in found and press.radius_px is None]
    if unused:
        raise BadData(
            f"{folder}: no frame and no radius_px for {'; '.join(unused)}. Add the frame, or remove the press from "
            f"{OWN}"
        )
    return found


def read_frames(folder: Path, labels: PressLabels) -> tuple[Image, dict[PressLabel, Image]]:
    """The frame without contact, and those of the presses, (H, W, 3) RGB. Raises BadData that names the file."""
    paths = find_frames(folder, labels)
    background, reference = read_background(next(iter(paths.values())).parent, labels)
    frames = {press: read_picture(path) for press, path in paths.items()}
    for press, frame in frames.items():
        if frame.shape != reference.shape:
            raise BadData(f"{paths[press]} and {background} differ in size; they must be from one camera")
    return reference, frames


def read_punches(folder: Path, labels: PressLabels) -> dict[PunchLabel, tuple[Path, Image]]:
    """Mesh and frame of each punch that has both below `folder`. Raises BadData that names the file."""
    found = {}
    for punch in labels.punches:
        mesh, frame = find(folder, punch.mesh), find(folder, punch.frames)
        if mesh is not None and frame is not None:
            found[punch] = mesh, read_picture(frame)
    return found


def read_background(home: Path, labels: PressLabels) -> tuple[Path, Image]:
    """The picture without contact of frames in `home`, and its path. Raises BadData."""
    background = next((path for name in labels.backgrounds if (path := home / name).is_file()), None)
    if background is None:
        raise BadData(f"{home} has no frame without contact; looked for {', '.join(labels.backgrounds)}")
    return background, read_picture(background)


def read_picture(path: Path) -> Image:
    """(H, W, 3) RGB. Raises BadData."""
    try:
        return read_image(path)
    except EpisodeError as error:
        raise BadData(str(error)) from None


def find(folder: Path, names: Iterable[str]) -> Path | None:
    """The first of these names that exists below `folder`, or None. Raises BadData for a name that exists twice."""
    for name in names:
        found = sorted(folder.rglob(name))
        if len(found) > 1:
            raise BadData(f"'{name}' exists twice: {found[0]} and {found[1]}. Name the folder of one of them")
        if found:
            return found[0]
    return None
