"""Presses of a ball under a light without direction: the darkness of a pixel depends on depth, not on slope.

Presses identify such a light: on each ring around the centre of a contact the change of colour is the same. Circles,
the gel's thickness and the two numbers of DarknessModel are then fitted together with a light proportional to depth,
with one factor above 0 and one below (variable projection, as in calibration.light.refinement; in a single press a
quadratic is not independent of the radius, so it needs several). The table is fitted last, and is monotone by
construction. One press is enough for it; other presses check it.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.errors import BadFrames
from calibration.light import tuning
from calibration.light.dent import Circle, ContactCircle, NoCircle, depth_profile
from calibration.light.press import BallPress, gaussian_blur, make_press, mean_reference_colour
from calibration.light.refinement import MAX_GROUPS
from tacsim.interface import FloatArray, Image
from tacsim.models.photometric import DarknessModel


@dataclass(frozen=True, slots=True, eq=False)
class DarknessFit:
    """The fit of such a light; lengths in pixels."""

    presses: tuple[BallPress, ...]  # with their circles refined
    thickness: float  # of the gel
    radius_uncertainty: float  # of the scale of all radii [-]; NaN for a single press with one solution
    residual_shares: tuple[float, ...]  # share of each press's darkness that no table explains
    model: DarknessModel
    left_out: tuple[DarknessModel | None, ...]  # the model by all other presses, for each; None: there are none


def rough_contact(change: FloatArray) -> ContactCircle:
    """Position of the strongest change of colour (H, W, 3). Raises NoCircle."""
    edge_ratio = 1.3  # contact radius over the radius where a press is half as dark as in its middle, about
    import cv2

    strength = np.abs(gaussian_blur(change, tuning.DARKNESS_BLUR)).mean(axis=2)
    peak = float(strength.max())
    if not peak > tuning.MIN_DARK_CONTRAST:
        raise NoCircle(f"no ball's contact is seen: colours change by {peak:.1%} at most")
    _, patches = cv2.connectedComponents((strength > peak / 2).astype(np.uint8))
    numbers = np.asarray(patches, dtype=np.intp)
    inside = numbers == numbers.ravel()[strength.argmax()]
    v, u = np.nonzero(inside)
    return ContactCircle(float(u.mean()), float(v.mean()), edge_ratio * float(np.sqrt(len(u) / np.pi)))


def is_direction_free(changes: Iterable[FloatArray]) -> bool:
    """True if most changes of colour (H, W, 3) are the same all around their contacts, in each channel: the strongest
    change may be a single flank, which is round in its own colour, but not in the others."""
    looked_at = 2.5  # up to where it is looked at [contact radii]: a flank's neighbours are there, too
    shares = []
    for raw in changes:
        change = raw - np.median(raw, axis=(0, 1))
        try:
            circle = rough_contact(change)
        except NoCircle:
            continue
        v, u = np.mgrid[: change.shape[0], : change.shape[1]]
        distance = np.hypot(u - circle.x, v - circle.y)
        near = distance < looked_at * circle.radius
        rings = (distance[near] * (12 / circle.radius)).astype(np.intp)
        count = np.maximum(np.bincount(rings), 1)
        observed = gaussian_blur(change, tuning.DARKNESS_BLUR)[near]
        means = np.stack([np.bincount(rings, channel) / count for channel in observed.T])
        shares.append(float(((count * means**2).sum(axis=1) / np.maximum((observed**2).sum(axis=0), 1e-300)).min()))
    return bool(shares) and float(np.median(shares)) > tuning.MAX_UNIFORM_SHARE


def find_dark_press(name: str, image: Image, reference: Image, mean: FloatArray, ball: float) -> BallPress:
    """The press of one frame: its approximate circle, and its change of colour without drift, as in
    calibration.light.press. Raises NoCircle, BadFrames."""
    raw = image.astype(np.float64) - reference
    circle = rough_contact((raw - np.median(raw, axis=(0, 1))) / mean)
    circle = replace(circle, radius=min(circle.radius, 0.9 * tuning.MAX_RIM_RATIO * ball))
    return make_press(name, image, reference, mean, circle, tuning.PRESS_RADIUS)


def dark_circle(image: Image, reference: Image, ball: float) -> Circle:
    """Finds the contact of a ball of radius `ball` [px] in `image` (H, W, 3), as a calibration from this press alone
    would: :func:`calibration.light.dent.find_contact_circle` for a light without direction. `reference`
    (H, W, 3) is the same without contact.

    Raises BadFrames for a reference that is dark or saturated, NoCircle if no ball's contact is visible.
    """
    mean = mean_reference_colour(reference)
    try:
        fit = fit_darkness([find_dark_press("", image, reference, mean, ball)], ball)
    except BadFrames as why:
        raise NoCircle(f"no ball's contact is seen: {why}") from None
    explained = 1.0 - fit.residual_shares[0]
    if explained < 1.0 - tuning.MAX_DARKNESS_RESIDUAL:
        raise NoCircle(
            f"no ball's contact is seen: the depth of a dent explains {max(explained, 0.0):.0%} of how dark it gets, "
            f"{1 - tuning.MAX_DARKNESS_RESIDUAL:.0%} are needed"
        )
    found = fit.presses[0].circle
    return Circle(found.x, found.y, found.radius, explained)


def fit_darkness(presses: Sequence[BallPress], ball: float) -> DarknessFit:
    """Circles, thickness and model of presses; `ball`: its radius [px]. Raises BadFrames if darkness does not
    increase with depth."""
    problem = _Problem(presses, ball)
    ends = sorted(
        (problem.refined(problem.start(thinness)) for thinness in tuning.FIRST_THINNESS), key=lambda end: end[1]
    )
    best, cost = ends[0]
    rivals = [_log_ratio(end, best) for end, other in ends[1:] if other < tuning.MAX_ALTERNATIVE_COST * cost]
    depths = [problem.local_depth(i, best) for i in range(len(presses))]
    observed = [problem.windows[i].change for i in range(len(presses))]
    whole = _fit_table(depths, observed)
    models = [whole] + [
        _fit_table(_leave_one_out(depths, i), _leave_one_out(observed, i))
        for i in range(len(presses))
        if len(presses) > 1
    ]
    finished = [_make_model(table, float(best[-2]), float(best[-1]) * ball) for table in models]
    circles = [ContactCircle(*map(float, best[3 * i : 3 * i + 3])) for i in range(len(presses))]
    return DarknessFit(
        presses=tuple(replace(press, circle=circle) for press, circle in zip(presses, circles, strict=True)),
        thickness=ball / float(best[-3]),
        radius_uncertainty=float(max([*problem.jackknife(best), *rivals], default=np.nan)),
        residual_shares=tuple(_residual_share(*pair, whole) for pair in zip(depths, observed, strict=True)),
        model=finished[0],
        left_out=tuple(finished[1:]) or (None,),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """The n used pixels of one press."""

    u: FloatArray
    v: FloatArray
    change: FloatArray  # (n, 3) relative


class _Problem:
    """Least squares for (x, y, radius) of each press [px], then the gel's thinness (ball radius over thickness), the
    share and the reach [ball radii]."""

    def __init__(self, presses: Sequence[BallPress], ball: float) -> None:
        self.presses, self._ball = presses, ball
        self.windows = [_press_window(press) for press in presses]
        self._features = functools.lru_cache(maxsize=8 * len(presses) + 8)(self._new_features)

    def start(self, thinness: float) -> FloatArray:
        first_guess = (0.3, 0.4)  # share, reach [ball radii] that the search starts from
        circles = [number for p in self.presses for number in (p.circle.x, p.circle.y, p.circle.radius)]
        return np.array([*circles, thinness, *first_guess])

    def refined(self, start: FloatArray) -> tuple[FloatArray, float]:
        """The minimum near `start`, and its cost."""
        bounds = ((0.0, 0.05), (0.8, 1.5))  # of share, reach
        from scipy.optimize import least_squares

        low, high = [], []
        for press in self.presses:
            side = 0.3 * press.circle.radius
            low += [press.circle.x - side, press.circle.y - side, 0.05 * self._ball]
            high += [press.circle.x + side, press.circle.y + side, tuning.MAX_RIM_RATIO * self._ball]
        low, high = [*low, tuning.THINNESS_BOUNDS[0], *bounds[0]], [*high, tuning.THINNESS_BOUNDS[1], *bounds[1]]
        start = np.clip(start, np.array(low) + 1e-6, np.array(high) - 1e-6)
        scale = np.array([1.0, 1.0, 1.0] * len(self.presses) + [0.3, 0.1, 0.1])
        found = least_squares(
            self._residual,
            start,
            bounds=(low, high),
            x_scale=scale,
            diff_step=[1e-4] * len(start),
            max_nfev=40,
            ftol=1e-4,
            tr_solver="lsmr",  # no decomposition of all pixels by all numbers
        )
        return np.asarray(found.x, dtype=np.float64), float(found.cost)

    def jackknife(self, best: FloatArray) -> list[float]:
        """Standard deviation of the scale of all radii by leaving out groups of presses; none for a single press."""
        count = len(self.presses)
        if count < 2:
            return []
        groups, scales = min(count, MAX_GROUPS), []
        for group in range(groups):
            kept = [i for i in range(count) if i % groups != group]
            part = _Problem([self.presses[i] for i in kept], self._ball)
            begin = np.concatenate([*(best[3 * i : 3 * i + 3] for i in kept), best[-3:]])
            scales.append(_log_ratio(part.refined(begin)[0], begin, signed=True))
        return [float(np.sqrt((groups - 1) / groups * np.sum((np.array(scales) - np.mean(scales)) ** 2)))]

    def local_depth(self, i: int, at: FloatArray) -> FloatArray:
        """(n,) depth beyond the share of that round it, in the window of press `i` [px]."""
        x, y, radius = map(float, at[3 * i : 3 * i + 3])
        thinness, share, reach = map(float, at[-3:])
        profile = _dent_profile(radius / self._ball, thinness)
        own = profile - share * (_local_mean_matrix(reach) @ profile)
        window = self.windows[i]
        distance = np.hypot(window.u - x, window.v - y)
        return np.asarray(np.interp(distance, _profile_radii() * self._ball, own) * self._ball, dtype=np.float64)

    def _new_features(self, i: int, at: tuple[float, ...]) -> FloatArray:
        deep = self.local_depth(i, np.array([*([0.0] * 3 * i), *at])) / self._ball
        above, below = np.maximum(deep, 0.0), np.minimum(deep, 0.0)
        return np.stack([above, below, above**2][: 3 if len(self.presses) > tuning.MAX_FEW_PRESSES else 2], axis=-1)

    def _residual(self, at: FloatArray) -> FloatArray:
        shared = tuple(map(float, at[-3:]))
        terms = [self._features(i, (*map(float, at[3 * i : 3 * i + 3]), *shared)) for i in range(len(self.presses))]
        rows, observed = np.concatenate(terms), np.concatenate([w.change.mean(axis=1) for w in self.windows])
        square = rows.T @ rows
        weights = np.linalg.solve(square + 1e-9 * np.trace(square) * np.eye(len(square)), rows.T @ observed)
        return np.asarray(rows @ weights - observed, dtype=np.float64)


def _log_ratio(one: FloatArray, other: FloatArray, *, signed: bool = False) -> float:
    """Mean logarithm of the ratio of radii."""
    ratio = float(np.mean(np.log(one[2:-3:3] / other[2:-3:3])))
    return ratio if signed else abs(ratio)


def _press_window(press: BallPress) -> _Window:
    pixels_of_press = 1200  # of each press, about
    v, u = np.nonzero((press.distance() < tuning.PRESS_RADIUS * press.circle.radius) & press.lit.all(axis=2))
    thin = max(1, round(np.sqrt(len(u) / pixels_of_press)))
    keep = (u % thin == 0) & (v % thin == 0)
    u, v = u[keep], v[keep]
    return _Window(u.astype(np.float64), v.astype(np.float64), gaussian_blur(press.change, tuning.DARKNESS_BLUR)[v, u])


@functools.cache
def _profile_radii() -> FloatArray:
    radius_step = 1 / 30  # of radii [ball radii]
    return np.arange(0.0, tuning.MAX_RADIUS_RATIO, radius_step)


@functools.lru_cache(maxsize=64)
def _dent_profile(contact: float, thinness: float) -> FloatArray:
    """Depth of a dent at :func:`_profile_radii`; all in ball radii."""
    return depth_profile(_profile_radii(), contact, 1.0, 1 / thinness)


@functools.lru_cache(maxsize=8)
def _local_mean_matrix(reach: float) -> FloatArray:
    """(n, n) from a profile at :func:`_profile_radii` to that of its Gaussian mean over the plane."""
    from scipy.special import ive

    r, s = _profile_radii()[:, None], _profile_radii()[None, :]
    weights = s * np.exp(-(((r - s) / reach) ** 2) / 2) * ive(0, r * s / reach**2)
    return np.asarray(weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300), dtype=np.float64)


def _leave_one_out(parts: Sequence[FloatArray], i: int) -> list[FloatArray]:
    return [part for k, part in enumerate(parts) if k != i]


def _fit_table(depths: Sequence[FloatArray], observed: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Knots (k,) and changes (k, 3) that fall from each to the next and are 0 at depth 0: the least squares of changes
    `observed` (n, 3) at `depths` (n,) by non-negative steps. Raises BadFrames if no change falls."""
    min_slope = 0.01  # least slope of the table, over its mean
    knot_count = 24  # of the table
    from scipy.optimize import nnls

    deep, change = np.concatenate(depths), np.concatenate(observed)
    lowest, highest = min(float(deep.min()), -1e-3 * float(deep.max())), float(deep.max())
    below = max(2, round(knot_count * -lowest / (highest - lowest)))
    knots = np.concatenate([np.linspace(lowest, 0.0, below + 1), np.linspace(0.0, highest, knot_count + 1)[1:]])
    low, high = knots[:-1], knots[1:]
    ramps = np.clip((deep[:, None] - low) / (high - low), 0.0, 1.0) - (low < 0)  # 0 at depth 0
    square, right = ramps.T @ ramps, ramps.T @ change
    lower = np.linalg.cholesky(square + 1e-9 * np.trace(square) * np.eye(len(square)))
    steps = np.stack([nnls(lower.T, -np.linalg.solve(lower, channel))[0] for channel in right.T], axis=-1)
    total = steps.sum(axis=0)
    if not (total > 0).all():
        raise BadFrames("how dark it is does not grow with the depth")
    steps = np.maximum(steps, min_slope * total * ((high - low) / (highest - lowest))[:, None])
    changes = -np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return knots, changes - changes[below]


def _make_model(table: tuple[FloatArray, FloatArray], share: float, reach: float) -> DarknessModel:
    knots, changes = table
    rows = tuple((float(r), float(g), float(b)) for r, g, b in changes)
    return DarknessModel(depths=tuple(map(float, knots)), changes=rows, share=share, reach=reach)


def _residual_share(depth: FloatArray, observed: FloatArray, table: tuple[FloatArray, FloatArray]) -> float:
    knots, changes = table
    predicted = np.stack([np.interp(depth, knots, channel) for channel in changes.T], axis=-1)
    return float(((predicted - observed) ** 2).sum() / max(float((observed**2).sum()), 1e-300))
