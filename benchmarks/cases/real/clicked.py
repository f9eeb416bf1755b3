"""Left-out presses in the mask of the literature: inside circles clicked by hand, which no fit uses.

The circle of a left-out press is the clicked one, moved and scaled by the median correction of the other presses. Light
and thickness of the gel are also those of the other presses. So the scored press contributes only its clicked circle.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.cases.real import balls
from benchmarks.cases.real.balls import BallSet
from benchmarks.cases.real.labels import BadData
from calibration.errors import BadFrames
from calibration.light.calibrator import calibrate_light
from calibration.light.dent import ContactCircle, dent_gradient, dent_height
from calibration.light.fit import LightFit
from calibration.light.press import BallPress, gaussian_blur, make_press, mean_reference_colour
from calibration.light.refinement import DentShade
from calibration.light.tuning import FORWARD_BLUR, MAX_RIM_RATIO, RIM_BLUR
from tacsim.models.photometric import PhotometricLight, image_grid_places

FOLDS = 5
# contact radius over ball radius; clicked circles contain a part of the skirt, some are larger than the ball
MAX_RADIUS_RATIO = 0.95 * MAX_RIM_RATIO


def clicked_errors(folder: Path, of: BallSet) -> list[float]:
    """Mean |error| of each left-out press inside its clicked circle [grey levels], without presses that a calibration
    rejects there (saturated, a second contact). Raises BadData."""
    reference, frames = balls.read_balls(folder, of)
    clicked, ball, found = read_circles(folder, of), of.ball_radius / of.pixel_pitch, []
    missing = [name for name, _ in frames if name not in clicked]
    if missing:
        raise BadData(f"{of.name}: no circle of {', '.join(missing)}")
    for fold in range(FOLDS):
        train = [frame for k, frame in enumerate(frames) if k % FOLDS != fold]
        try:
            fit = calibrate_light(reference, train, ball)
        except BadFrames as error:
            raise BadData(f"{of.name}: {error}") from None
        for name, image in frames[fold::FOLDS]:
            circle = corrected(clicked[name], fit, clicked, ball)
            try:
                press = make_press(name, image, reference, mean_reference_colour(reference), circle)
            except BadFrames:
                continue
            found.append(_mask_error(press, clicked[name], fit, ball))
    return found


def corrected(circle: ContactCircle, fit: LightFit, clicked: Mapping[str, ContactCircle], ball: float) -> ContactCircle:
    """A clicked circle, moved and scaled by the median correction of the presses of `fit`."""
    pairs = [(press.circle, clicked[press.name]) for press in fit.presses]
    x, y = (float(np.median([getattr(a, axis) - getattr(b, axis) for a, b in pairs])) for axis in "xy")
    scale = float(np.median([found.radius / drawn.radius for found, drawn in pairs]))
    return ContactCircle(circle.x + x, circle.y + y, min(circle.radius * scale, MAX_RADIUS_RATIO * ball))


def _mask_error(press: BallPress, inside: ContactCircle, fit: LightFit, ball: float) -> float:
    assert fit.forward is not None
    rows, columns = press.shape
    mean = mean_reference_colour(fit.reference)
    v, u = np.mgrid[:rows, :columns].astype(np.float64)
    light, places = PhotometricLight(fit.forward), image_grid_places(columns, rows)
    slopes = dent_gradient(u, v, press.circle, fit.thickness, ball, RIM_BLUR).astype(np.float32)
    height = (dent_height(u, v, press.circle, fit.thickness, ball) / columns).astype(np.float32)
    change = light.change(slopes, *places, height)[0].astype(np.float64)
    if fit.forward.shadows is not None:
        shade = DentShade(fit.forward.shadows.lamps, press.shape)
        dark = shade.terms(u.ravel(), v.ravel(), press.circle, fit.thickness, ball)
        change += (dark @ np.array(fit.forward.shadows.weights)).reshape(change.shape)
    still = fit.reference + press.drift
    drawn = np.clip(still + gaussian_blur(change, FORWARD_BLUR) * mean, 0.0, 255.0) - still
    where = replace(press, circle=inside).distance() < inside.radius
    return float(np.abs(drawn - press.change * mean)[where].mean())


def has_circles(of: BallSet) -> bool:
    return bool(of.circles or of.archive)


def read_circles(folder: Path, of: BallSet) -> dict[str, ContactCircle]:
    """The clicked circle of each frame [px], from a table next to the frames, whose first columns are name, x, y,
    radius, or from the archive. Raises BadData."""
    try:
        if of.archive:
            with np.load(next(path for name in of.archive for path in folder.rglob(name)), allow_pickle=False) as found:
                both = zip(found["contact_centre_px"], found["contact_radius_px"], strict=True)
                return {f"press {k}": ContactCircle(float(x), float(y), float(r)) for k, ((x, y), r) in enumerate(both)}
        home = next(path.parent for pattern in of.frames for path in sorted(folder.rglob(pattern)))
        with (home / of.circles).open(encoding="utf-8", newline="") as file:
            _, *rows = csv.reader(file)
        return {name: ContactCircle(float(x), float(y), float(r)) for name, x, y, r, *_ in rows}
    except (OSError, StopIteration, KeyError, ValueError) as error:
        raise BadData(f"{of.name}: no clicked circles ({error})") from None
