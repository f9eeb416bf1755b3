"""Fit of a light: labels (assumed slopes, depths and shadows of a press, with the observed colours), the models that
result, their predictions of left-out presses, and the bundle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata

import numpy as np

from calibration.bundle import Calibration, Provenance, Residual
from calibration.height.slopes import InverseModel, fit_inverse, inverse_features, normal_of_slope
from calibration.lens.view import GelView
from calibration.light import tuning
from calibration.light.dent import ContactCircle, cached_profile, dent_gradient, dent_height
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
from calibration.light.press_shapes import Stretch
from calibration.light.refinement import DentShade, RefinedGeometry
from tacsim.interface import Float32, FloatArray, Image, Mask, short_repr
from tacsim.models.photometric import (
    CastShadows,
    DarknessModel,
    DepthColour,
    PhotometricModel,
    depth_terms,
    image_axes,
    normal_terms,
)
from tacsim.models.sensor import CameraNoise, Markers, SensorGeometry

Rows = tuple[tuple[float, float, float], ...]  # weights of R, G, B, one row for each term


def label_slopes(press: BallPress, refined: RefinedGeometry, ball: float) -> FloatArray:
    """(H, W, 2) reference slopes."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]].astype(np.float64)
    return dent_gradient(u, v, press.circle, refined.thickness, ball, tuning.RIM_BLUR)


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
    slopes = tuning.DEEP_SLOPE_SCALE * terms[0] * normal_terms(gradient, MAX_SIZE[0])
    deep = np.ascontiguousarray(np.moveaxis(np.concatenate([terms, slopes]), 0, -1), dtype=np.float64)
    if shade is None:
        return deep
    dark = shade.terms(u.ravel(), v.ravel(), press.circle, refined.thickness, ball)
    return np.concatenate([deep, dark.reshape(*press.shape, -1)], axis=-1)


def contact_and_skirt(press: BallPress) -> Mask:
    """(H, W) contact and skirt."""
    return np.asarray(press.distance() < tuning.SKIRT_RADIUS * press.circle.radius + tuning.RIM_MARGIN)


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
    change = gaussian_blur(press.change, tuning.FORWARD_BLUR)[near]
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
    seen = gaussian_blur(press.change, tuning.FORWARD_BLUR)[where]
    counted[where] |= (seen > 0) & (said < seen)
    return counted


def _inverse_terms(press: BallPress, where: Mask) -> FloatArray:
    """(n, terms) of the inverse at the pixels of a mask (H, W)."""
    u, v = _image_places(where)
    return inverse_features(gaussian_blur(press.change, tuning.INVERSE_BLUR)[where], 2 * u, 2 * v)


def inverse_equations(press: BallPress, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normal equations from contact and skirt, and from a tenth as many untouched pixels, whose slope is 0."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]]
    near, far = contact_and_skirt(press), press.distance() > tuning.UNTOUCHED_RADIUS * press.circle.radius
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
        degree=size.degree, position=size.position, weights=weights[:light], steepest=steepest,
        blur=tuning.FORWARD_BLUR, shadows=shadows,
        depth=_depth_colour(deepest, weights[light:slopes], weights[slopes:dark]),
    )  # fmt: skip


def _depth_colour(deepest: float, weights: Rows, slopes: Rows) -> DepthColour | None:
    if not weights:
        return None
    unscaled = tuple(
        (tuning.DEEP_SLOPE_SCALE * r, tuning.DEEP_SLOPE_SCALE * g, tuning.DEEP_SLOPE_SCALE * b) for r, g, b in slopes
    )
    return DepthColour(deepest=deepest, weights=weights, slopes=unscaled)


def inverse_model(sets: Sequence[tuple[FloatArray, FloatArray]], steepest: float) -> InverseModel:
    weights = fit_inverse(sets, with_position=len(sets) > tuning.MAX_FEW_PRESSES)
    return InverseModel(weights=tuple((float(x), float(y)) for x, y in weights), steepest=steepest)


@dataclass(frozen=True, slots=True, eq=False)
class PressPrediction:
    """Error of the prediction of one press by a calibration without it."""

    name: str
    circle: ContactCircle
    error: float  # mean |error| in contact and near it (r < 1.5 a) [grey levels]
    null_error: float  # the same, if no change were predicted: the background alone
    correlation: float  # of predicted and real change there
    predicted: Float32  # (H, W, 3) change of colour [grey levels]
    real: Float32  # (H, W, 3) the same, as seen, without drift
    angle: float  # mean error of the normal by the inverse model in contact [degrees]
    untouched_angle: float  # the same, far from contact


@dataclass(frozen=True, slots=True, eq=False)
class LightFit:
    """A calibrated light."""

    __repr__ = short_repr
    forward: PhotometricModel | None  # None, as the next two, for a light without direction
    inverse: InverseModel | None
    size: ModelSize | None
    thickness: float  # of the gel, from the skirts of the dents [px]
    radius_uncertainty: float  # of the scale of all contact radii [-]; NaN for a single press
    residual_shares: tuple[float, ...]  # share of each press's change of colour that no dent explains
    predictions: tuple[PressPrediction, ...]
    left_out: tuple[tuple[str, str], ...]  # frames that were not used, with the reasons
    warnings: tuple[str, ...]
    reference: Image
    presses: tuple[BallPress, ...]
    frames: tuple[str, ...]  # names of all that were given
    darkness: DarknessModel | None = None  # of a light that shows depth and no direction; lengths in pixels
    stretch: Stretch | None = None  # of contacts, which are round; None: not measured
    image_warnings: tuple[str, ...] = ()  # reasons not to trust the pictures, each with advice after a colon

    def to_calibration(
        self,
        serial: str,
        ball_radius: float,
        pixel_pitch: float,
        *,
        view: GelView | None = None,
        markers: Markers | None = None,
        noise: CameraNoise | None = None,
        skin: float | None = None,
    ) -> Calibration:
        """The calibration of sensor `serial`, made now; `ball_radius`, `pixel_pitch` [m]. `write_bundle` sets the
        checksums."""
        rows, columns, _ = self.reference.shape
        return Calibration(
            serial=serial,
            geometry=view.geometry if view else SensorGeometry(width=columns, height=rows, pixel_pitch=pixel_pitch),
            gel_size=(columns * pixel_pitch, rows * pixel_pitch),
            forward=self.forward,
            inverse=self.inverse,
            darkness=None if self.darkness is None else self.darkness.scaled(pixel_pitch),
            view=view,
            markers=markers,
            noise=noise,
            skin=skin,
            residuals=tuple(
                Residual(
                    frame=press.name,
                    circle=(press.circle.x, press.circle.y, press.circle.radius),
                    error=press.error,
                    nothing=press.null_error,
                    correlation=press.correlation,
                    angle=press.angle,
                )
                for press in self.predictions
            ),
            provenance=Provenance(
                made=datetime.now(UTC).isoformat(timespec="seconds"),
                software=f"tacsim {metadata.version('tacsim')}",
                ball_radius=ball_radius,
                frames=self.frames,
                left_out=dict(self.left_out),
                warnings=self.warnings,
            ),
            reference="0" * 64,
        )


def compare_with_prediction(
    press: BallPress, predicted: FloatArray, angles: FloatArray, mean: FloatArray, reference: Image
) -> PressPrediction:
    """A press and its prediction: change of colour (H, W, 3) [grey levels], and error of the normals (H, W)
    [degrees]."""
    distance = press.distance() / press.circle.radius
    untouched_here = np.float64(reference) + press.drift  # what this frame would show without contact
    predicted = np.clip(untouched_here + predicted, 0.0, 255.0) - untouched_here
    real = press.change * mean
    contact, far = distance < 1.5, distance > tuning.UNTOUCHED_RADIUS
    return PressPrediction(
        press.name,
        press.circle,
        error=float(np.abs(predicted - real)[contact].mean()),
        null_error=float(np.abs(real)[contact].mean()),
        correlation=float(np.corrcoef(predicted[contact].ravel(), real[contact].ravel())[0, 1]),
        predicted=predicted.astype(np.float32),
        real=real.astype(np.float32),
        angle=float(angles[distance < 1].mean()),
        untouched_angle=float(angles[far].mean()) if far.any() else 0.0,
    )


def normal_angle(one: FloatArray, other: FloatArray) -> FloatArray:
    """(...,) angle [degrees] between unit normals given by their parts (..., 2) in the plane."""

    def full_normal(parts: FloatArray) -> FloatArray:
        square = (parts**2).sum(axis=-1, keepdims=True)
        shorter = parts * np.minimum(1.0, 0.999 / np.sqrt(np.maximum(square, 1e-12)))
        return np.concatenate([shorter, np.sqrt(1.0 - (shorter**2).sum(axis=-1, keepdims=True))], axis=-1)

    cosine = (full_normal(one) * full_normal(other)).sum(axis=-1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
