"""The verdict on a calibration as a page (one self-contained HTML file), with a picture of residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.light.checks.verdict import KnownScale, Verdict
from calibration.light.fit import LightFit
from tacsim.report.report import data_url, render_page

FILE = "verdict.html"


def write_page(
    path: Path, name: str, fit: LightFit, scale: KnownScale, verdict: Verdict, residuals: Path | None, facts: list[str]
) -> None:
    """Writes the page of sensor `name`. residuals: its picture. facts: lines with other data of the sensor. Raises
    OSError."""
    ball = scale.ball_radius / scale.pixel_pitch
    ratios = [press.circle.radius / ball for press in fit.presses]
    picture = None if residuals is None else data_url(residuals.read_bytes())
    means = {
        what: float(np.mean([getattr(press, what) for press in fit.predictions])) if fit.predictions else None
        for what in ("angle", "correlation", "error", "null_error")
    }
    page = render_page(
        Path(__file__).with_name("verdict.html.jinja"), name=name, fit=fit, scale=scale, verdict=verdict,
        picture=picture, facts=facts, ratios=ratios, means=means,
        rows=sorted(fit.predictions, key=lambda press: -press.angle),
    )  # fmt: skip
    path.write_text(page, encoding="utf-8")


def draw_residuals(fit: LightFit, path: Path) -> None:
    """Writes a PNG: for each press the observed change of colour, its prediction by the others, and the error, all in
    one scale. Raises ValueError for a fit of one press, which has no prediction; OSError."""
    half_side = 2.0  # of what is drawn [contact radii]
    max_drawn = 8  # drawn, the worst first
    from matplotlib.figure import Figure

    predictions = sorted(fit.predictions, key=lambda press: -press.error)[:max_drawn]
    if not predictions:
        raise ValueError("a calibration from one press leaves none out: there is nothing to draw")
    figure = Figure(figsize=(6.4, 1.9 * len(predictions)), layout="constrained")
    axes = figure.subplots(len(predictions), 3, squeeze=False)
    for row, press in zip(axes, predictions, strict=True):
        reach = half_side * press.circle.radius
        rows = slice(max(0, round(press.circle.y - reach)), round(press.circle.y + reach) + 1)
        columns = slice(max(0, round(press.circle.x - reach)), round(press.circle.x + reach) + 1)
        seen, predicted = press.real[rows, columns], press.predicted[rows, columns]
        for axis, change in zip(row, (seen, predicted, predicted - seen), strict=True):
            axis.imshow(np.clip(128 + change, 0, 255).astype(np.uint8))
            axis.set_xticks([])
            axis.set_yticks([])
        row[0].set_ylabel(press.name, fontsize=7)
        row[2].set_title(f"{press.error:.1f} of {press.null_error:.1f} grey levels, {press.angle:.1f}°", fontsize=7)
    axes[0, 0].set_title("seen", fontsize=8)
    axes[0, 1].set_title("predicted by the other presses", fontsize=8)
    figure.savefig(path, dpi=120)
