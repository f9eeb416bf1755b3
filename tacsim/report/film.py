"""An episode as a moving picture: the body between its gels, what the sensors see, force and reward; GIF or MP4."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from tacsim.interface import FloatArray
from tacsim.record.episode import Episode, Step
from tacsim.report.figure import COLOURS, GRID, INK, MUTED, select_positions
from tacsim.report.section import GelShape, Section, gel_states, section_of
from tacsim.report.series import Series
from tacsim.report.strips import Find

SUFFIXES = (".gif", ".mp4")
WIDTH, HEIGHT = 960, 720  # of a frame; a GIF has half of both [px]
GAP = 16  # [px]
SCENE = 540  # width of the drawing of the body [px]
CURVE_HEIGHT = 140  # height of the curves [px]
MAX_FRAMES = 300
FRAME_TIME, LAST_FRAME_TIME = 100, 1200  # [ms]
MAX_PICTURES = 4


class NoFilm(ValueError):
    """A film that cannot be made; the text says why."""


def write_film(
    episode: Episode,
    path: Path,
    find: Find = lambda sensor, frame: frame.surface,
    gels: Mapping[str, GelShape] | None = None,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Writes the episode as a GIF or, with the package av, an MP4: a frame a control step, 10 frames a second, at most
    300 frames. One step is decoded at a time.

    find: returns the surface of a sensor's gel in a frame, if known. gels: the shape of each gel that is drawn.
    on_frame: called with (frames done, of how many).

    Raises NoFilm for another suffix, a missing package or an episode without steps; FileExistsError; OSError.
    """
    require_film(path)
    if not len(episode.steps):
        raise NoFilm("the episode has no steps; a film needs at least the state after reset")
    if path.exists():
        raise FileExistsError(17, "exists already", str(path))
    chosen = select_positions(len(episode.steps), MAX_FRAMES)
    page = _Page.of(episode, find, gels or {})

    def frames() -> Iterator[Image.Image]:
        for number, at in enumerate(chosen):
            yield page.draw(at, episode.steps[at])
            on_frame(number + 1, len(chosen))

    try:
        (_write_images if path.suffix.lower() == ".gif" else _write_video)(frames(), path)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def require_film(path: Path) -> None:
    """Raises NoFilm for a name that no film can have, and for an MP4 without the package av."""
    if path.suffix.lower() not in SUFFIXES:
        raise NoFilm(f"{path} must end in {' or '.join(SUFFIXES)}")
    if path.suffix.lower() == ".mp4":
        try:
            import av  # noqa: F401
        except ModuleNotFoundError:
            raise NoFilm("an MP4 needs the package av: pip install 'tacsim[video]'; or write a .gif") from None


@dataclass(frozen=True, slots=True, eq=False)
class _Page:
    """Draws frames: at the left the body, at the right the pictures, below the curves."""

    series: Series
    section: Section | None
    find: Find
    gels: Mapping[str, GelShape]
    names: Sequence[str]  # of the sensors that are shown

    @classmethod
    def of(cls, episode: Episode, find: Find, gels: Mapping[str, GelShape]) -> _Page:
        series = Series.from_episode(episode)
        section = section_of(episode, gels, (SCENE, HEIGHT - CURVE_HEIGHT - 5 * GAP))
        return cls(series, section, find, gels, series.sensors[:MAX_PICTURES])

    def draw(self, at: int, step: Step) -> Image.Image:
        """The frame of the step at position `at`."""
        image = Image.new("RGB", (WIDTH, HEIGHT), "white")
        pen = ImageDraw.Draw(image)
        left, top = GAP, GAP
        bottom = HEIGHT - CURVE_HEIGHT - 4 * GAP
        if self.section is not None:
            drawn = self.section.draw(step.body, gel_states(step, self.gels, self.find))
            image.paste(drawn, (left, top))
            left += drawn.width + GAP
        self._draw_pictures(image, step, (left, top, WIDTH - GAP, bottom))
        curves = _curves(self.series)
        width = (WIDTH - GAP - GAP * len(curves)) // max(1, len(curves))
        for number, (title, lines) in enumerate(curves):
            x0 = GAP + number * (width + GAP)
            _draw_curve(pen, title, lines, at, (x0, bottom + GAP, x0 + width, HEIGHT - GAP))
        return image

    def _draw_pictures(self, image: Image.Image, step: Step, box: tuple[int, int, int, int]) -> None:
        """One or two below each other, more in two columns; a sensor without a picture at this step stays empty."""
        pen = ImageDraw.Draw(image, "RGBA")
        columns = 1 if self.section is not None and len(self.names) <= 2 else min(2, len(self.names))
        rows = -(-len(self.names) // max(1, columns))
        wide, high = (box[2] - box[0] - GAP * (columns - 1)), (box[3] - box[1] - GAP * (rows - 1))
        for number, name in enumerate(self.names):
            if name not in step.frames:
                continue
            picture = Image.fromarray(step.frames[name].image)
            scale = min(wide / columns / picture.width, high / rows / picture.height)
            picture = picture.resize((max(1, round(scale * picture.width)), max(1, round(scale * picture.height))))
            free = wide // columns - picture.width
            x = box[0] + (number % columns) * (wide // columns + GAP) + (free if columns == 1 else free // 2)
            y = box[1] + (number // columns) * (high // rows + GAP)
            image.paste(picture, (x, y))
            foot = y + picture.height
            pen.rectangle((x, foot - 32, x + pen.textlength(name, _text_font(22)) + 16, foot - 1), fill=(0, 0, 0, 130))
            pen.text((x + 8, foot - 30), name, fill="white", font=_text_font(22))


def _curves(series: Series) -> list[tuple[str, Mapping[str, FloatArray]]]:
    """Title and lines of the charts that have data."""
    offered: list[tuple[str, Mapping[str, FloatArray]]] = [("force [N]", series.force), ("reward", {"": series.reward})]
    return [(title, lines) for title, lines in offered if any(np.isfinite(values).any() for values in lines.values())]


def _draw_curve(
    canvas: ImageDraw.ImageDraw, title: str, lines: Mapping[str, FloatArray], at: int, box: tuple[int, int, int, int]
) -> None:
    """The whole curve pale, the part until the position `at` strong, with a cursor and the present value."""
    x0, y0, x1, y1 = box
    y0 += 44
    known = np.concatenate([values[np.isfinite(values)] for values in lines.values()])
    low, high = min(0.0, float(known.min())), max(0.0, float(known.max()))
    count = len(next(iter(lines.values())))
    x = np.linspace(x0 + 4, x1 - 4, max(2, count))
    scale = (y1 - y0) / max(high - low, 1e-9)
    canvas.line((x0, y1 + low * scale, x1, y1 + low * scale), fill=GRID, width=2)
    canvas.line((x[at], y0 - 6, x[at], y1), fill=MUTED, width=2)
    values_now = []
    for which, values in enumerate(lines.values()):
        colour = COLOURS[which % len(COLOURS)]
        points = [(float(x[k]), float(y1 - scale * (values[k] - low)), k) for k in np.flatnonzero(np.isfinite(values))]
        for part, shade, width in (
            (points, _mix_with_white(colour), 3),
            ([p for p in points if p[2] <= at], colour, 5),
        ):
            if len(part) > 1:
                canvas.line([(u, v) for u, v, _ in part], fill=shade, width=width, joint="curve")
        if np.isfinite(values[at]):
            u, v = float(x[at]), float(y1 - scale * (values[at] - low))
            canvas.ellipse((u - 7, v - 7, u + 7, v + 7), fill=colour)
            values_now.append(f"{values[at]:.2f}")
    canvas.text((x0, y0 - 46), title, fill=MUTED, font=_text_font(24))
    words = "  ".join(dict.fromkeys(values_now))
    canvas.text((x0 + canvas.textlength(title, _text_font(24)) + 14, y0 - 46), words, fill=INK, font=_text_font(24))


def _mix_with_white(colour: str) -> tuple[int, int, int]:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    return (red + 3 * 255) // 4, (green + 3 * 255) // 4, (blue + 3 * 255) // 4


def _text_font(size: int) -> Any:
    return ImageFont.load_default(size)


def _write_images(frames: Iterator[Image.Image], path: Path) -> None:
    """Halved frames with one palette, so that pixels that do not change cost nothing."""
    images = [frame.reduce(2) for frame in frames]
    samples = [images[k] for k in select_positions(len(images), 6)]
    sheet = Image.fromarray(np.concatenate([np.asarray(image) for image in samples]))
    palette = sheet.quantize(256, Image.Quantize.MEDIANCUT)
    drawn = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    times = [FRAME_TIME] * (len(drawn) - 1) + [LAST_FRAME_TIME]
    with path.open("xb") as file:
        drawn[0].save(file, "GIF", save_all=True, append_images=drawn[1:], duration=times, loop=0, optimize=True)


def _write_video(frames: Iterator[Image.Image], path: Path) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=1000 // FRAME_TIME)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        last = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for image in frames:
            last = np.asarray(image, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(last, format="rgb24")))
        for _ in range(LAST_FRAME_TIME // FRAME_TIME - 1):  # a stream has one rate
            container.mux(stream.encode(av.VideoFrame.from_ndarray(last, format="rgb24")))
        container.mux(stream.encode())
