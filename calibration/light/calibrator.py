"""Calibrates the light of a sensor from a few presses of a ball of known radius.

Finds the contact circles, refines them together with the gel's thickness and the light, then fits the forward
model (slope -> colour) and the inverse one (colour -> slope) to the same labels.
"""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from calibration.errors import BadFrames
from calibration.height.slopes import (
    DarknessSlopes,
    InverseModel,
    PolynomialSlopes,
    normal_of_slope,
)
from calibration.height.surface_finder import ForwardSteps, Integrator, slopes_of
from calibration.light import tuning
from calibration.light.consistency import find_blurred_presses, find_inconsistent_presses, find_reference_contact
from calibration.light.darkness import find_dark_press, fit_darkness, is_direction_free
from calibration.light.dent import NoCircle, dent_gradient, dent_height, max_dent_slope
from calibration.light.fit import (
    LightFit,
    PressPrediction,
    compare_with_prediction,
    contact_and_skirt,
    counted_pixels,
    deepest_dent,
    extra_forward_terms,
    forward_equations,
    forward_model,
    inverse_equations,
    inverse_model,
    label_slopes,
    normal_angle,
)
from calibration.light.photometry import SLOPE_TERMS, ModelSize, NormalEquations, choose_size, solve_weights
from calibration.light.press import BallPress, Window, find_press, gaussian_blur, mean_reference_colour
from calibration.light.press_shapes import find_other_balls, fit_stretch
from calibration.light.refinement import DentShade, RefinedGeometry, find_lamps, refine_geometry
from calibration.reference import is_channel_order_swapped
from calibration.tuning import STALE_COLOUR
from tacsim.interface import FloatArray, Image
from tacsim.models.photometric import (
    DEPTH_TERMS,
    PhotometricLight,
    PhotometricModel,
    image_grid_places,
)
from tacsim.optics.render import darken_by_depth

SATURATED_ROUNDS = 2  # of the search for saturated pixels that are predicted too dark
ORDER_FRAMES = 9  # maximum number of frames whose median gives the channel order
NO_DIRECTION = "this light tells no direction: all flanks of a dent change alike"


class NoDirection(BadFrames):
    """A light shows neither direction nor depth: it has no model."""


def calibrate_light(
    reference: Image,
    frames: Sequence[tuple[str, Image]],
    ball: float,
    erase: Callable[[Image], Image] | None = None,
    untouched: Sequence[Image] = (),
) -> LightFit:
    """Calibrates the light of one sensor.

    Args:
        reference: (H, W, 3) uint8 RGB without contact.
        frames: names and pictures of presses, same size.
        ball: radius of the ball [px].
        erase: removes the dots that are printed on the gel.
        untouched: other pictures without contact, for checks only.

    The pictures determine the kind of light: if colours change equally all around each contact, the light shows no
    direction, and is calibrated as one that shows depth as darkness.

    Raises BadFrames, with the errors of all frames, if no press can be used; NoDirection.
    """
    _require_valid_frames(reference, frames)
    shown = reference
    if erase is not None:
        reference, frames = erase(reference), [(name, erase(image)) for name, image in frames]
        untouched = [erase(image) for image in untouched]
    mean = mean_reference_colour(reference)
    dark = is_direction_free((image - np.float64(reference)) / mean for _, image in frames[:ORDER_FRAMES])
    found: list[BallPress] = []
    left_out: list[tuple[str, str]] = []
    for name, image in frames:
        try:
            found.append((find_dark_press if dark else find_press)(name, image, reference, mean, ball))
        except (NoCircle, BadFrames) as error:
            left_out.append((name, str(error)))
    if dark:
        return replace(
            _calibrate_darkness(found, left_out, mean, reference, ball), reference=shown, frames=_join_names(frames)
        )
    _leave_out_outliers(found, left_out, reference, mean, ball)
    presses, refined = _leave_out_other_balls(*_refine_without_outlier(found, left_out, ball), left_out, ball)
    contact = find_reference_contact(presses, reference, mean, untouched, ball)
    thin = [_press_window(press, tuning.SHADED_PIXELS) for press in presses]
    stretch = fit_stretch(thin, refined.circles, refined.thickness, ball, presses[0].shape)
    presses, refined, shade = _fit_shadows(presses, refined, ball)
    labels = [label_slopes(press, refined, ball) for press in presses]
    extra_terms_of_presses = [
        extra_forward_terms(press, g, refined, ball, shade) for press, g in zip(presses, labels, strict=True)
    ]
    size, forward_sets = _forward_equations(presses, labels, extra_terms_of_presses)
    inverse_sets = [inverse_equations(p, g) for p, g in zip(presses, labels, strict=True)]
    all_equations = functools.reduce(operator.add, forward_sets)
    steepest, deepest = max(max_dent_slope(press.circle, ball) for press in presses), deepest_dent(refined, ball)
    model = partial(forward_model, size=size, steepest=steepest, deepest=deepest / reference.shape[1], shade=shade)
    predictions = tuple(
        _predict_press(
            press,
            labels[i],
            extra_terms_of_presses[i],
            model(all_equations - forward_sets[i]),
            inverse_model([*inverse_sets[:i], *inverse_sets[i + 1 :]], steepest),
            mean,
            reference,
        )
        for i, press in enumerate(presses)
        if len(presses) > 1
    )
    return LightFit(
        forward=model(all_equations),
        inverse=inverse_model(inverse_sets, steepest),
        size=size,
        thickness=refined.thickness,
        radius_uncertainty=refined.radius_uncertainty(),
        residual_shares=refined.residual_shares,
        predictions=predictions,
        left_out=tuple(left_out),
        warnings=(*_warnings(presses, mean, len(left_out)), *_poorly_predicted(predictions)),
        reference=shown,
        presses=tuple(presses),
        frames=_join_names(frames),
        stretch=stretch,
        image_warnings=() if contact is None else (contact,),
    )


def _leave_out_outliers(
    found: list[BallPress], left_out: list[tuple[str, str]], reference: Image, mean: FloatArray, ball: float
) -> None:
    """Notes on blurred pictures, and on presses that the light of the others does not explain."""
    for k, share in reversed(find_blurred_presses(found, reference, mean)):
        why = f"blurred: {share:.0%} of the fine detail of other pictures; press again, held still and in focus"
        left_out.append((found.pop(k).name, why))
    for k in reversed(
        find_inconsistent_presses(found, [_press_window(press, tuning.SHADED_PIXELS) for press in found], ball)
    ):
        why = "most other presses do not explain it: another sensor or ball, turned, or red and blue swapped?"
        left_out.append((found.pop(k).name, why))


def _leave_out_other_balls(
    presses: list[BallPress], refined: RefinedGeometry, left_out: list[tuple[str, str]], ball: float
) -> tuple[list[BallPress], RefinedGeometry]:
    """The presses without those of another ball."""
    windows = [_press_window(press, tuning.SHADED_PIXELS) for press in presses]
    others, ratio = find_other_balls(windows, refined.circles, refined.thickness, ball, presses[0].shape)
    if not others:
        return presses, refined
    why = f"its slopes are those of a ball {ratio:.2f} times as large as in the other presses: use one ball"
    left_out += [(presses[k].name, why) for k in others]
    return _refine_without_outlier([press for k, press in enumerate(presses) if k not in others], left_out, ball)


def _forward_equations(
    presses: Sequence[BallPress], labels: Sequence[FloatArray], extra_terms_of_presses: Sequence[FloatArray]
) -> tuple[ModelSize, list[NormalEquations]]:
    """The size of the forward model, and the equations of each press, which include saturated pixels that are predicted
    too dark."""
    sets = [forward_equations(p, g, b) for p, g, b in zip(presses, labels, extra_terms_of_presses, strict=True)]
    size = choose_size(sets)
    saturated = [k for k, press in enumerate(presses) if not press.lit[contact_and_skirt(press)].all()]
    for _ in range(SATURATED_ROUNDS if saturated else 0):
        weights = solve_weights(functools.reduce(operator.add, sets), size)
        for k in saturated:
            known = presses[k], labels[k], extra_terms_of_presses[k]
            sets[k] = forward_equations(*known, counted_pixels(*known, weights, size))
    return size, sets


def _join_names(frames: Sequence[tuple[str, Image]]) -> tuple[str, ...]:
    return tuple(name for name, _ in frames)


def _calibrate_darkness(
    found: list[BallPress], left_out: list[tuple[str, str]], mean: FloatArray, reference: Image, ball: float
) -> LightFit:
    """The calibration of a light that shows depth and no direction. Raises BadFrames if it shows no depth."""
    if not found:
        raise _no_presses_error(left_out)
    try:
        fit = fit_darkness(found, ball)
        while max(fit.residual_shares) > tuning.MAX_DARKNESS_RESIDUAL and len(found) > 1:
            worst = int(np.argmax(fit.residual_shares))
            left_out.append(
                (found.pop(worst).name, f"depth explains only {1 - fit.residual_shares[worst]:.0%} of its darkness")
            )
            fit = fit_darkness(found, ball)
    except BadFrames as why:
        raise NoDirection(f"{NO_DIRECTION}, and {why}") from None
    if max(fit.residual_shares) > tuning.MAX_DARKNESS_RESIDUAL:
        raise NoDirection(
            f"{NO_DIRECTION}, and depth explains only {1 - max(fit.residual_shares):.0%} of how dark it gets: is the "
            "ball round, its radius right, and exposure fixed?"
        )
    predictions = []
    for press, model in zip(fit.presses, fit.left_out, strict=True):
        if model is None:
            continue
        v, u = np.mgrid[: press.shape[0], : press.shape[1]].astype(np.float64)
        change, _ = darken_by_depth(model, dent_height(u, v, press.circle, fit.thickness, ball).astype(np.float32), 1.0)
        slopes, _ = DarknessSlopes(model, press.shape, 1.0)(press.change.astype(np.float32))
        label = dent_gradient(u, v, press.circle, fit.thickness, ball)
        angles = normal_angle(normal_of_slope(slopes.astype(np.float64)), normal_of_slope(label))
        predictions.append(compare_with_prediction(press, change.astype(np.float64) * mean, angles, mean, reference))
    return LightFit(
        forward=None,
        inverse=None,
        size=None,
        thickness=fit.thickness,
        radius_uncertainty=fit.radius_uncertainty,
        residual_shares=fit.residual_shares,
        predictions=tuple(predictions),
        left_out=tuple(left_out),
        warnings=(*_warnings(fit.presses, mean, len(left_out)), *_poorly_predicted(predictions)),
        reference=reference,
        presses=fit.presses,
        frames=(),
        darkness=fit.model,
    )


def _no_presses_error(left_out: Sequence[tuple[str, str]]) -> BadFrames:
    alike: dict[str, list[tuple[str, str]]] = {}
    for name, why in left_out:
        alike.setdefault(re.sub(r"\d+", "", why), []).append((name, why))
    said = (
        f"{some[0][0]}{f' and {len(some) - 1} more' if len(some) > 1 else ''}: {some[0][1]}" for some in alike.values()
    )
    return BadFrames("no frame can be used. " + "; ".join(said))


def _require_valid_frames(reference: Image, frames: Sequence[tuple[str, Image]]) -> None:
    """Raises BadFrames without frames, for different sizes, and for red and blue exchanged."""
    if not frames:
        raise BadFrames("no frame of a press; give at least one, better 5 to 8, in addition to the one without contact")
    other = [
        f"{name} ({image.shape[1]} x {image.shape[0]})" for name, image in frames if image.shape != reference.shape
    ]
    if other:
        raise BadFrames(
            f"frames of another size than the one without contact ({reference.shape[1]} x {reference.shape[0]} px): "
            f"{', '.join(other)}; all must be of one camera and one setting"
        )
    # the median of the frames shows the gel nearly without contact
    median = np.median(np.stack([image for _, image in frames[:ORDER_FRAMES]]), axis=0).astype(np.float32)
    if is_channel_order_swapped(median, reference.astype(np.float32), np.ones(reference.shape[:2], dtype=np.bool_)):
        raise BadFrames(
            "the frames are like the picture without contact only with red and blue exchanged: give all in one order"
        )


def _refine_without_outlier(
    found: list[BallPress], left_out: list[tuple[str, str]], ball: float
) -> tuple[list[BallPress], RefinedGeometry]:
    """Refines all circles, removes the worst outlier, and refines again. Raises BadFrames if no press is left."""
    while found:
        refined = refine_geometry([_press_window(press) for press in found], [press.circle for press in found], ball)
        limit = tuning.MAX_RESIDUAL_SHARE
        if len(found) > 2:
            limit = min(
                limit,
                max(tuning.MAX_RESIDUAL_RATIO * float(np.median(refined.residual_shares)), tuning.MAX_GOOD_RESIDUAL),
            )
        worst = int(np.argmax(refined.residual_shares))
        if refined.residual_shares[worst] <= limit:
            return [replace(p, circle=c) for p, c in zip(found, refined.circles, strict=True)], refined
        why = (
            f"the fitted ball dent explains only {1 - refined.residual_shares[worst]:.0%} of the colour change (at "
            f"least {1 - limit:.0%} needed)"
        )
        left_out.append((found.pop(worst).name, why))
    raise _no_presses_error(left_out)


def _fit_shadows(
    presses: list[BallPress], refined: RefinedGeometry, ball: float
) -> tuple[list[BallPress], RefinedGeometry, DentShade | None]:
    """The circles refined with cast shadows, and the lamps of these; without shadows the given circles, and None.
    Without lamps, circles would grow into a shadow, as if it were skirt."""
    round_count = 2  # of refining circles and lamps in turn
    if len(presses) <= tuning.MAX_FEW_PRESSES or np.mean(refined.residual_shares) < tuning.MIN_SHADOW_RESIDUAL:
        return presses, refined, None
    windows, circles = [_press_window(press, tuning.SHADED_PIXELS) for press in presses], refined.circles
    shade = find_lamps(windows, circles, refined.thickness, ball, presses[0].shape)
    slopes = [label_slopes(press, refined, ball) for press in presses]
    sets = [
        forward_equations(p, g, extra_forward_terms(p, g, refined, ball, shade))
        for p, g in zip(presses, slopes, strict=True)
    ]
    if not choose_size(sets).shadows:
        return presses, refined, None
    for _ in range(round_count):  # circles give the lamps, and the lamps give better circles
        refined = refine_geometry(windows, refined.circles, ball, shade, (ball / refined.thickness,))
        shade = find_lamps(windows, refined.circles, refined.thickness, ball, presses[0].shape)
    return [replace(p, circle=c) for p, c in zip(presses, refined.circles, strict=True)], refined, shade


def _warnings(presses: Sequence[BallPress], mean: FloatArray, left_out: int) -> list[str]:
    """Notes on frames to check by eye; calibration.light.verdict judges the figures."""
    found = []
    drift = float(np.abs(np.median([(p.drift / mean).mean(axis=(0, 1)) for p in presses], axis=0)).max())
    if drift > STALE_COLOUR:
        found.append(
            f"where nothing touches, the presses differ from the picture without contact by {drift:.0%}: was it taken "
            "with the same light, just before?"
        )
    if left_out > len(presses):
        found.append("most frames were left out: does the picture without contact really show none?")
    if len(presses) == 1:
        return found
    height, width = presses[0].shape
    if (
        max(np.ptp([p.circle.x for p in presses]) / width, np.ptp([p.circle.y for p in presses]) / height)
        < tuning.MIN_SPREAD
    ):
        found.append("all presses are in one place: nothing is known of light elsewhere on the gel; spread them")
    return found


def _poorly_predicted(predictions: Sequence[PressPrediction]) -> list[str]:
    """A note on presses with bad predictions, from three presses on: of two, either may be the bad one."""
    bad = [prediction for prediction in predictions if prediction.angle > tuning.MAX_NORMAL_ERROR]
    if len(predictions) < 3 or not bad:
        return []
    worst = max(prediction.angle for prediction in bad)
    names = ", ".join(prediction.name for prediction in bad)
    return [
        f"{names} predicted badly by the others, normals off by up to {worst:.0f} degrees: another ball, a bad frame?"
    ]


def _press_window(press: BallPress, pixels: int = 2500) -> Window:
    """Pixels of contact and skirt, reduced to about `count`."""
    v, u = np.nonzero(contact_and_skirt(press))
    thin = max(1, round(np.sqrt(len(u) / pixels)))
    keep = (u % thin == 0) & (v % thin == 0) & press.lit[v, u].all(axis=1)
    u, v = u[keep], v[keep]
    return Window(u.astype(np.float64), v.astype(np.float64), gaussian_blur(press.change, tuning.FORWARD_BLUR)[v, u])


def _predict_press(
    press: BallPress,
    gradient: FloatArray,
    extra_terms: FloatArray,
    forward: PhotometricModel,
    inverse: InverseModel,
    mean: FloatArray,
    reference: Image,
) -> PressPrediction:
    """The prediction of a press with labels `gradient` (H, W, 2), `extra_terms` (H, W, terms), by models without it.
    Slopes are found as in every picture: from each pixel's colour, then those of a surface that fits the forward
    model."""
    places = image_grid_places(*press.shape[::-1])
    height = None if forward.depth is None else (extra_terms[..., 0] * forward.depth.deepest).astype(np.float32)
    light, _ = PhotometricLight(forward).change(gradient.astype(np.float32), *places, height)
    predicted = light.astype(np.float64)
    if forward.shadows is not None:
        predicted += extra_terms[..., DEPTH_TERMS + SLOPE_TERMS :] @ np.array(forward.shadows.weights)
    predicted = gaussian_blur(predicted, tuning.FORWARD_BLUR) * mean
    seen = gaussian_blur(press.change, tuning.INVERSE_BLUR).astype(np.float32)
    slopes, _ = PolynomialSlopes(inverse, *(2 * place.astype(np.float64) for place in places))(seen)
    integrate, nothing = Integrator(press.shape, 1.0), np.zeros(press.shape, dtype=np.bool_)
    steps = ForwardSteps(forward, *places, 1.0, float(press.shape[1]))
    height = steps(np.ascontiguousarray(np.moveaxis(seen, -1, 0)), integrate(slopes), nothing, integrate)
    found = np.stack(slopes_of(height, 1.0), axis=-1)
    angles = normal_angle(normal_of_slope(found.astype(np.float64)), normal_of_slope(gradient))
    return compare_with_prediction(press, predicted, angles, mean, reference)
