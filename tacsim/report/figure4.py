"""The seed paper's Figure 4 from tacsim's runs: reward, pictures of both sensors, and the deforming body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.ticker import MaxNLocator

from tacsim.interface import Float32, FloatArray, Image, Pose
from tacsim.pose import transform
from tacsim.report.figure import GOAL, INK, MUTED, goal_text, new_figure, save_figure, show_image, style_axes

PHYSICS = {"seed": "the seed's scheme: one shared particle grid", "hybrid": "ours: two elastic gels, particle body"}
CLAY = ("#c8623a", "#e29a6b")
GEL, BACKING = "#bfe0d2", "#5d6b75"
CELL = 1.8  # width of a column [inches]


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One control step of the figure."""

    step: int
    images: Mapping[str, Image]  # (H, W, 3) RGB, by sensor
    heights: Mapping[str, Float32]  # (h, w) into the gel, by sensor [m]
    poses: Mapping[str, Pose]  # world_from_sensor
    points: Float32  # (n, 3) body particles, world [m]
    force: float  # mean |Fz| of the arms [N]


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One task, run past its goal with one physics scheme."""

    step: list[int]
    reward: list[float]
    distance: list[float]  # [m]
    image_difference: list[float]  # mean |I - I0| over both sensors, I0 without contact [grey levels]
    goal: float | tuple[float, ...]  # [m]
    moments: list[Moment]
    pitch: float  # of the grid of `heights` [m]
    gel_size: tuple[float, float, float]  # [m]
    spacing: float  # of the body particles [m]

    @property
    def peak(self) -> int:
        """Position of the highest reward."""
        return int(np.argmax(self.reward))


def draw_figure4(results: Mapping[str, Mapping[str, Trial]], path: Path) -> None:
    """Draws `results` (task -> physics -> trial) and writes them to `path` as PNG. Raises OSError."""
    section_height = 6.25  # of a task [inches]
    schemes = [name for name in PHYSICS if any(name in trials for trials in results.values())]
    columns = max(len(trial.moments) for trials in results.values() for trial in trials.values())
    wide = columns * CELL + 0.5
    page = Page(0.75 + len(schemes) * wide, 0.8 + section_height * len(results))
    page.write(0.25, 0.35, "Squeezing and repositioning plasticine", fontsize=16, weight="bold", color=INK)
    for column, name in enumerate(schemes):
        left = 0.75 + column * wide
        page.write(left, 0.66, PHYSICS[name], fontsize=12, color=MUTED)
        for row, (task, trials) in enumerate(results.items()):
            if name in trials:
                rewards = [value for trial in trials.values() for value in trial.reward]
                limits = (min(rewards), max(*rewards, 0.0))
                _draw_trial(page, (left, 0.8 + row * section_height), task, trials[name], limits, named=column == 0)
    save_figure(page.figure, path)


class Page:
    """A figure with positions in inches from the upper left corner."""

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self.figure = new_figure(width, height)

    def axes(self, left: float, top: float, wide: float, tall: float) -> Axes:
        place = (left / self.width, 1 - (top + tall) / self.height, wide / self.width, tall / self.height)
        return self.figure.add_axes(place)

    def write(self, left: float, baseline: float, words: str, **style: Any) -> None:
        self.figure.text(left / self.width, 1 - baseline / self.height, words, **style)


def _draw_trial(
    page: Page, corner: tuple[float, float], task: str, trial: Trial, limits: tuple[float, float], named: bool
) -> None:
    """One section of the page: the reward, and a column for each moment with the body and both images."""
    gap, cut_height = 0.06, 1.45  # between columns; of the cut [inches]
    left, top = corner
    curve = page.axes(left, top + 0.4, len(trial.moments) * CELL - gap, 1.05)
    _draw_curve(curve, task, trial, limits, named)
    wide = CELL - gap
    for column, moment in enumerate(trial.moments):
        x, y = left + column * CELL, top + 1.95
        at_goal = moment.step == trial.step[trial.peak]
        body = page.axes(x, y, wide, cut_height)
        _draw_cut(body, trial, moment)
        words = f"step {moment.step}{' · closest' if at_goal else ''} · {moment.force:.2f} N"
        body.set_title(words, fontsize=9, color=GOAL if at_goal else INK, pad=4)
        y += cut_height + 0.1
        for name in ("upper", "lower"):
            tall = wide * moment.images[name].shape[0] / moment.images[name].shape[1]
            axes = page.axes(x, y, wide, tall)
            show_image(axes, moment.images[name])
            y += tall + gap
            if named and column == 0:
                axes.set_ylabel(f"{name} sensor", fontsize=9, color=INK)
                body.set_ylabel("middle of the body", fontsize=9, color=INK)


def _draw_curve(axes: Axes, task: str, trial: Trial, limits: tuple[float, float], label: bool) -> None:
    best = trial.distance[trial.peak] * 1e3
    style_axes(axes, f"{task} to {goal_text(trial.goal)}   (closest: {best:.3f} mm)", "", "reward [-]" if label else "")
    axes.axhline(0.0, color=GOAL, linestyle="--", linewidth=1)
    for moment in trial.moments:
        axes.axvline(moment.step, color="#c9ced3", linewidth=1)
    axes.plot(trial.step, trial.reward, color=INK, linewidth=1.8, marker=".", markersize=5)
    axes.plot([trial.step[trial.peak]], [trial.reward[trial.peak]], "o", color=GOAL, markersize=7)
    margin = 0.12 * (limits[1] - limits[0])
    axes.set_ylim(limits[0] - margin, limits[1] + margin)
    axes.set_xlim(trial.step[0] - 0.5, trial.step[-1] + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_cut(axes: Axes, trial: Trial, moment: Moment) -> None:
    """The middle slice of the body, and the gels in the plane y = centre of the body; world x and z [mm]."""
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    plane = float(moment.points[:, 1].mean())
    for name, pose in moment.poses.items():
        profile = _gel_profile(moment.heights[name], trial.pitch, pose, plane)
        half, thickness = trial.gel_size[0] / 2, trial.gel_size[2]
        corners = transform(pose, np.array([[half, 0, -thickness], [-half, 0, -thickness]]))[:, ::2]
        outline = np.vstack([profile[:, ::2], corners])
        axes.fill(*(outline.T * 1e3), color=GEL, linewidth=0)
        axes.plot(*(profile[:, ::2].T * 1e3), color="#4b8f77", linewidth=1)
        axes.plot(*(corners.T * 1e3), color=BACKING, linewidth=3, solid_capstyle="butt")
    _draw_body(axes, trial, moment)
    _frame_cut(axes, trial)


def _draw_body(axes: Axes, trial: Trial, moment: Moment) -> None:
    """The particles that were in the middle slice at the start, with colours by layers of their start positions."""
    stripe = 2e-3  # thickness of the coloured layers [m]
    start = trial.moments[0].points
    middle = np.abs(start[:, 1] - start[:, 1].mean()) <= 0.75 * trial.spacing
    layer = ((start[middle, 2] - start[:, 2].min()) / stripe).astype(int) % 2
    size = np.full(int(middle.sum()), 1.6 * trial.spacing * 1e3)
    body = EllipseCollection(
        size,
        size,
        np.zeros_like(size),
        units="xy",
        offsets=moment.points[middle][:, ::2] * 1e3,
        offset_transform=axes.transData,
        facecolors=[CLAY[k] for k in layer],
        linewidths=0,
    )
    axes.add_collection(body)


def _gel_profile(height: Float32, pitch: float, pose: Pose, plane: float) -> FloatArray:
    """(w, 3) section of the gel surface with the plane y = `plane`, world frame, from one edge of the gel to the
    other."""
    rows, columns = height.shape
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    x, y = (x - (columns - 1) / 2) * pitch, (y - (rows - 1) / 2) * pitch
    sensor = np.stack([x, y, -height.astype(np.float64)], axis=-1)
    world = transform(pose, sensor.reshape(-1, 3)).reshape(rows, columns, 3)
    nearest = np.abs(world[:, :, 1] - plane).argmin(axis=0)
    profile: FloatArray = world[nearest, np.arange(columns)]
    return profile


def _frame_cut(axes: Axes, trial: Trial) -> None:
    """Sets the same window for every moment of a trial, so that motion is visible."""
    positions = np.array([pose.position for moment in trial.moments for pose in moment.poses.values()]) * 1e3
    half, thickness = trial.gel_size[0] / 2 * 1e3, trial.gel_size[2] * 1e3
    low, high = positions.min(axis=0), positions.max(axis=0)
    axes.set_xlim(low[0] - half - 0.5, high[0] + half + 0.5)
    axes.set_ylim(low[2] - thickness - 0.8, high[2] + thickness + 0.8)
