"""Labels for the fit of a light: assumed slopes, depths and shadows of a press, with the observed colours; and the
models that result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.height.slopes import InverseModel, fit_inverse, inverse_features, normal_of_slope
from calibration.light.dent import cached_profile, dent_gradient, dent_height
from calibration.light.photometry import (
    MAX_SIZE,
    ModelSize,
    NormalEquations,
    normal_equations,
    photometric_features,
    solve_weights,
    terms_of,
)
from calibration.light.press import BallPress, gaussian_blur
from calibration.light.refinement import DentShade, RefinedGeometry
from calibration.light.tuning import (
    DEEP_SLOPE_SCALE,
    FORWARD_BLUR,
    INVERSE_BLUR,
    MAX_FEW_PRESSES,
    RIM_BLUR,
    RIM_MARGIN,
    SKIRT_RADIUS,
    UNTOUCHED_RADIUS,
)
from tacsim.interface import FloatArray, Mask
from tacsim.models.photometric import (
    CastShadows,
    DepthColour,
    PhotometricModel,
    depth_terms,
    image_axes,
    normal_terms,
)

Rows = tuple[tuple[float, float, float], ...]  # weights of R, G, B, one row for each term


def label_slopes(press: BallPress, refined: RefinedGeometry, ball: float) -> FloatArray:
    """(H, W, 2) reference slopes."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]].astype(np.float64)
    return dent_gradient(u, v, press.circle, refined.thickness, ball, RIM_BLUR)


def deepest_dent(refined: RefinedGeometry, ball: float) -> float:
    """Depth of the widest contact [px]."""
    widest = max(refined.circles, key=lambda circle: circle.radius)
    return float(cached_profile(widest.radius, ball, refined.thickness)[1][0])


def extra_forward_terms(
    press: BallPress, gradient: FloatArray, refined: RefinedGeometry, ball: float, shade: DentShade | None
) -> FloatArray:
    """(H, W, terms) of depth, of slopes (H, W, 2) at depth, and of cast shadows if there are any."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]].astype(np.float64)
    height = dent_height(u, v, press.circle, refined.thickness, ball)
    places = np.meshgrid(*image_axes(press.shape[1], press.shape[0]))
    terms = depth_terms(height, deepest_dent(refined, ball), *places)
    slopes = DEEP_SLOPE_SCALE * terms[0] * normal_terms(gradient, MAX_SIZE[0])
    deep = np.ascontiguousarray(np.moveaxis(np.concatenate([terms, slopes]), 0, -1), dtype=np.float64)
    if shade is None:
        return deep
    dark = shade.terms(u.ravel(), v.ravel(), press.circle, refined.thickness, ball)
    return np.concatenate([deep, dark.reshape(*press.shape, -1)], axis=-1)


def contact_and_skirt(press: BallPress) -> Mask:
    """(H, W) contact and skirt."""
    return np.asarray(press.distance() < SKIRT_RADIUS * press.circle.radius + RIM_MARGIN)


def _image_places(mask: Mask) -> tuple[FloatArray, FloatArray]:
    """u, v in -1/2..1/2 across the picture of the pixels of a mask (H, W)."""
    rows, columns = np.nonzero(mask)
    u, v = image_axes(mask.shape[1], mask.shape[0])
    return u[columns], v[rows]


def forward_equations(
    press: BallPress, gradient: FloatArray, extra_terms: FloatArray, counted: Mask | None = None
) -> NormalEquations:
    """counted: (H, W, 3) used values; None: those that are not saturated."""
    near = contact_and_skirt(press)
    change = gaussian_blur(press.change, FORWARD_BLUR)[near]
    lit = press.lit if counted is None else counted
    return normal_equations(gradient[near], *_image_places(near), change, lit[near], extra_terms[near])


def counted_pixels(
    press: BallPress, gradient: FloatArray, extra_terms: FloatArray, weights: FloatArray, size: ModelSize
) -> Mask:
    """(H, W, 3) True for values that are not saturated, and for saturated ones that `weights` predict too dark, because
    a saturated value is a lower bound."""
    counted = press.lit.copy()
    where = contact_and_skirt(press) & ~press.lit.all(axis=2)
    light = photometric_features(gradient[where], *_image_places(where), *MAX_SIZE)
    said = np.concatenate([light, extra_terms[where]], axis=1)[:, terms_of(size)] @ weights
    seen = gaussian_blur(press.change, FORWARD_BLUR)[where]
    counted[where] |= (seen > 0) & (said < seen)
    return counted


def _inverse_terms(press: BallPress, where: Mask) -> FloatArray:
    """(n, terms) of the inverse at the pixels of a mask (H, W)."""
    u, v = _image_places(where)
    return inverse_features(gaussian_blur(press.change, INVERSE_BLUR)[where], 2 * u, 2 * v)


def inverse_equations(press: BallPress, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal equations from contact and skirt, and from a tenth as many untouched pixels, whose slope is 0."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]]
    near, far = contact_and_skirt(press), press.distance() > UNTOUCHED_RADIUS * press.circle.radius
    far &= (u + 7 * v) % max(1, round(10 * int(far.sum()) / max(int(near.sum()), 1))) == 0
    target = np.where(far[..., None], 0.0, normal_of_slope(gradient))
    terms = _inverse_terms(press, near | far)
    return terms.T @ terms, terms.T @ target[near | far]


def forward_model(
    pixels: NormalEquations, size: ModelSize, steepest: float, deepest: float, shade: DentShade | None
) -> PhotometricModel:
    """`deepest` [widths of the picture]."""
    weights = tuple((float(r), float(g), float(b)) for r, g, b in solve_weights(pixels, size))
    dark = size.terms - size.shadows
    slopes = dark - size.slopes
    light = slopes - size.depth
    shadows = None
    if shade is not None and size.shadows:
        shadows = CastShadows(lamps=shade.lamps, weights=weights[dark:])
    return PhotometricModel(
        degree=size.degree, position=size.position, weights=weights[:light], steepest=steepest, blur=FORWARD_BLUR,
        shadows=shadows, depth=_depth_colour(deepest, weights[light:slopes], weights[slopes:dark]),
    )  # fmt: skip


def _depth_colour(deepest: float, weights: Rows, slopes: Rows) -> DepthColour | None:
    if not weights:
        return None
    unscaled = tuple((DEEP_SLOPE_SCALE * r, DEEP_SLOPE_SCALE * g, DEEP_SLOPE_SCALE * b) for r, g, b in slopes)
    return DepthColour(deepest=deepest, weights=weights, slopes=unscaled)


def inverse_model(sets: Sequence[tuple[FloatArray, FloatArray]], steepest: float) -> InverseModel:
    weights = fit_inverse(sets, with_position=len(sets) > MAX_FEW_PRESSES)
    return InverseModel(weights=tuple((float(x), float(y)) for x, y in weights), steepest=steepest)
