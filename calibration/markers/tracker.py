"""Tracks dots from picture to picture: matches the dots in a frame with those at rest.

A dot is predicted by constant velocity, and identified by its neighbours at rest: across an edge between two neighbours
the displacement changes by less than half of their distance. A frame with unmatched dots is matched again from other
guesses, and the match with most dots is used. Displacements are always relative to rest, so errors do not accumulate.
docs/decisions/0013-marker-tracker.md gives the purpose of each guess, and failures without it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.markers import tuning
from tacsim.interface import FloatArray, Mask

Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Displacements of the dots."""

    displacement: FloatArray  # (n, 2) against rest; the mean of its neighbours' for a dot that is not seen
    visible: Mask  # (n,)

    @property
    def visible_share(self) -> float:
        """Of the dots."""
        return float(self.visible.mean())


class DotTracker:
    """Tracks dots, in any unit of length."""

    def __init__(self, rest: FloatArray, pitch: float, in_view: Callable[[FloatArray], Mask] | None = None) -> None:
        """rest: (n, 2) the dots at rest. pitch: typical distance of neighbours. in_view: returns True where a dot at
        places (..., 2) is in view; None: everywhere. Raises ValueError for fewer than 4 dots, or one without
        neighbours."""
        weight_range = 1.0  # [pitches]
        # Extrapolation of displacement: an affine map through known dots, weighted by exp(-(distance / range)^2)
        # nearest dots that take part
        neighbour_count = 20
        from scipy.spatial import KDTree

        if len(rest) < 4:
            raise ValueError(f"{len(rest)} dots are no lattice, at least 4 are needed")
        pairs = KDTree(rest).query_pairs(tuning.NEIGHBOUR_RADIUS * pitch, output_type="ndarray")
        self._rest, self._pitch = rest, pitch
        self._in_view = in_view or (lambda places: np.ones(places.shape[:-1], dtype=np.bool_))
        self._first, self._second = pairs.T
        count = len(rest)
        self._linked = np.zeros((count, count))
        self._linked[self._first, self._second] = self._linked[self._second, self._first] = 1.0
        if not self._linked.any(axis=1).all():
            raise ValueError(f"no lattice: some dots have no neighbour within {tuning.NEIGHBOUR_RADIUS * pitch:.3g}")
        near = min(neighbour_count, count - 1)
        away, index = KDTree(rest).query(rest, k=near + 1)
        self._nearest = np.asarray(index, dtype=np.intp)[:, 1:]  # without the dot itself
        self._weight = np.exp(-((np.asarray(away)[:, 1:] / (weight_range * pitch)) ** 2))
        arm = (rest[self._nearest] - rest[:, None, :]) / pitch
        self._terms = np.concatenate([np.ones((count, near, 1)), arm], axis=2)
        self.reset()

    def reset(self) -> None:
        """Resets the motion: the next frame is expected at rest."""
        self._displacement = np.zeros_like(self._rest)
        self._velocity = np.zeros_like(self._rest)

    def __call__(self, points: FloatArray, ahead: int = 1) -> Tracked:
        """The dots among `points` (k, 2), `ahead` frames after the last ones (0: the same frame again). The velocity is
        dropped for a frame before the last one, or far ahead."""
        max_predicted_frames = 3  # a velocity says nothing of frames beyond
        predicted = 0 <= ahead <= max_predicted_frames
        expected = self._rest + self._displacement + (ahead * self._velocity if predicted else 0.0)
        partner = self._match_points(expected, points)
        coherent = self._coherent_part(partner, points, tuning.MAX_STRETCH)
        if not predicted or self._may_have_jumped(partner, points) or (coherent != (partner >= 0)).any():
            partner = self._best_match(expected, points, predicted)
        elif int((partner >= 0).sum()) < min(len(partner), len(points)):
            partner = self._extend_match(partner, points)  # dots that have turned round
        if len(points) > int((partner >= 0).sum()):
            partner = self._without_dirt(partner, points)
        partner = self._remove_local_outliers(partner, points)
        visible = partner >= 0
        displacement = np.zeros_like(self._rest)
        displacement[visible] = points[partner[visible]] - self._rest[visible]
        displacement = self._fill_hidden(displacement, visible)
        if ahead > 0 and predicted:
            self._velocity = (displacement - self._displacement) / ahead
        elif not predicted:
            self._velocity = np.zeros_like(self._rest)
        self._displacement = displacement
        return Tracked(displacement.copy(), visible)

    def _match_points(self, expected: FloatArray, points: FloatArray, radius: float = tuning.MATCH_RADIUS) -> Index:
        """(n,) the point of each dot, -1 if none is near: the minimum of the sum of squared distances (Kuhn 1955)."""
        from scipy.optimize import linear_sum_assignment

        partner = np.full(len(expected), -1, dtype=np.intp)
        if not (len(points) and len(expected)):
            return partner
        reach = (radius * self._pitch) ** 2
        away = (expected[:, :1] - points[:, 0]) ** 2 + (expected[:, 1:] - points[:, 1]) ** 2
        nearest = away.argmin(axis=1)
        close = away[np.arange(len(expected)), nearest] < reach
        if np.bincount(nearest[close], minlength=1).max() <= 1:  # each point is nearest to one dot at most
            partner[close] = nearest[close]
            return partner
        rows, columns = linear_sum_assignment(np.minimum(away, reach))
        close = away[rows, columns] < reach
        partner[rows[close]] = columns[close]
        return partner

    def _best_match(self, expected: FloatArray, points: FloatArray, predicted: bool) -> Index:
        """(n,) partners by the guess with most matched dots; of equal ones, by the smoothest."""
        found = [self._grow_match(expected, points)]
        if predicted:
            matched = self._match_points(expected, points)
            found.append(np.where(self._coherent_part(matched, points, tuning.MAX_STRETCH_TRACKED), matched, -1))
            best = max(found, key=lambda partner: self._match_score(partner, points))
            if not self._may_have_jumped(best, points):
                return best
        found.append(self._grow_match(self._rest, points))
        best = max(found, key=lambda partner: self._match_score(partner, points))
        if self._match_score(best, points)[0] < (1.0 - tuning.MIN_JUMP_SHARE) * len(
            best
        ):  # else all the rest is dirt and drop-outs
            last = self._rest + self._displacement
            found += [self._grow_match(last + jump, points) for jump in self._propose_jumps(points, last)]
            best = max(found, key=lambda partner: self._match_score(partner, points))
        return best

    def _match_score(self, partner: Index, points: FloatArray) -> tuple[int, float]:
        """Number of dots with a partner, or out of view if they moved with the others, minus the number of unmatched
        points; and the negative change of displacement across edges."""
        visible = partner >= 0
        if not visible.any():
            return -len(points), 0.0
        moved, both = self._displacements(partner, points)
        change = ((moved[self._first] - moved[self._second]) ** 2).sum(axis=1)[both]
        out = ~visible & ~self._in_view(self._rest + self._fill_hidden(moved, visible))
        spare = len(points) - int(visible.sum())
        return int((visible | out).sum()) - spare, -float(change.mean()) if len(change) else 0.0

    def _grow_match(self, guess: FloatArray, points: FloatArray) -> Index:
        """Partners of the largest coherent part of the dots that are close to their guess, and of those found by
        extrapolation from it."""
        partner = self._match_points(guess, points, tuning.STRICT_MATCH_RADIUS)
        partner = self._extend_match(
            np.where(self._coherent_part(partner, points, tuning.MAX_STRETCH), partner, -1), points
        )
        smooth = self._remove_far_points(partner, points)
        return partner if smooth is partner else self._remove_far_points(self._extend_match(smooth, points), points)

    def _extend_match(self, partner: Index, points: FloatArray) -> Index:
        """`partner`, and those found by extrapolation from the dots that have one."""
        min_known = 2  # of a dot that is looked for by extrapolation
        partner = partner.copy()
        refused = np.zeros(len(partner), dtype=np.bool_)
        for _ in range(len(partner)):
            known = partner >= 0
            requested = np.flatnonzero(~known & (self._linked @ known >= min_known) & ~refused)
            free = np.setdiff1d(np.arange(len(points)), partner[known])
            if not (len(requested) and len(free)):
                break
            moved = self._extrapolate(requested, known, points[partner] - self._rest)
            found = self._match_points(self._rest[requested] + moved, points[free], tuning.EXTRAPOLATION_RADIUS)
            partner[requested[found >= 0]] = free[found[found >= 0]]
            refused[requested[found < 0]] = True
        return partner

    def _remove_far_points(self, partner: Index, points: FloatArray) -> Index:
        """`partner` without those far from the extrapolation of the surrounding dots, the worst first."""
        checked = partner
        every = np.arange(len(partner))
        while (checked >= 0).any():
            known = checked >= 0
            moved = np.where(known[:, None], points[checked] - self._rest, 0.0)
            misfit = np.where(known, np.linalg.norm(self._extrapolate(every, known, moved) - moved, axis=1), 0.0)
            if misfit.max() <= tuning.EXTRAPOLATION_RADIUS * self._pitch:
                break
            checked = np.where(misfit > 0.9 * misfit.max(), -1, checked)
        return checked

    def _without_dirt(self, partner: Index, points: FloatArray) -> Index:
        """`partner`, with an unmatched point in place of a matched one that was a speck of dirt, if it fits the
        surrounding dots much better."""
        known = partner >= 0
        if not known.any():
            return partner
        moved = np.where(known[:, None], points[partner] - self._rest, 0.0)
        misfit = np.linalg.norm(self._extrapolate(np.arange(len(partner)), known, moved) - moved, axis=1)
        limit = max(
            tuning.MIN_DIRT_MISFIT * self._pitch, tuning.MIN_DIRT_MISFIT_RATIO * float(np.median(misfit[known]))
        )
        suspects = np.flatnonzero(known & (misfit > limit))
        if not len(suspects):
            return partner
        cleaned = partner.copy()
        cleaned[suspects] = -1
        free = np.setdiff1d(np.arange(len(points)), cleaned[cleaned >= 0])
        moved[suspects] = 0.0  # their neighbours must not be extrapolated from them
        there = self._rest[suspects] + self._extrapolate(suspects, cleaned >= 0, moved)
        found = self._match_points(there, points[free], tuning.STRICT_MATCH_RADIUS)
        other = free[found]
        away = [np.linalg.norm(points[p] - there, axis=1) for p in (other, partner[suspects])]
        better = (found >= 0) & (away[0] < tuning.MAX_DIRT_GAIN * away[1])
        cleaned[suspects] = np.where(better, other, partner[suspects])
        once = np.bincount(cleaned[cleaned >= 0], minlength=len(points)).max() <= 1
        return cleaned if once else partner

    def _remove_local_outliers(self, partner: Index, points: FloatArray) -> Index:
        """`partner` without single dots that are far from the extrapolation of the surrounding ones; at the rim of a
        contact several dots are, and they stay."""
        known = partner >= 0
        if not known.any():
            return partner
        moved = np.where(known[:, None], points[partner] - self._rest, 0.0)
        misfit = np.linalg.norm(self._extrapolate(np.arange(len(partner)), known, moved) - moved, axis=1)
        limit = max(tuning.OUTLIER_MISFIT * self._pitch, tuning.MIN_DIRT_MISFIT_RATIO * float(np.median(misfit[known])))
        around = (self._linked * np.where(known, misfit, 0.0)).max(axis=1)
        return np.where(known & (misfit > np.maximum(limit, tuning.OUTLIER_MISFIT_RATIO * around)), -1, partner)

    def _extrapolate(self, requested: Index, known: Mask, moved: FloatArray) -> FloatArray:
        """(k, 2) displacement of the dots `requested`, by an affine map through that (n, 2) of the `known` ones
        near."""
        tiny = 1e-9  # keeps the map of a dot without any neighbour solvable
        ridge = 0.02  # where few dots are known, the map is their mean
        nearest, terms = self._nearest[requested], self._terms[requested]
        weighted = (terms * (self._weight[requested] * known[nearest])[..., None]).transpose(0, 2, 1)
        square = weighted @ terms + ridge * np.diag([tiny, 1.0, 1.0])
        right = weighted @ np.where(known[:, None], moved, 0.0)[nearest]
        moved_there: FloatArray = np.linalg.solve(square, right)[:, 0]
        return moved_there

    def _displacements(self, partner: Index, points: FloatArray) -> tuple[FloatArray, Mask]:
        """(n, 2) displacement, 0 without a partner; and (edges,) whether both ends have one."""
        visible = partner >= 0
        moved = (
            np.where(visible[:, None], points[partner] - self._rest, 0.0) if len(points) else np.zeros_like(self._rest)
        )
        return moved, visible[self._first] & visible[self._second]

    def _coherent_part(self, partner: Index, points: FloatArray, stretch: float) -> Mask:
        """(n,) dots with a partner, in the largest part whose edges are not overstretched."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        visible = partner >= 0
        moved, both = self._displacements(partner, points)
        change = moved[self._first] - moved[self._second]
        sound = both & ((change**2).sum(axis=1) < (stretch * self._pitch) ** 2)
        if (sound == both).all():
            return visible
        first, second = self._first[sound], self._second[sound]
        graph = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(len(partner), len(partner)))
        _, part = connected_components(graph, directed=False)
        biggest = np.argmax(np.bincount(part, visible))
        return np.asarray((part == biggest) & visible)

    def _fill_hidden(self, displacement: FloatArray, visible: Mask) -> FloatArray:
        """`displacement` with the mean of its neighbours for each dot that is not visible (a discrete Laplace
        equation), or that of the last frame without any visible dot."""
        lost = ~visible
        if not lost.any():
            return displacement
        if not visible.any():
            return self._displacement.copy()
        laplace = np.diag(self._linked.sum(axis=1)) - self._linked
        right = self._linked[np.ix_(lost, visible)] @ displacement[visible]
        filled = displacement.copy()
        filled[lost] = np.linalg.lstsq(laplace[np.ix_(lost, lost)], right, rcond=None)[0]
        return filled

    def _may_have_jumped(self, partner: Index, points: FloatArray) -> bool:
        """True if both dots and points are unmatched, so that they may belong together."""
        lost, spare = int((partner < 0).sum()), len(points) - int((partner >= 0).sum())
        return min(lost, spare) > max(1.0, tuning.MIN_JUMP_SHARE * len(partner))

    def _propose_jumps(self, points: FloatArray, start: FloatArray) -> list[FloatArray]:
        """Shifts (2,) of the whole lattice that bring most dots near a point or out of view, the best first."""
        max_candidates = 4  # of the proposed jumps, how many are tried
        jump_seeds = 3  # dots in the middle, each of whose surrounding points proposes a jump
        from scipy.spatial import KDTree

        middle = np.argsort(((self._rest - self._rest.mean(axis=0)) ** 2).sum(axis=1))[:jump_seeds]
        shifts = (points[None, :, :] - start[middle][:, None, :]).reshape(-1, 2)
        length = np.linalg.norm(shifts, axis=1)
        shifts = shifts[(length < tuning.MAX_JUMP * self._pitch) & (length > tuning.STRICT_MATCH_RADIUS * self._pitch)]
        if not len(shifts):
            return []
        there = start[None, :, :] + shifts[:, None, :]
        away, _ = KDTree(points).query(there, distance_upper_bound=tuning.STRICT_MATCH_RADIUS * self._pitch)
        explained = (np.isfinite(away) | ~self._in_view(there)).sum(axis=1)
        chosen: list[FloatArray] = []
        for shift in shifts[np.argsort(-explained, kind="stable")]:
            if all(float(np.linalg.norm(shift - other)) > tuning.STRICT_MATCH_RADIUS * self._pitch for other in chosen):
                chosen.append(shift)
            if len(chosen) == max_candidates:
                break
        return chosen
