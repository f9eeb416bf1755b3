"""What a calibrated light is fitted to: slopes, depths and shadows that a press is taken to have, beside the colours
that are seen; and the models that follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.height.slope_polynomial import InverseModel, fit_inverse, inverse_features, to_normal
from calibration.light.dent import dent_gradient, dent_height, whole_profile
from calibration.light.photometry import (
    FEW_PRESSES,
    LARGEST,
    SLOPE_SCALE,
    ModelSize,
    NormalEquations,
    features,
    normal_equations,
    solve,
    terms_of,
)
from calibration.light.press import FAR, NEAR, BallPress, smooth
from calibration.light.refinement import RIM_BLUR, RefinedGeometry
from calibration.light.shadows import DentShade
from tacsim.interface import FloatArray, Mask
from tacsim.models.photometric import (
    CastShadows,
    DepthColour,
    PhotometricModel,
    depth_terms,
    normal_terms,
    place_in_image,
)

Rows = tuple[tuple[float, float, float], ...]  # weights of R, G, B, a row a term

BLUR = 0.8  # of the camera, and of what the forward model is fitted to [px]
INVERSE_BLUR = 1.2  # of what the inverse is fitted to [px]
RIM_MARGIN = 5.0  # that contact and skirt reach further, whatever the radius [px]


def label(press: BallPress, refined: RefinedGeometry, ball: float) -> FloatArray:
    """(H, W, 2) slopes that are taken for the true ones."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]].astype(np.float64)
    return dent_gradient(u, v, press.circle, refined.thickness, ball, RIM_BLUR)


def deepest_dent(refined: RefinedGeometry, ball: float) -> float:
    """Depth of the widest contact [px]."""
    widest = max(refined.circles, key=lambda circle: circle.radius)
    return float(whole_profile(widest.radius, ball, refined.thickness)[1][0])


def beside_slopes(
    press: BallPress, gradient: FloatArray, refined: RefinedGeometry, ball: float, shade: DentShade | None
) -> FloatArray:
    """(H, W, terms) of depth, of slopes (H, W, 2) at depth, and of cast shadows where there are any."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]].astype(np.float64)
    height = dent_height(u, v, press.circle, refined.thickness, ball)
    places = np.meshgrid(*place_in_image(press.shape[1], press.shape[0]))
    terms = depth_terms(height, deepest_dent(refined, ball), *places)
    slopes = SLOPE_SCALE * terms[0] * normal_terms(gradient, LARGEST[0])
    deep = np.ascontiguousarray(np.moveaxis(np.concatenate([terms, slopes]), 0, -1), dtype=np.float64)
    if shade is None:
        return deep
    dark = shade.terms(u.ravel(), v.ravel(), press.circle, refined.thickness, ball)
    return np.concatenate([deep, dark.reshape(*press.shape, -1)], axis=-1)


def near_contact(press: BallPress) -> Mask:
    """(H, W) contact and skirt."""
    return np.asarray(press.distance() < NEAR * press.circle.radius + RIM_MARGIN)


def _places(mask: Mask) -> tuple[FloatArray, FloatArray]:
    """u, v in -1/2..1/2 across the picture of the pixels of a mask (H, W)."""
    rows, columns = np.nonzero(mask)
    u, v = place_in_image(mask.shape[1], mask.shape[0])
    return u[columns], v[rows]


def forward_equations(
    press: BallPress, gradient: FloatArray, beside: FloatArray, counted: Mask | None = None
) -> NormalEquations:
    """`counted` (H, W, 3): what takes part; None: what is not saturated."""
    near = near_contact(press)
    change = smooth(press.change, BLUR)[near]
    lit = press.lit if counted is None else counted
    return normal_equations(gradient[near], *_places(near), change, lit[near], beside[near])


def counted_pixels(
    press: BallPress, gradient: FloatArray, beside: FloatArray, weights: FloatArray, size: ModelSize
) -> Mask:
    """(H, W, 3) what is not saturated, and what is where `weights` say less than is seen: a saturated pixel says "at
    least so bright"."""
    counted = press.lit.copy()
    where = near_contact(press) & ~press.lit.all(axis=2)
    light = features(gradient[where], *_places(where), *LARGEST)
    said = np.concatenate([light, beside[where]], axis=1)[:, terms_of(size)] @ weights
    seen = smooth(press.change, BLUR)[where]
    counted[where] |= (seen > 0) & (said < seen)
    return counted


def _inverse_terms(press: BallPress, where: Mask) -> FloatArray:
    """(n, terms) of the inverse at the pixels of a mask (H, W)."""
    u, v = _places(where)
    return inverse_features(smooth(press.change, INVERSE_BLUR)[where], 2 * u, 2 * v)


def inverse_equations(press: BallPress, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal equations from contact and skirt, and from a tenth as many untouched pixels, whose slope is 0."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]]
    near, far = near_contact(press), press.distance() > FAR * press.circle.radius
    far &= (u + 7 * v) % max(1, round(10 * int(far.sum()) / max(int(near.sum()), 1))) == 0
    target = np.where(far[..., None], 0.0, to_normal(gradient))
    terms = _inverse_terms(press, near | far)
    return terms.T @ terms, terms.T @ target[near | far]


def forward_model(
    pixels: NormalEquations, size: ModelSize, steepest: float, deepest: float, shade: DentShade | None
) -> PhotometricModel:
    """`deepest` [widths of the picture]."""
    weights = tuple((float(r), float(g), float(b)) for r, g, b in solve(pixels, size))
    dark = size.terms - size.shadows
    slopes = dark - size.slopes
    light = slopes - size.depth
    shadows = None
    if shade is not None and size.shadows:
        shadows = CastShadows(lamps=shade.lamps, weights=weights[dark:])
    return PhotometricModel(
        degree=size.degree, position=size.position, weights=weights[:light], steepest=steepest, blur=BLUR,
        shadows=shadows, depth=_depth_colour(deepest, weights[light:slopes], weights[slopes:dark]),
    )  # fmt: skip


def _depth_colour(deepest: float, weights: Rows, slopes: Rows) -> DepthColour | None:
    if not weights:
        return None
    unscaled = tuple((SLOPE_SCALE * r, SLOPE_SCALE * g, SLOPE_SCALE * b) for r, g, b in slopes)
    return DepthColour(deepest=deepest, weights=weights, slopes=unscaled)


def inverse_model(sets: Sequence[tuple[FloatArray, FloatArray]], steepest: float) -> InverseModel:
    weights = fit_inverse(sets, with_position=len(sets) > FEW_PRESSES)
    return InverseModel(weights=tuple((float(x), float(y)) for x, y in weights), steepest=steepest)
