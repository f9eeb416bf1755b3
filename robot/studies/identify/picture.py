"""Measured and fitted signals of the presses, drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from calibration.materials.presses import Press
from robot.studies.identify.identify import Identified
from tacsim.interface import FloatArray
from tacsim.report.figure import COLOURS, INK, QUIET, canvas, plain, save

MOST_DRAWN = 6  # presses; a column each


def draw(identified: Identified, table: Sequence[tuple[str, str, str]], path: Path) -> None:
    """Writes a picture: for each press its normal force against depth, its sideways force against the way sideways, and
    what is left of all signals over its standard deviation; on top what was found."""
    shown = identified.presses[:MOST_DRAWN]
    figure = canvas(max(3.4 * len(shown), 9.0), 9.5)
    lines = [f"{name.replace('_', ' ')}   {value}   (95 %: {interval})" for name, value, interval in table]
    lines += [f"{each.name.replace('_', ' ')}   not told" for each in identified.fit.unidentified]
    lines += [f"NOT TO BE USED: {each.text}"[:150] for each in identified.findings]
    left = len(identified.presses) - len(shown)
    lines += [f"and {left} more presses"] if left else []
    # no suptitle, for which tight_layout would leave room once more
    figure.text(0.02, 0.99, "\n".join(line.replace("$", r"\$") for line in lines), va="top", fontsize=9, color=INK)
    for column, press in enumerate(shown):
        rows = [figure.add_subplot(3, len(shown), column + 1 + k * len(shown)) for k in range(3)]
        depth, aside = _depth(press), _aside(press)
        _forces(identified, column, rows[0], depth, ("fz",), "depth [mm]", press.name)
        _forces(identified, column, rows[1], aside, ("fx", "fy"), "sideways [mm]", "")
        _residuals(identified, column, rows[2])
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.99 - 0.016 * (len(lines) + 1)))
    save(figure, path)


def _depth(press: Press) -> FloatArray:
    """How far the parts are closed, from where they were farthest [mm]."""
    if "indenter" in press.poses:
        height = np.array([pose.position[2] for pose in press.poses["indenter"]])
    else:
        height = np.array([
            upper.position[2] - lower.position[2]
            for upper, lower in zip(press.poses["upper"], press.poses["lower"], strict=True)
        ])  # fmt: skip
    found: FloatArray = (height.max() - height) * 1e3
    return found


def _aside(press: Press) -> FloatArray:
    """How far the parts have gone sideways [mm]."""
    part = "indenter" if "indenter" in press.poses else "upper"
    places = np.array([pose.position[:2] for pose in press.poses[part]])
    found: FloatArray = ((places - places[0]) @ _direction(places)) * 1e3
    return found


def _direction(places: FloatArray) -> FloatArray:
    """The direction in which they go farthest (2,)."""
    farthest = places[np.argmax(np.linalg.norm(places - places[0], axis=1))] - places[0]
    length = float(np.linalg.norm(farthest))
    return farthest / length if length > 0 else np.array([1.0, 0.0])


def _forces(
    identified: Identified, press: int, axes: Axes, along: FloatArray, names: Sequence[str], label: str, title: str
) -> None:
    signals, fit = identified.signals, identified.fit
    plain(axes, title.replace("$", r"\$")[:32], label, "force [N]")
    count = 0
    for index, channel in enumerate(signals.channels):
        rows = (signals.press == press) & (signals.channel == index)
        if channel.partition(".")[2] not in names or not rows.any():
            continue
        values = identified.presses[press].readings[channel]
        x, colour = along[np.isfinite(values)], COLOURS[count % len(COLOURS)]
        noise = signals.noise[rows]
        axes.errorbar(x, signals.values[rows], noise, fmt="o", markersize=3, linewidth=0.8, color=colour, label=channel)
        axes.plot(x, fit.predicted[rows], color=colour, linewidth=1.0)
        count += 1
    if count:
        axes.legend(fontsize=7, frameon=False)


def _residuals(identified: Identified, press: int, axes: Axes) -> None:
    signals, fit = identified.signals, identified.fit
    plain(axes, "", "moment", "measured - fitted [sd]")
    axes.axhspan(-2, 2, color=QUIET, alpha=0.12, linewidth=0)
    for index, channel in enumerate(signals.channels):
        rows = (signals.press == press) & (signals.channel == index)
        if rows.any():
            left = (signals.values[rows] - fit.predicted[rows]) / fit.sigma[rows]
            again, number = divmod(index, len(COLOURS))  # there are more channels than colours
            style = ("o-", "s--", "^:")[again % 3]
            axes.plot(left, style, markersize=2.5, linewidth=0.7, color=COLOURS[number], label=channel)
    axes.legend(fontsize=6, frameon=False, ncols=2)
