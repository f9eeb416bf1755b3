"""The learning curve of a training run as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from robot.common.whole_file import write_whole
from robot.train.run_folder import RunSettings
from tacsim.models.task import LENGTH, SHARE, Unit, unit_of
from tacsim.report.figure import COLOURS, encode_figure, new_figure, style_axes

# Figures of a round: key, title, unit
PANELS = (
    ("distance", "distance from the goal", LENGTH),
    ("success", "success", SHARE),
    ("peak_force", "peak normal force", Unit("N", 1.0)),
)


def write_curve_picture(path: Path, settings: RunSettings, curve: Sequence[Mapping[str, float]]) -> None:
    """A PNG of the mean figures of each round over the control steps so far. Raises OSError."""
    training = settings.training
    steps = np.cumsum([row["steps"] for row in curve])
    figure = new_figure(12.0, 3.4)
    figure.suptitle(f"{settings.spec.task}, {training.algorithm}, seed {training.seed}", x=0.05, ha="left", fontsize=12)
    for number, (key, title, usual) in enumerate(PANELS):
        unit = unit_of(settings.spec.task) if key == "distance" else usual
        axes = style_axes(figure.add_subplot(1, len(PANELS), number + 1), title, "control steps", unit.symbol)
        values = [unit.factor * row[key] for row in curve]
        axes.plot(steps, values, "o-", color=COLOURS[number], markersize=4, clip_on=False)
        axes.set_xlim(left=0.0)
        axes.set_ylim(0.0, 100.0 if key == "success" else 1.05 * max(*values, 1e-9))
    figure.subplots_adjust(left=0.06, right=0.98, bottom=0.17, top=0.78, wspace=0.25)
    write_whole(path, encode_figure(figure))
