"""A picture of how well each press is predicted by a calibration made without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.light.calibrator import LightFit

MAX_PRESSES = 8  # drawn, the worst first
HALF_SIDE = 2.0  # of what is drawn [contact radii]


def draw(fit: LightFit, path: Path) -> None:
    """Writes a PNG: of each press the change of colour as it was seen, as it is predicted by the others, and the
    error, all in one scale. Raises ValueError for a fit of one press, which is predicted by none; OSError."""
    from matplotlib.figure import Figure

    scores = sorted(fit.scores, key=lambda score: -score.error)[:MAX_PRESSES]
    if not scores:
        raise ValueError("a calibration from one press leaves none out: there is nothing to draw")
    figure = Figure(figsize=(6.4, 1.9 * len(scores)), layout="constrained")
    axes = figure.subplots(len(scores), 3, squeeze=False)
    for row, score in zip(axes, scores, strict=True):
        reach = HALF_SIDE * score.circle.radius
        rows = slice(max(0, round(score.circle.y - reach)), round(score.circle.y + reach) + 1)
        columns = slice(max(0, round(score.circle.x - reach)), round(score.circle.x + reach) + 1)
        seen, predicted = score.real[rows, columns], score.predicted[rows, columns]
        for axis, change in zip(row, (seen, predicted, predicted - seen), strict=True):
            axis.imshow(np.clip(128 + change, 0, 255).astype(np.uint8))
            axis.set_xticks([])
            axis.set_yticks([])
        row[0].set_ylabel(score.name, fontsize=7)
        row[2].set_title(f"{score.error:.1f} of {score.nothing:.1f} grey levels, {score.angle:.1f}°", fontsize=7)
    axes[0, 0].set_title("seen", fontsize=8)
    axes[0, 1].set_title("predicted by the other presses", fontsize=8)
    figure.savefig(path, dpi=120)
