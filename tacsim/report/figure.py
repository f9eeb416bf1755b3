"""Pictures of episodes, drawn off screen by matplotlib's object interface (no pyplot: no global state, no windows)."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.image import imsave
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.stats import pearsonr

from tacsim.record.episode import Episode, Step

INK, QUIET, GRID = "#22262b", "#6b737c", "#e3e6e9"
GOAL = "#1f8a4c"
COLOURS = ("#2a6db5", "#cf5b17", "#7a4fb0", "#b0891f", "#1b8f8f", "#a8325e")  # told apart by most colour-blind people
DPI, WIDTH, COLUMNS = 100, 14.0, 6  # dots an inch, page width [inches], images in a row of the overview


def canvas(width: float, height: float) -> Figure:
    """An empty white figure of `width` x `height` inches, ready to be saved."""
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def plain(axes: Axes, title: str = "", xlabel: str = "", ylabel: str = "") -> Axes:
    """Quiet axes: no box, faint grid, title at the left."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.tick_params(colors=QUIET, labelsize=8)
    axes.grid(color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(xlabel, fontsize=9, color=QUIET)
    axes.set_ylabel(ylabel, fontsize=9, color=QUIET)
    return axes


def show_image(axes: Axes, image: NDArray[np.uint8], title: str = "") -> None:
    """Draws an (H, W, 3) RGB image without ticks."""
    axes.imshow(image, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_color(GRID)
    axes.set_title(title, fontsize=8, color=QUIET, pad=3)


def png(image: NDArray[np.uint8], max_width: int) -> bytes:
    """PNG file of an (H, W, 3) RGB image, averaged down by a whole factor until it is at most `max_width` wide."""
    factor = -(-image.shape[1] // max_width)
    rows, columns = (image.shape[0] // factor) * factor, (image.shape[1] // factor) * factor
    blocks = image[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor, 3)
    file = io.BytesIO()
    imsave(file, np.round(blocks.mean(axis=(1, 3))).astype(np.uint8), format="png")
    return file.getvalue()


def png_of(figure: Figure) -> bytes:
    """PNG file of a figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def _literal(text: str) -> str:
    """`text` as matplotlib shows it letter by letter: a name with dollar signs is no formula."""
    return text.replace("$", r"\$")


def sensors_of(episode: Episode) -> list[str]:
    """Sensor names, top to bottom as they stand on the bench: `upper` first, then by name."""
    return _upper_first({name for step in episode.steps for name in step.frames})


def _upper_first(names: Collection[str]) -> list[str]:
    return sorted(names, key=lambda name: (name != "upper", name))


def moments(count: int, wanted: int) -> list[int]:
    """At most `wanted` positions spread evenly over `count`, first and last among them."""
    return sorted({int(k) for k in np.linspace(0, count - 1, min(wanted, count)).round()}) if count else []


def _colours(names: Collection[str]) -> list[tuple[str, str]]:
    """A colour for each name, the same in every plot of an episode; upper first."""
    return [(name, COLOURS[number % len(COLOURS)]) for number, name in enumerate(_upper_first(names))]


def goal_text(goal: float | tuple[float, ...] | None) -> str:
    """A goal [m] in millimetres; a dash if there is none."""
    if goal is None:
        return "–"
    if isinstance(goal, (int, float)):
        return f"{goal * 1e3:.2f} mm"
    return f"({', '.join(f'{value * 1e3:.2f}' for value in goal)}) mm"


def contact_signals(episode: Episode) -> dict[str, list[float | None]]:
    """`info["contact_signal_<sensor>"]` of every sensor that has one, an entry a step; None where a step has none."""
    prefix = "contact_signal_"
    keys = sorted({key for step in episode.steps for key in step.info if key.startswith(prefix)})
    return {key.removeprefix(prefix): [step.info.get(key) for step in episode.steps] for key in keys}


def normal_force(step: Step) -> dict[str, float]:
    """|Fz| of every arm [N]: how hard object and sensor press on each other."""
    return {name: abs(float(state.wrench[2])) for name, state in step.arms.items()}


def signal_against_force(episode: Episode) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64], float | None]]:
    """For every sensor on an arm: force |Fz| [N], contact signal, and Pearson's correlation of the two.

    The correlation is None where either never changes, or with fewer than three steps.
    """
    pairs = {}
    for name, signal in contact_signals(episode).items():
        sensor = episode.meta.spec.sensors.get(name)
        if sensor is None or sensor.arm is None:
            continue
        forces = [normal_force(step).get(sensor.arm) for step in episode.steps]
        both = [(f, s) for f, s in zip(forces, signal, strict=True) if f is not None and s is not None]
        values = np.array([pair for pair in both if np.isfinite(pair).all()], dtype=np.float64).reshape(-1, 2)
        varies = len(values) >= 3 and bool((np.ptp(values, axis=0) > 1e-12).all())
        force, contact = values[:, 0], values[:, 1]
        correlation = float(pearsonr(force, contact).statistic) if varies else None
        pairs[name] = (force, contact, correlation)
    return {name: pair for name, pair in pairs.items() if len(pair[0])}


def _series(axes: Axes, steps: Sequence[Step], values: Iterable[float | None], colour: str, label: str = "") -> None:
    numbers = [np.nan if value is None else value for value in values]
    at = [step.index for step in steps]
    axes.plot(at, numbers, color=colour, linewidth=1.6, marker=".", markersize=4, label=_literal(label))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _legend(axes: Axes) -> None:
    axes.legend(fontsize=8, frameon=False, labelcolor=INK)


def _draw_reward(axes: Axes, episode: Episode) -> None:
    plain(axes, "reward", "step", "reward [-]")
    _series(axes, episode.steps, [step.reward for step in episode.steps], INK)
    axes.axhline(0.0, color=GOAL, linestyle="--", linewidth=1)
    axes.text(1.0, 0.0, "goal ", color=GOAL, fontsize=8, va="bottom", ha="right", transform=axes.get_yaxis_transform())
    judged = [(step.reward, step.index) for step in episode.steps if step.reward is not None]
    best, at = max(judged, key=lambda pair: pair[0])  # of equal ones the first, as in the plot of distance
    axes.plot([at], [best], "o", color=GOAL, markersize=6)
    axes.margins(y=0.12)


def _draw_distance(axes: Axes, episode: Episode) -> None:
    known = {"squeeze": "|height − goal|", "reposition": "|position − goal|"}
    plain(axes, f"distance: {known.get(episode.meta.task or '', 'from the goal')}", "step", "mm")
    _series(axes, episode.steps, [None if s.distance is None else s.distance * 1e3 for s in episode.steps], INK)
    best, at = min((step.distance * 1e3, step.index) for step in episode.steps if step.distance is not None)
    axes.axhline(0.0, color=GOAL, linestyle="--", linewidth=1)
    axes.plot([at], [best], "o", color=GOAL, markersize=6, label=f"best {best:.3f} mm at step {at}")
    _legend(axes)


def _draw_force(axes: Axes, episode: Episode) -> None:
    plain(axes, "force on each arm, |Fz|", "step", "N")
    for name, colour in _colours({name for step in episode.steps for name in step.arms}):
        _series(axes, episode.steps, [normal_force(step).get(name) for step in episode.steps], colour, name)
    axes.margins(y=0.12)
    axes.set_ylim(0.0, max(axes.get_ylim()[1], 1.12 * axes.dataLim.ymax))  # a nearly constant force is not cut off
    _legend(axes)


def _draw_signal(axes: Axes, episode: Episode) -> None:
    plain(axes, "contact signal", "step", "signal")
    signals = contact_signals(episode)
    for name, colour in _colours(signals):
        _series(axes, episode.steps, signals[name], colour, name)
    _legend(axes)


def _draw_signal_against_force(axes: Axes, episode: Episode) -> None:
    pairs = signal_against_force(episode)
    said = {name: "undefined" if pair[2] is None else f"{pair[2]:.3f}" for name, pair in pairs.items()}
    plain(axes, "contact signal against force", "force |Fz| [N]", "contact signal")
    for name, colour in _colours(pairs):
        force, signal, _ = pairs[name]
        axes.scatter(force, signal, s=14, color=colour, label=f"{_literal(name)}: r = {said[name]}")
    if len(pairs) == 1:
        axes.set_title(f"contact signal against force, r = {next(iter(said.values()))}", loc="left", fontsize=10)
    else:
        _legend(axes)


def _draw_timing(axes: Axes, episode: Episode) -> None:
    plain(axes, "wall time of a step", "step", "s")
    done = [step for step in episode.steps if step.index > 0]
    seconds = [step.seconds for step in done]
    axes.bar([step.index for step in done], seconds, color="#9fb4c8", width=0.8)
    axes.axhline(float(np.median(seconds)), color=INK, linewidth=1, label=f"median {np.median(seconds):.3f} s")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _legend(axes)


def _panels(episode: Episode) -> list[Callable[[Axes, Episode], None]]:
    """The plots for which the episode has data."""
    steps = episode.steps
    offered = [
        (any(step.reward is not None for step in steps), _draw_reward),
        (any(step.arms for step in steps), _draw_force),
        (bool(contact_signals(episode)), _draw_signal),
        (any(step.distance is not None for step in steps), _draw_distance),
        (any(step.index > 0 for step in steps), _draw_timing),
        (bool(signal_against_force(episode)), _draw_signal_against_force),
    ]
    return [draw for there, draw in offered if there]


def _draw_plots(figure: Figure, place: SubplotSpec, episode: Episode) -> None:
    panels = _panels(episode)
    grid = place.subgridspec(_rows(episode), 3, hspace=0.5, wspace=0.24)
    for number, draw in enumerate(panels):
        draw(figure.add_subplot(grid[number // 3, number % 3]), episode)


def _rows(episode: Episode) -> int:
    return max(1, -(-len(_panels(episode)) // 3))


def plots(episode: Episode) -> Figure:
    """Reward, distance, force, timing and contact signal over the steps, as far as the episode has them."""
    height = 3.1 * _rows(episode)
    figure = canvas(WIDTH, height)
    _draw_plots(figure, _band(figure, 0.3, height - 0.8), episode)
    return figure


def overview(episode: Episode, title: str, subtitle: str) -> Figure:
    """The whole episode on one page: what each sensor saw at six moments, and the plots below."""
    names = sensors_of(episode)
    shapes = [next(step.frames[name].image.shape for step in episode.steps if name in step.frames) for name in names]
    tall = [rows / columns * WIDTH * 0.93 / COLUMNS + 0.22 for rows, columns, _ in shapes]
    below, head = 3.1 * _rows(episode), 0.95
    height = head + sum(tall) + below
    figure = canvas(WIDTH, height)
    figure.text(0.02, 1 - 0.33 / height, _literal(title), fontsize=15, color=INK, weight="bold", va="center")
    figure.text(0.02, 1 - 0.66 / height, _literal(subtitle), fontsize=9.5, color=QUIET, va="center")
    top = head
    for name, tallness in zip(names, tall, strict=True):
        _draw_strip(figure, _band(figure, top, tallness - 0.22), episode, name)
        top += tallness
    _draw_plots(figure, _band(figure, top + 0.25, below - 0.75), episode)
    return figure


def _band(figure: Figure, top: float, tall: float) -> SubplotSpec:
    """A full-width band of the page, `top` inches below its upper edge and `tall` inches high."""
    height = float(figure.get_size_inches()[1])
    return figure.add_gridspec(1, 1, left=0.045, right=0.985, top=1 - top / height, bottom=1 - (top + tall) / height)[0]


def _draw_strip(figure: Figure, place: SubplotSpec, episode: Episode, name: str) -> None:
    seen = [step for step in episode.steps if name in step.frames]
    grid = place.subgridspec(1, COLUMNS, wspace=0.05)
    for column, k in enumerate(moments(len(seen), COLUMNS)):
        axes = figure.add_subplot(grid[0, column])
        show_image(axes, seen[k].frames[name].image, f"step {seen[k].index}")
        if column == 0:
            axes.set_ylabel(_literal(name), fontsize=10, color=INK)


def save(figure: Figure, path: Path, metadata: Mapping[str, str] | None = None) -> None:
    """Writes a figure as PNG. A character of a name that the font lacks is drawn as a box, without a warning."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        figure.savefig(path, format="png", metadata=dict(metadata or {}))
