"""The verdict on a calibration as a page: one HTML file, nothing from outside."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np

from calibration.light.checks.verdict import KnownScale, Verdict
from calibration.light.fit import LightFit

FILE = "verdict.html"


def write_page(
    path: Path, name: str, fit: LightFit, scale: KnownScale, verdict: Verdict, residuals: Path | None, facts: list[str]
) -> None:
    """Writes the page of sensor `name`; `residuals`: the picture that is shown in it; `facts`: more of what is known of
    the sensor, in lines. Raises OSError."""
    from jinja2 import Environment, StrictUndefined

    ball = scale.ball_radius / scale.pixel_pitch
    ratios = [press.circle.radius / ball for press in fit.presses]
    template = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).from_string(Path(__file__).with_name("verdict.html.jinja").read_text(encoding="utf-8"))
    picture = None if residuals is None else base64.b64encode(residuals.read_bytes()).decode("ascii")
    means = {
        what: float(np.mean([getattr(press, what) for press in fit.predictions])) if fit.predictions else None
        for what in ("angle", "correlation", "error", "null_error")
    }
    page = template.render(
        name=name, fit=fit, scale=scale, verdict=verdict, picture=picture, facts=facts, ratios=ratios, means=means,
        rows=sorted(fit.predictions, key=lambda press: -press.angle),
    )  # fmt: skip
    path.write_text(page, encoding="utf-8")
