"""Pictures of episodes, drawn off screen by matplotlib's object interface (no pyplot: no global state, no windows)."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image

from tacsim.interface import FloatArray
from tacsim.models.task import LENGTH, Unit, unit_of
from tacsim.report.series import Series, sort_upper_first

INK, MUTED, GRID = "#22262b", "#6b737c", "#e3e6e9"
GOAL = "#1f8a4c"
COLOURS = ("#2a6db5", "#cf5b17", "#7a4fb0", "#b0891f", "#1b8f8f", "#a8325e")  # distinguished by most colour-blind users
THUMBNAIL = 320  # [px]
MAX_GOAL = 9  # largest number of values of a goal that are printed
Draw = Callable[[Axes, Series], None]
DPI, WIDTH, COLUMNS = 100, 14.0, 6  # dots an inch, page width [inches], images in a row of the overview


def new_figure(width: float, height: float) -> Figure:
    """An empty white figure of `width` x `height` inches, with a canvas."""
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def style_axes(axes: Axes, title: str = "", xlabel: str = "", ylabel: str = "") -> Axes:
    """Sets the style of axes: no box, faint grid, title at the left."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelsize=8)
    axes.grid(color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(xlabel, fontsize=9, color=MUTED)
    axes.set_ylabel(ylabel, fontsize=9, color=MUTED)
    return axes


def show_image(axes: Axes, image: NDArray[np.uint8], title: str = "") -> None:
    """Draws an (H, W, 3) RGB image without ticks."""
    axes.imshow(image, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color(GRID)
    axes.set_title(title, fontsize=8, color=MUTED, pad=3)


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A small picture of a sensor at a step."""

    index: int  # of the step
    image: NDArray[np.uint8]


def shrink_image(image: NDArray[np.uint8], max_width: int) -> NDArray[np.uint8]:
    """An (H, W, 3) RGB image averaged down by a whole factor until it is at most `max_width` wide."""
    factor = min(-(-image.shape[1] // max_width), image.shape[0])
    rows, columns = (image.shape[0] // factor) * factor, (image.shape[1] // factor) * factor
    return np.asarray(Image.fromarray(image[:rows, :columns]).reduce(factor))


def encode_jpeg(image: NDArray[np.uint8], quality: int = 80) -> bytes:
    """JPEG file of an (H, W, 3) RGB image."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=quality)
    return file.getvalue()


def encode_figure(figure: Figure) -> bytes:
    """PNG file of a figure."""
    file = io.BytesIO()
    save_figure(figure, file)
    return file.getvalue()


def _escape_math(text: str) -> str:
    """`text` without formulas for matplotlib: dollar signs are escaped."""
    return text.replace("$", r"\$")


def select_positions(count: int, max_count: int) -> list[int]:
    """At most `max_count` positions, evenly distributed over `count`, with the first and the last."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(max_count, count)).round()}) if count else []


def _assign_colours(names: Collection[str]) -> list[tuple[str, str]]:
    """A colour for each name, the same in every plot of an episode; upper first."""
    return [(name, COLOURS[number % len(COLOURS)]) for number, name in enumerate(sort_upper_first(names))]


def goal_text(goal: float | tuple[float, ...] | None, unit: Unit = LENGTH) -> str:
    """A goal [SI] in the unit of its task; a dash if there is none."""
    if goal is None:
        return "–"
    if isinstance(goal, (int, float)):
        return f"{goal * unit.factor:.2f} {unit.symbol}"
    more = ", ..." if len(goal) > MAX_GOAL else ""
    return f"({', '.join(f'{value * unit.factor:.2f}' for value in goal[:MAX_GOAL])}{more}) {unit.symbol}"


def signal_against_force(series: Series) -> dict[str, tuple[FloatArray, FloatArray, float | None]]:
    """For every sensor on an arm: force |Fz| [N], contact signal, and their Pearson correlation.

    The correlation is None if one of them is constant, or with fewer than three steps.
    """
    pairs = {}
    for name, signal in series.signals.items():
        arm = series.meta.spec.sensors[name].arm
        if arm is None or arm not in series.force:
            continue
        both = np.stack([series.force[arm], signal], axis=-1)
        values = both[np.isfinite(both).all(axis=1)]
        varies = len(values) >= 3 and bool((np.ptp(values, axis=0) > 1e-12).all())
        force, contact = values[:, 0], values[:, 1]
        pairs[name] = (force, contact, float(np.corrcoef(force, contact)[0, 1]) if varies else None)
    return {name: pair for name, pair in pairs.items() if len(pair[0])}


def _draw_line(axes: Axes, series: Series, values: FloatArray, colour: str, label: str = "") -> None:
    axes.plot(series.index, values, color=colour, linewidth=1.6, marker=".", markersize=4, label=_escape_math(label))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_lines(
    title: str, unit: str, values_of: Callable[[Series], Mapping[str, FloatArray]], scale: float = 1.0
) -> Draw:
    """Draws `scale` times each of the named values over the steps."""

    def draw(axes: Axes, series: Series) -> None:
        style_axes(axes, title, "step", unit)
        values = values_of(series)
        for name, colour in _assign_colours(values):
            _draw_line(axes, series, values[name] * scale, colour, name)
        _draw_legend(axes)

    return draw


def _draw_legend(axes: Axes) -> None:
    axes.legend(fontsize=8, frameon=False, labelcolor=INK)


def _draw_reward(axes: Axes, series: Series) -> None:
    style_axes(axes, "reward", "step", "reward [-]")
    _draw_line(axes, series, series.reward, INK)
    axes.axhline(0.0, color=GOAL, linestyle="--", linewidth=1)
    axes.text(1.0, 0.0, "goal ", color=GOAL, fontsize=8, va="bottom", ha="right", transform=axes.get_yaxis_transform())
    best = int(np.nanargmax(series.reward))  # the first of equal values, as in the plot of distance
    axes.plot([series.index[best]], [series.reward[best]], "o", color=GOAL, markersize=6)
    axes.margins(y=0.12)


def _draw_distance(axes: Axes, series: Series) -> None:
    known = {"squeeze": "|height − goal|", "reposition": "|position − goal|"}
    unit = unit_of(series.meta.task)
    style_axes(axes, f"distance: {known.get(series.meta.task or '', 'from the goal')}", "step", unit.symbol)
    axes.axhline(0.0, color=GOAL, linestyle="--", linewidth=1)
    if np.isfinite(series.tactile_distance).any():
        _draw_line(axes, series, series.tactile_distance * unit.factor, MUTED, "by touch alone")
    if np.isfinite(series.distance).any():
        _draw_line(axes, series, series.distance * unit.factor, INK)
        best = int(np.nanargmin(series.distance))
        at, least = series.index[best], series.distance[best]
        label = f"best {unit.show(least)} at step {at}"
        axes.plot([at], [least * unit.factor], "o", color=GOAL, markersize=6, label=label)
    _draw_legend(axes)


def _draw_force(axes: Axes, series: Series) -> None:
    _draw_lines("force on each arm, |Fz|", "N", lambda of: of.force)(axes, series)
    axes.margins(y=0.12)
    axes.set_ylim(0.0, max(axes.get_ylim()[1], 1.12 * axes.dataLim.ymax))  # keeps a nearly constant force visible


def _draw_signal_against_force(axes: Axes, series: Series) -> None:
    pairs = signal_against_force(series)
    correlations = {name: "undefined" if pair[2] is None else f"{pair[2]:.3f}" for name, pair in pairs.items()}
    style_axes(axes, "contact signal against force", "force |Fz| [N]", "contact signal")
    for name, colour in _assign_colours(pairs):
        force, signal, _ = pairs[name]
        axes.scatter(force, signal, s=14, color=colour, label=f"{_escape_math(name)}: r = {correlations[name]}")
    if len(pairs) == 1:
        axes.set_title(
            f"contact signal against force, r = {next(iter(correlations.values()))}", loc="left", fontsize=10
        )
    else:
        _draw_legend(axes)


def _draw_timing(axes: Axes, series: Series) -> None:
    style_axes(axes, "wall time of a step", "step", "s")
    done = series.after_reset()
    _draw_line(axes, done, done.seconds, "#9fb4c8")
    middle = float(np.median(done.seconds[np.isfinite(done.seconds)]))
    axes.axhline(middle, color=INK, linewidth=1, label=f"median {middle:.3f} s")
    axes.set_ylim(bottom=0.0)
    _draw_legend(axes)


def _available_panels(series: Series) -> list[Draw]:
    """The plots for which the episode has data."""
    offered: list[tuple[bool, Draw]] = [
        (bool(np.isfinite(series.reward).any()), _draw_reward),
        (bool(series.force), _draw_force),
        (bool(series.signals), _draw_lines("contact signal", "signal", lambda of: of.signals)),
        (bool(np.isfinite([series.distance, series.tactile_distance]).any()), _draw_distance),
        (bool(series.max_depth), _draw_lines("deepest point of each gel", "mm", lambda of: of.max_depth, 1e3)),
        (bool(series.max_flow), _draw_lines("longest flow of each gel's markers", "mm", lambda of: of.max_flow, 1e3)),
        (bool(np.isfinite(series.after_reset().seconds).any()), _draw_timing),
        (bool(signal_against_force(series)), _draw_signal_against_force),
    ]
    return [draw for has_data, draw in offered if has_data]


def _draw_plots(figure: Figure, place: SubplotSpec, series: Series) -> None:
    grid = place.subgridspec(_panel_rows(series), 3, hspace=0.5, wspace=0.24)
    for number, draw in enumerate(_available_panels(series)):
        draw(figure.add_subplot(grid[number // 3, number % 3]), series)


def _panel_rows(series: Series) -> int:
    return max(1, -(-len(_available_panels(series)) // 3))


def draw_plots(series: Series) -> Figure:
    """Reward, distance, force, timing and contact signal over the steps, if the episode has them."""
    height = 3.1 * _panel_rows(series)
    figure = new_figure(WIDTH, height)
    _draw_plots(figure, _page_band(figure, 0.3, height - 0.8), series)
    return figure


def draw_overview(strips: Sequence[tuple[str, Sequence[Picture]]], series: Series, title: str, subtitle: str) -> Figure:
    """The episode on one page: named rows of pictures, at most COLUMNS each, and the plots below."""
    max_height = 3.0  # height of a row of pictures, over the width of one
    shapes = [pictures[0].image.shape for _, pictures in strips]
    tall = [min(rows / columns, max_height) * WIDTH * 0.93 / COLUMNS + 0.22 for rows, columns, _ in shapes]
    below, head = 3.1 * _panel_rows(series), 0.95
    height = head + sum(tall) + below
    figure = new_figure(WIDTH, height)
    figure.text(0.02, 1 - 0.33 / height, _escape_math(title), fontsize=15, color=INK, weight="bold", va="center")
    figure.text(0.02, 1 - 0.66 / height, _escape_math(subtitle), fontsize=9.5, color=MUTED, va="center")
    top = head
    for (name, pictures), tallness in zip(strips, tall, strict=True):
        _draw_strip(figure, _page_band(figure, top, tallness - 0.22), name, pictures)
        top += tallness
    _draw_plots(figure, _page_band(figure, top + 0.25, below - 0.75), series)
    return figure


def _page_band(figure: Figure, top: float, tall: float) -> SubplotSpec:
    """A full-width band of the page, `top` inches below its upper edge and `tall` inches high."""
    height = float(figure.get_size_inches()[1])
    return figure.add_gridspec(1, 1, left=0.045, right=0.985, top=1 - top / height, bottom=1 - (top + tall) / height)[0]


def _draw_strip(figure: Figure, place: SubplotSpec, name: str, pictures: Sequence[Picture]) -> None:
    grid = place.subgridspec(1, COLUMNS, wspace=0.05)
    for column, picture in enumerate(pictures):
        axes = figure.add_subplot(grid[0, column])
        show_image(axes, picture.image, f"step {picture.index}")
        if column == 0:
            axes.set_ylabel(_escape_math(name), fontsize=10, color=INK)


def save_figure(figure: Figure, path: Path | io.BytesIO) -> None:
    """Writes a figure as PNG. A character that is not in the font is drawn as a box, without a warning."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        figure.savefig(path, format="png")
