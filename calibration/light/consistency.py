"""Checks that pictures belong together: presses that others do not predict, blurred presses, and a contact in the
picture without contact."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.light import tuning
from calibration.light.dent import NoCircle, dent_gradient, find_contact_circle
from calibration.light.photometry import photometric_features
from calibration.light.press import BallPress, Window, gaussian_blur
from tacsim.interface import FloatArray, Image, Mask

# Two presses are of one sensor if the light of each explains the other up to the larger of these shares of its power
MAX_LINK = 0.2
# Strength of a contact in a picture without contact, over that of the presses
MIN_REFERENCE_CONTACT = 0.2  # where two such pictures differ


def find_inconsistent_presses(presses: Sequence[BallPress], windows: Sequence[Window], ball: float) -> list[int]:
    """The presses that those of the largest group do not predict: each press alone gives a light, and two presses
    belong together if the lights of both explain both. ball: its radius [px]."""
    min_grouped = 4  # presses: fewer do not show which one is wrong
    ridge = 1e-3
    thick = 1e4  # of a gel that is taken to be thick [ball radii]
    if len(presses) < min_grouped:
        return []
    sets = []
    for press, window in zip(presses, windows, strict=True):
        gradient = dent_gradient(window.u, window.v, press.circle, thick * ball, ball, tuning.RIM_BLUR)
        terms = photometric_features(gradient, window.u, window.v, 3, 0)
        sets.append((terms.T @ terms, terms.T @ window.change, float((window.change**2).sum())))
    unexplained = np.zeros((len(sets), len(sets)))
    for i, (square, right, _) in enumerate(sets):
        regular = square + ridge * np.trace(square) / len(square) * np.eye(len(square))
        light = np.linalg.solve(regular, right)
        for j, (other, wanted, power) in enumerate(sets):
            unexplained[i, j] = 1 - (2 * (light * wanted).sum() - (light * (other @ light)).sum()) / max(power, 1e-300)
    link_costs = (unexplained + unexplained.T) / 2
    return _outside_largest_group(link_costs)


def _outside_largest_group(link_costs: FloatArray) -> list[int]:
    """Groups by single linkage: links of the minimum spanning tree that are too long are cut."""
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    tree = minimum_spanning_tree(np.maximum(link_costs, 1e-9)).toarray()
    limit = max(MAX_LINK, tuning.MAX_LINK_RATIO * float(np.median(tree[tree > 0])))
    count, group = connected_components(np.where(tree <= limit, tree, 0.0), directed=False)
    if count == 1:
        return []
    largest = int(np.argmax(np.bincount(group)))
    return [int(k) for k in np.flatnonzero(group != largest)]


def fine_power(picture: FloatArray, where: Mask) -> float:
    """Power of fine detail and noise of a picture (H, W, 3) [grey levels] at the pixels `where` (H, W)."""
    fine_width = 1.0  # detail finer than this Gaussian is compared [px]
    return float(((picture - gaussian_blur(picture, fine_width))[where] ** 2).mean())


def find_blurred_presses(presses: Sequence[BallPress], reference: Image, mean: FloatArray) -> list[tuple[int, float]]:
    """Presses whose pictures have less fine detail outside the contact than the others, and, if these are most of them,
    than the picture without contact (H, W, 3); and the share of its power that is left."""
    shares = []
    still = reference.astype(np.float64)
    for press in presses:
        beside = np.asarray(
            (press.distance() > tuning.SKIRT_RADIUS * press.circle.radius) & press.lit.all(axis=2), dtype=np.bool_
        )
        if not beside.any():
            beside = np.asarray(press.lit.all(axis=2), dtype=np.bool_)
        if not beside.any():
            shares.append(1.0)
            continue
        own = fine_power(still + press.change * mean, beside)
        shares.append(own / max(fine_power(still, beside), 1e-12))
    usual = max(float(np.median(shares)), 1.0) if shares else 1.0  # most of them may be blurred
    if max(shares, default=0.0) < tuning.MIN_FINE_POWER_RATIO:
        usual = 1.0
    return [(k, share / usual) for k, share in enumerate(shares) if share < tuning.MIN_FINE_POWER_RATIO * usual]


def find_reference_contact(
    presses: Sequence[BallPress], reference: Image, mean: FloatArray, others: Sequence[Image], ball: float
) -> str | None:
    """Evidence of a contact in a picture without contact: the common difference of all presses from `reference`
    (H, W, 3) outside their contacts, or the difference of two such pictures, resembles a ball's dent. None without
    evidence."""
    strength = float(np.median([np.abs(gaussian_blur(press.change, tuning.CONTACT_BLUR)).max() for press in presses]))
    for number, other in enumerate(others, start=2):
        where = _describe_dent(
            other.astype(np.float64) - reference, mean, reference, ball, MIN_REFERENCE_CONTACT * strength
        )
        if where is not None:
            return (
                f"pictures 1 and {number} without contact differ by a ball's contact at {where}: take pictures of the "
                "free gel again"
            )
    changes = np.stack(
        [
            np.where(
                (press.distance() > tuning.SKIRT_RADIUS * press.circle.radius)[..., None], press.change, np.nan
            ).astype(np.float32)
            for press in presses
        ]
    )
    seen = np.isfinite(changes[..., 0]).sum(axis=0) >= min(3, len(presses))
    changes[:, ~seen] = 0.0
    usual = np.nanmedian(changes, axis=0).astype(np.float64)
    where = _describe_dent(usual * mean, mean, reference, ball, tuning.MIN_COMMON_CONTACT * strength)
    if where is None:
        return None
    return (
        f"the picture without contact shows a ball's contact at {where}, which no press shows: take it again, of the "
        "free gel"
    )


def _describe_dent(change: FloatArray, mean: FloatArray, reference: Image, ball: float, strength: float) -> str | None:
    """Description of the place where a change (H, W, 3) [grey levels] exceeds `strength` [-] and a ball's dent explains
    it."""
    change = change - np.median(change, axis=(0, 1))
    if not np.abs(gaussian_blur(change / mean, tuning.CONTACT_BLUR)).max() > strength:
        return None
    level = np.full_like(reference, 128)
    try:
        circle = find_contact_circle(np.clip(np.rint(128 + change), 0, 255).astype(np.uint8), level, ball)
    except NoCircle:
        return None
    height, width = reference.shape[:2]
    inside = min(circle.x, circle.y, width - 1 - circle.x, height - 1 - circle.y) >= circle.radius
    if circle.explained_share < tuning.MIN_EXPLAINED_REFERENCE or not inside:
        return None
    return f"({circle.x:.0f}, {circle.y:.0f}) px"
