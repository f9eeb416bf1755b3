"""From a few presses of a ball of known radius to a calibrated sensor.

Finds the contact circles itself, refines them with the gel's elastic skirt and the light all together, then fits the
forward model (slope -> colour) and the inverse one (colour -> slope) to the same labels.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import BadFrames
from calibration.height.slope_polynomial import InverseModel, fit_inverse, inverse_features, to_normal
from calibration.light.circle import NoCircle, contact_circle
from calibration.light.dent import STEEPEST_RIM, ContactCircle, Skirt, dent_gradient, rim_slope
from calibration.light.photometry import FEW, Equations, Order, choose_order, equations, solve
from calibration.light.refinement import BLUR as RIM_BLUR
from calibration.light.refinement import Refined, Window, refine
from calibration.reference import SATURATED, STALE_COLOUR, UnusableReference, exchanged, make_reference
from tacsim.models.photometric import PhotometricLight, PhotometricModel, place_in_image, places_in_image

Float64 = NDArray[np.float64]
Image = NDArray[np.uint8]

BLUR = 0.8  # of the camera, and of what is fitted [px]
INVERSE_BLUR = 1.2  # of what the inverse is fitted to [px]
NEAR = 2.3  # a press is looked at up to this many contact radii
FAR = 3.0  # beyond this many, the gel is untouched
PIXELS = 2500  # of a press that the refinement looks at, about
LEAST_UNTOUCHED = 0.15  # share of the picture that must be untouched for a drift to be told
TOO_LITTLE = 0.5  # share of its change of colour that a dent may leave unexplained, or the press is left out
SURELY = 0.05  # a press that leaves no more than this share unexplained is no outlier
OUTLIER = 5.0  # a press whose unexplained share is so many times the median's is left out
MOST_SATURATED = 0.4  # of the contact
MEDIAN_OF = 9  # frames, at most, whose median tells the order of colours
ONE_PLACE = 0.2  # presses that spread over less than this share of the picture say nothing of the rest
ODD = 3.0  # a press whose normals are so many times as wrong as usual, and by ODD_ANGLE, is worth a look
ODD_ANGLE = 8.0  # [degrees]
SECOND = 0.7  # a second patch as strong as this share of the first is a second contact


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """One frame that takes part."""

    name: str
    circle: ContactCircle
    change: Float64  # (H, W, 3) relative change of colour, drift removed
    drift: Float64  # (H, W, 3) what was removed
    lit: NDArray[np.bool_]  # (H, W, 3) not saturated

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (self.lit.shape[0], self.lit.shape[1])


@dataclass(frozen=True, slots=True, eq=False)
class PressPrediction:
    """How well one press is predicted by a calibration that has not seen it."""

    name: str
    circle: ContactCircle
    error: float  # mean |error| in contact and near it (r < 1.5 a) [grey levels]
    nothing: float  # the same, if no change were predicted: the background alone
    correlation: float  # of predicted and real change there
    predicted: NDArray[np.float32]  # (H, W, 3) change of colour [grey levels]
    real: NDArray[np.float32]  # (H, W, 3) the same, as seen, without drift
    angle: float  # mean error of the normal by the inverse model in contact [degrees]
    untouched_angle: float  # the same, far from contact


@dataclass(frozen=True, slots=True, eq=False)
class LightFit:
    """A calibrated light."""

    forward: PhotometricModel
    inverse: InverseModel
    order: Order
    skirt: Skirt  # [px]
    scores: tuple[PressPrediction, ...]
    left_out: tuple[tuple[str, str], ...]  # frames that took no part, and why
    warnings: tuple[str, ...]
    reference: Image
    presses: tuple[Press, ...]

    @property
    def steepest(self) -> float:
        return self.forward.steepest


def calibrate_light(
    reference: Image,
    frames: Sequence[tuple[str, Image]],
    ball: float,
    erase: Callable[[Image], Image] | None = None,
) -> LightFit:
    """Calibrates the light of one sensor.

    Args:
        reference: (H, W, 3) uint8 RGB without contact.
        frames: names and pictures of presses, same size.
        ball: radius of the ball [px].
        erase: takes away the dots that are printed on the gel.

    Raises BadFrames, with what is wrong in every frame, when no press can be used.
    """
    _check_frames(reference, frames)
    _check_order(reference, frames)
    shown = reference
    if erase is not None:
        reference, frames = erase(reference), [(name, erase(image)) for name, image in frames]
    mean = untouched_mean(reference)
    found: list[Press] = []
    refused: list[tuple[str, str]] = []
    for name, image in frames:
        try:
            found.append(find_press(name, image, reference, mean, ball))
        except (NoCircle, BadFrames) as error:
            refused.append((name, str(error)))
    presses, refined = _refined(found, refused, ball)
    labels = [_gradient(press, refined.skirt, ball) for press in presses]
    forward_sets = [_forward_equations(p, g) for p, g in zip(presses, labels, strict=True)]
    inverse_sets = [_inverse_equations(p, g) for p, g in zip(presses, labels, strict=True)]
    order = choose_order(forward_sets)
    every = functools.reduce(operator.add, forward_sets)
    steepest = max(rim_slope(press.circle, ball) for press in presses)
    scores = tuple(
        _score(
            press,
            labels[i],
            _forward_model(every - forward_sets[i], order, steepest),
            fit_inverse([*inverse_sets[:i], *inverse_sets[i + 1 :]], place=len(presses) - 1 > FEW),
            mean,
            reference,
        )
        for i, press in enumerate(presses)
        if len(presses) > 1
    )
    warnings = [*_doubts(presses, ball, mean, len(refused)), *_doubts_of(scores)]
    return LightFit(
        forward=_forward_model(every, order, steepest),
        inverse=_inverse_model(inverse_sets, steepest),
        order=order,
        skirt=refined.skirt,
        scores=scores,
        left_out=tuple(refused),
        warnings=tuple(warnings),
        reference=shown,
        presses=tuple(presses),
    )


def _check_frames(reference: Image, frames: Sequence[tuple[str, Image]]) -> None:
    other = [
        f"{name} ({image.shape[1]} x {image.shape[0]})" for name, image in frames if image.shape != reference.shape
    ]
    if other:
        raise BadFrames(
            f"frames of another size than the one without contact ({reference.shape[1]} x {reference.shape[0]} px): "
            f"{', '.join(other)}; all must be of one camera and one setting"
        )
    if not frames:
        raise BadFrames("no frame of a press; give at least one, better 5 to 8, beside the one without contact")


def _check_order(reference: Image, frames: Sequence[tuple[str, Image]]) -> None:
    """The median of the frames shows the gel nearly without contact."""
    few = np.median(np.stack([image for _, image in frames[:MEDIAN_OF]]), axis=0)
    if exchanged(few.astype(np.float32), reference.astype(np.float32), np.ones(reference.shape[:2], dtype=np.bool_)):
        raise BadFrames(
            "the frames are like the picture without contact only with red and blue exchanged: give all in one order"
        )


def untouched_mean(reference: Image) -> Float64:
    """(3,) mean colour of a picture without contact. Raises BadFrames for one that is dark or saturated."""
    try:
        base = make_reference(reference.astype(np.float32), np.ones(reference.shape[:2], dtype=np.bool_))
    except UnusableReference as error:
        raise BadFrames(str(error)) from None
    return base.mean.astype(np.float64)


def find_press(name: str, image: Image, reference: Image, mean: Float64, ball: float) -> Press:
    """Contact circle of one frame, about, and its change of colour without drift.

    Args:
        image, reference: (H, W, 3) uint8 RGB with and without contact; `mean` (3,) of the reference.
        ball: radius of the ball [px].

    Raises NoCircle, BadFrames.
    """
    raw = image.astype(np.float64) - reference
    coarse = [_halved(picture) for picture in (image, reference)]
    circle = contact_circle(coarse[0], coarse[1], ball / 2)
    start = ContactCircle(2 * circle.x + 0.5, 2 * circle.y + 0.5, min(2 * circle.radius, 0.95 * STEEPEST_RIM * ball))
    height, width = reference.shape[:2]
    if not (0 <= start.x < width and 0 <= start.y < height):
        raise BadFrames("the middle of the contact lies outside the picture")
    v, u = np.mgrid[:height, :width].astype(np.float64)
    away = np.hypot(u - start.x, v - start.y)
    lit = (image < SATURATED) & (reference < SATURATED)
    drift = _drift(raw, (away > NEAR * start.radius) & lit.all(axis=2))
    contact = away < start.radius
    dull = 1.0 - float(lit[contact].all(axis=1).mean()) if contact.any() else 1.0
    if dull > MOST_SATURATED:
        raise BadFrames(f"{dull:.0%} of the contact is saturated: shorten the exposure or press less")
    change = (raw - drift) / mean
    strength = np.abs(_smooth(change, 3.0)).max(axis=2)
    inside, outside = strength[away < 1.5 * start.radius].max(), strength[away > FAR * start.radius].max(initial=0.0)
    if outside > SECOND * inside:
        raise BadFrames("there is a second contact in the picture; press one ball at a time")
    return Press(name, start, change, drift, lit)


def _drift(difference: Float64, untouched: NDArray[np.bool_]) -> Float64:
    """(H, W, 3) what has changed between reference and frame where nothing touches: a quadratic in the place, or its
    median alone where too little is untouched to tell more."""
    if untouched.mean() < LEAST_UNTOUCHED:
        level = np.median(difference[untouched], axis=0) if untouched.any() else np.zeros(3)
        return np.broadcast_to(level, difference.shape).copy()
    u, v = np.meshgrid(*place_in_image(difference.shape[1], difference.shape[0]))
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    seen = terms[untouched]
    weights = np.linalg.solve(seen.T @ seen, seen.T @ difference[untouched])
    quadratic: Float64 = terms @ weights
    return quadratic


def _refined(found: list[Press], refused: list[tuple[str, str]], ball: float) -> tuple[list[Press], Refined]:
    """Refines all circles, leaves outliers out, and refines again. Raises BadFrames when nothing is left."""
    while found:
        refined = refine([_window(press) for press in found], [press.circle for press in found], ball)
        usual = float(np.median(refined.unexplained))
        limit = min(TOO_LITTLE, max(OUTLIER * usual, SURELY)) if len(found) > 2 else TOO_LITTLE
        worst = int(np.argmax(refined.unexplained))
        if refined.unexplained[worst] <= limit:
            moved = [
                Press(p.name, circle, p.change, p.drift, p.lit)
                for p, circle in zip(found, refined.circles, strict=True)
            ]
            return moved, refined
        refused.append(
            (found[worst].name, f"a ball's dent leaves {refined.unexplained[worst]:.0%} of its change unexplained")
        )
        del found[worst]
    why = "; ".join(f"{name}: {reason}" for name, reason in refused)
    raise BadFrames(f"no frame can be used. {why}")


def _doubts(presses: Sequence[Press], ball: float, mean: Float64, refused: int) -> list[str]:
    """What a person should look at. A wrong radius of the ball scales every slope, which another light explains just as
    well; only a contact as wide as the ball gives it away."""
    doubts = []
    steep = [press.name for press in presses if press.circle.radius > 0.97 * STEEPEST_RIM * ball]
    if steep:
        doubts.append(
            f"contact as wide as the ball in {', '.join(steep)}: is the ball's radius (or the pixel pitch) right?"
        )
    drift = float(np.abs(np.median([(p.drift / mean).mean(axis=(0, 1)) for p in presses], axis=0)).max())
    if drift > STALE_COLOUR:
        doubts.append(
            f"where nothing touches, the presses differ from the picture without contact by {drift:.0%}: was it taken "
            "with the same light, just before?"
        )
    if refused > len(presses):
        doubts.append("most frames were left out: does the picture without contact really show none?")
    if len(presses) == 1:
        return [*doubts, "only one press: it says little"]
    height, width = presses[0].shape
    if max(np.ptp([p.circle.x for p in presses]) / width, np.ptp([p.circle.y for p in presses]) / height) < ONE_PLACE:
        doubts.append("all presses are in one place: nothing is known of light elsewhere on the gel; spread them")
    return doubts


def _doubts_of(scores: Sequence[PressPrediction]) -> list[str]:
    """Presses that the others do not predict."""
    angles = [score.angle for score in scores]
    odd = [s for s in scores if s.angle > max(ODD_ANGLE, ODD * float(np.median(angles)))] if len(scores) > 2 else []
    return [
        f"{s.name} is predicted badly by the others, normals off by {s.angle:.0f} degrees: another ball, a bad frame?"
        for s in odd
    ]


def _window(press: Press) -> Window:
    """Pixels round the contact, thinned out."""
    v, u, _ = _near(press)
    thin = max(1, round(np.sqrt(len(u) / PIXELS)))
    keep = (u % thin == 0) & (v % thin == 0)
    keep &= press.lit[v, u].all(axis=1)
    change = _smooth(press.change, BLUR)[v[keep], u[keep]]
    return Window(u[keep].astype(np.float64), v[keep].astype(np.float64), change)


def _near(press: Press) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Rows and columns of the pixels within NEAR contact radii, and their mask."""
    height, width = press.shape
    v, u = np.mgrid[:height, :width]
    mask = np.hypot(u - press.circle.x, v - press.circle.y) < NEAR * press.circle.radius + 5
    rows, columns = np.nonzero(mask)
    return rows, columns, mask


def _gradient(press: Press, skirt: Skirt, ball: float) -> Float64:
    """(H, W, 2) the press's labels."""
    v, u = np.mgrid[: press.shape[0], : press.shape[1]].astype(np.float64)
    return dent_gradient(u, v, press.circle, skirt, ball, RIM_BLUR)


def _forward_equations(press: Press, gradient: Float64) -> Equations:
    v, u, mask = _near(press)
    at_u, at_v = place_in_image(press.shape[1], press.shape[0])
    return equations(gradient[mask], at_u[u], at_v[v], _smooth(press.change, BLUR)[mask], press.lit[mask])


def _inverse_equations(press: Press, gradient: Float64) -> tuple[Float64, Float64]:
    """Normal equations from contact and skirt, and from a tenth as many untouched pixels, whose slope is 0."""
    height, width = press.shape
    v, u = np.mgrid[:height, :width]
    change = _smooth(press.change, INVERSE_BLUR)
    _, _, near = _near(press)
    far = np.hypot(u - press.circle.x, v - press.circle.y) > FAR * press.circle.radius
    thin = max(1, round(10 * far.sum() / max(near.sum(), 1)))
    far &= (u + 7 * v) % thin == 0
    target = np.where(far[..., None], 0.0, to_normal(gradient))
    use = near | far
    at_u, at_v = place_in_image(width, height)
    terms = inverse_features(change[use], 2 * at_u[u[use]], 2 * at_v[v[use]])
    return terms.T @ terms, terms.T @ target[use]


def _forward_model(pixels: Equations, order: Order, steepest: float) -> PhotometricModel:
    weights = tuple((float(r), float(g), float(b)) for r, g, b in solve(pixels, order))
    return PhotometricModel(degree=order.degree, position=order.position, weights=weights, steepest=steepest, blur=BLUR)


def _inverse_model(sets: Sequence[tuple[Float64, Float64]], steepest: float) -> InverseModel:
    weights = tuple((float(x), float(y)) for x, y in fit_inverse(sets, place=len(sets) > FEW))
    return InverseModel(weights=weights, steepest=steepest)


def _score(
    press: Press, gradient: Float64, model: PhotometricModel, inverse: Float64, mean: Float64, reference: Image
) -> PressPrediction:
    """A press, labelled `gradient` (H, W, 2), by a forward model and the inverse's weights that are not of it."""
    shape = press.shape
    v, u = np.mgrid[: shape[0], : shape[1]]
    away = np.hypot(u - press.circle.x, v - press.circle.y) / press.circle.radius
    light, _ = PhotometricLight(model).change(gradient.astype(np.float32), *places_in_image(shape[1], shape[0]))
    predicted = _smooth(light.astype(np.float64), BLUR) * mean
    still = np.float64(reference) + press.drift  # what this frame would show without contact
    predicted = np.clip(still + predicted, 0.0, 255.0) - still
    real = press.change * mean
    contact = away < 1.5
    at_u, at_v = place_in_image(shape[1], shape[0])
    smooth = _smooth(press.change, INVERSE_BLUR)

    def angle(where: NDArray[np.bool_]) -> float:
        rows, columns = np.nonzero(where)
        terms = inverse_features(smooth[where], 2 * at_u[columns], 2 * at_v[rows])
        return float(normal_angle(terms @ inverse, to_normal(gradient[where])).mean())

    return PressPrediction(
        press.name,
        press.circle,
        error=float(np.abs(predicted - real)[contact].mean()),
        nothing=float(np.abs(real)[contact].mean()),
        correlation=float(np.corrcoef(predicted[contact].ravel(), real[contact].ravel())[0, 1]),
        predicted=predicted.astype(np.float32),
        real=real.astype(np.float32),
        angle=angle(away < 1),
        untouched_angle=angle(away > FAR) if (away > FAR).any() else 0.0,
    )


def normal_angle(one: Float64, other: Float64) -> Float64:
    """(...,) angle [degrees] between unit normals given by their parts (..., 2) in the plane."""

    def whole(parts: Float64) -> Float64:
        square = (parts**2).sum(axis=-1, keepdims=True)
        shorter = parts * np.minimum(1.0, 0.999 / np.sqrt(np.maximum(square, 1e-12)))
        return np.concatenate([shorter, np.sqrt(1.0 - (shorter**2).sum(axis=-1, keepdims=True))], axis=-1)

    cosine = (whole(one) * whole(other)).sum(axis=-1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _smooth(image: Float64, deviation: float) -> Float64:
    import cv2

    return np.asarray(cv2.GaussianBlur(image, (0, 0), deviation), dtype=np.float64)


def _halved(image: Image) -> Image:
    import cv2

    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
