"""Dots from picture to picture: which of the dots found now is which of those at rest.

Where each dot should be is told by its motion so far (constant velocity); who it is, by its neighbours at rest: across
an edge between two neighbours the displacement changes by less than half of their distance. A frame that leaves dots
without a partner is matched anew from other guesses (no motion, no displacement at all, a jump of the whole lattice),
each grown outwards from its largest coherent part, and the guess that explains most dots wins. Displacements are always
against rest, so errors don't add up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

GATE = 0.45  # a dot is at most so far from where it should be [pitches]
NEIGHBOUR = 1.6  # dots at most so far apart at rest are neighbours: the diagonal of a square is one [pitches]
STRETCH = 0.4  # change of displacement across an edge that nobody doubts, at most [pitches]
TORN = 0.75  # ... and that is believed of dots that came there step by step
SURE = 0.25  # a dot that others may start from is at most so far from where it should be [pitches]
LED = 0.45  # a dot is at most so far from where its neighbours lead [pitches]
LEADERS = 20  # neighbours that lead
REACH = 1.0  # distance over which neighbours lead: the weight of those that far away is 1/e [pitches]
STIFF = 0.02  # of the affine map that they lead by: where few are known, it is their mean
FAR_AHEAD = 3  # frames over which a velocity still says something
JUMP = 2.6  # jumps of the whole lattice that are looked for [pitches]
JUMPS = 4  # of these, how many are tried
WITNESSES = 3  # dots whose surroundings propose such jumps
MISSING = 0.04  # share of dots, and of points, without a partner from which on a jump is suspected
DIRT = 0.1  # a dot so far from where those around lead may be a speck of dirt [pitches]
ODD = 4.0  # ... if it is so many times as far as usual
BETTER = 0.25  # another point is the dot if it is so much nearer to where they lead
SUPPORT = 2  # neighbours that must be known where a dot is looked for

TINY = 1e-9  # keeps the map of a dot without any neighbour solvable


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Where the dots are now."""

    displacement: Float64  # (n, 2) against rest; that of a dot that is not seen is the mean of its neighbours'
    seen: Mask  # (n,)

    @property
    def kept(self) -> float:
        """Share of the dots that are seen."""
        return float(self.seen.mean())


class DotTracker:
    """Follows dots, in any unit of length."""

    def __init__(self, rest: Float64, pitch: float, in_view: Callable[[Float64], Mask] | None = None) -> None:
        """`rest`: (n, 2) where the dots are at rest; `pitch`: usual distance of neighbours; `in_view`: at which places
        (..., 2) a dot would be seen (None: everywhere). Raises ValueError for fewer than 4 dots, or dots that are no
        neighbours of any other."""
        from scipy.spatial import KDTree

        if len(rest) < 4:
            raise ValueError(f"{len(rest)} dots are no lattice, at least 4 are needed")
        pairs = KDTree(rest).query_pairs(NEIGHBOUR * pitch, output_type="ndarray")
        self._rest, self._pitch = rest, pitch
        self._in_view = in_view or (lambda places: np.ones(places.shape[:-1], dtype=np.bool_))
        self._first, self._second = pairs.T
        count = len(rest)
        self._linked = np.zeros((count, count))
        self._linked[self._first, self._second] = self._linked[self._second, self._first] = 1.0
        if not self._linked.any(axis=1).all():
            raise ValueError(f"some dots have no neighbour within {NEIGHBOUR:g} pitches of {pitch:.3g}: no lattice")
        near = min(LEADERS, count - 1)
        away, index = KDTree(rest).query(rest, k=near + 1)
        self._leaders = np.asarray(index, dtype=np.intp)[:, 1:]  # nobody leads itself
        self._weight = np.exp(-((np.asarray(away)[:, 1:] / (REACH * pitch)) ** 2))
        arm = (rest[self._leaders] - rest[:, None, :]) / pitch
        self._terms = np.concatenate([np.ones((count, near, 1)), arm], axis=2)
        self.reset()

    def reset(self) -> None:
        """Back to rest: what was seen so far says nothing of the next frame."""
        self._displacement = np.zeros_like(self._rest)
        self._velocity = np.zeros_like(self._rest)

    def __call__(self, points: Float64, ahead: int = 1) -> Tracked:
        """The dots among `points` (k, 2), `ahead` frames after the last ones (0: the same once more); backwards or far
        ahead the past says nothing of the velocity."""
        trusted = 0 <= ahead <= FAR_AHEAD
        expected = self._rest + self._displacement + (ahead * self._velocity if trusted else 0.0)
        partner = self._match(expected, points)
        coherent = self._largest(partner, points, STRETCH)
        if not trusted or self._jumped(partner, points) or (coherent != (partner >= 0)).any():
            partner = self._best(expected, points, trusted)
        elif int((partner >= 0).sum()) < min(len(partner), len(points)):
            partner = self._extended(partner, points)  # a dot that has turned round is where its neighbours lead
        if len(points) > int((partner >= 0).sum()):
            partner = self._told_from_dirt(partner, points)
        seen = partner >= 0
        displacement = np.zeros_like(self._rest)
        displacement[seen] = points[partner[seen]] - self._rest[seen]
        displacement = self._filled(displacement, seen)
        if ahead > 0 and trusted:
            self._velocity = (displacement - self._displacement) / ahead
        elif not trusted:
            self._velocity = np.zeros_like(self._rest)
        self._displacement = displacement
        return Tracked(displacement.copy(), seen)

    def _match(self, expected: Float64, points: Float64, gate: float = GATE) -> Index:
        """(n,) the point of each dot, -1 where none is near: as close as can be, all together (Kuhn 1955)."""
        from scipy.optimize import linear_sum_assignment

        partner = np.full(len(expected), -1, dtype=np.intp)
        if not (len(points) and len(expected)):
            return partner
        reach = (gate * self._pitch) ** 2
        away = (expected[:, :1] - points[:, 0]) ** 2 + (expected[:, 1:] - points[:, 1]) ** 2
        nearest = away.argmin(axis=1)
        close = away[np.arange(len(expected)), nearest] < reach
        if np.bincount(nearest[close], minlength=1).max() <= 1:  # nobody wants the same: this is the best there is
            partner[close] = nearest[close]
            return partner
        rows, columns = linear_sum_assignment(np.minimum(away, reach))
        close = away[rows, columns] < reach
        partner[rows[close]] = columns[close]
        return partner

    def _best(self, expected: Float64, points: Float64, trusted: bool) -> Index:
        """(n,) partners by the guess that explains most dots; of equal ones, by the smoothest."""
        found = [self._grown(expected, points)]
        if trusted:
            matched = self._match(expected, points)
            found.append(np.where(self._largest(matched, points, TORN), matched, -1))
            best = max(found, key=lambda partner: self._score(partner, points))
            if not self._jumped(best, points):
                return best
        last = self._rest + self._displacement
        found += [self._grown(last, points), self._grown(self._rest, points)]
        best = max(found, key=lambda partner: self._score(partner, points))
        if self._score(best, points)[0] < (1.0 - MISSING) * len(best):  # or is it all dirt and drop-outs?
            found += [self._grown(last + shift, points) for shift in self._jumps(points, last)]
            best = max(found, key=lambda partner: self._score(partner, points))
        return best

    def _score(self, partner: Index, points: Float64) -> tuple[int, float]:
        """How many dots have a partner, or would be out of view with the others' motion, less the points that nobody
        claims; and how little displacement changes across edges."""
        seen = partner >= 0
        if not seen.any():
            return -len(points), 0.0
        moved, both = self._moved(partner, points)
        change = ((moved[self._first] - moved[self._second]) ** 2).sum(axis=1)[both]
        out = ~seen & ~self._in_view(self._rest + self._filled(moved, seen))
        spare = len(points) - int(seen.sum())
        return int((seen | out).sum()) - spare, -float(change.mean()) if len(change) else 0.0

    def _grown(self, guess: Float64, points: Float64) -> Index:
        """Partners of the largest coherent part of what is surely where it is guessed, and of all that those around
        then lead to, as an affine map of displacement through them (weighted by distance) continues it."""
        partner = self._match(guess, points, SURE)
        partner = self._extended(np.where(self._largest(partner, points, STRETCH), partner, -1), points)
        smooth = self._smooth(partner, points)
        return partner if smooth is partner else self._smooth(self._extended(smooth, points), points)

    def _extended(self, partner: Index, points: Float64) -> Index:
        """`partner`, and those found where the dots that have one lead to."""
        partner = partner.copy()
        refused = np.zeros(len(partner), dtype=np.bool_)
        for _ in range(len(partner)):
            known = partner >= 0
            asked = np.flatnonzero(~known & (self._linked @ known >= SUPPORT) & ~refused)
            free = np.setdiff1d(np.arange(len(points)), partner[known])
            if not (len(asked) and len(free)):
                break
            led = self._continued(asked, known, points[partner] - self._rest)
            found = self._match(self._rest[asked] + led, points[free], LED)
            partner[asked[found >= 0]] = free[found[found >= 0]]
            refused[asked[found < 0]] = True
        return partner

    def _smooth(self, partner: Index, points: Float64) -> Index:
        """`partner` without those that the dots around contradict, the worst first."""
        checked = partner
        every = np.arange(len(partner))
        while (checked >= 0).any():
            known = checked >= 0
            moved = np.where(known[:, None], points[checked] - self._rest, 0.0)
            odd = np.where(known, np.linalg.norm(self._continued(every, known, moved) - moved, axis=1), 0.0)
            if odd.max() <= LED * self._pitch:
                break
            checked = np.where(odd > 0.9 * odd.max(), -1, checked)
        return checked

    def _told_from_dirt(self, partner: Index, points: Float64) -> Index:
        """`partner`, but where a point that nobody claims fits far better to the dots around than the claimed one, it
        is the dot, and the claimed one a speck of dirt."""
        known = partner >= 0
        if not known.any():
            return partner
        moved = np.where(known[:, None], points[partner] - self._rest, 0.0)
        odd = np.linalg.norm(self._continued(np.arange(len(partner)), known, moved) - moved, axis=1)
        doubted = np.flatnonzero(known & (odd > max(DIRT * self._pitch, ODD * float(np.median(odd[known])))))
        if not len(doubted):
            return partner
        told = partner.copy()
        told[doubted] = -1
        free = np.setdiff1d(np.arange(len(points)), told[told >= 0])
        moved[doubted] = 0.0  # a speck misleads its neighbours, too
        led = self._continued(doubted, told >= 0, moved)
        found = self._match(self._rest[doubted] + led, points[free], SURE)
        other = free[found]
        away = [np.linalg.norm(points[p] - self._rest[doubted] - led, axis=1) for p in (other, partner[doubted])]
        better = (found >= 0) & (away[0] < BETTER * away[1])
        told[doubted] = np.where(better, other, partner[doubted])
        once = np.bincount(told[told >= 0], minlength=len(points)).max() <= 1
        return told if once else partner

    def _continued(self, asked: Index, known: Mask, moved: Float64) -> Float64:
        """(k, 2) displacement of the dots `asked`, from that (n, 2) of the dots `known`."""
        leaders, terms = self._leaders[asked], self._terms[asked]
        weighted = (terms * (self._weight[asked] * known[leaders])[..., None]).transpose(0, 2, 1)
        square = weighted @ terms + STIFF * np.diag([TINY, 1.0, 1.0])
        right = weighted @ np.where(known[:, None], moved, 0.0)[leaders]
        led: Float64 = np.linalg.solve(square, right)[:, 0]
        return led

    def _moved(self, partner: Index, points: Float64) -> tuple[Float64, Mask]:
        """(n, 2) displacement, 0 without a partner, and (edges,) both ends have one."""
        seen = partner >= 0
        moved = np.where(seen[:, None], points[partner] - self._rest, 0.0) if len(points) else np.zeros_like(self._rest)
        return moved, seen[self._first] & seen[self._second]

    def _largest(self, partner: Index, points: Float64, stretch: float) -> Mask:
        """(n,) dots with a partner, in the largest part whose edges are not overstretched."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        seen = partner >= 0
        moved, both = self._moved(partner, points)
        change = moved[self._first] - moved[self._second]
        sound = both & ((change**2).sum(axis=1) < (stretch * self._pitch) ** 2)
        if (sound == both).all():
            return seen
        first, second = self._first[sound], self._second[sound]
        graph = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(len(partner), len(partner)))
        _, part = connected_components(graph, directed=False)
        largest = np.argmax(np.bincount(part, seen))
        return np.asarray((part == largest) & seen)

    def _filled(self, displacement: Float64, seen: Mask) -> Float64:
        """`displacement`, with the mean of its neighbours' at each dot that is not seen (a discrete Laplace equation);
        unchanged since the last frame where nothing at all is seen."""
        lost = ~seen
        if not lost.any():
            return displacement
        if not seen.any():
            return self._displacement.copy()
        laplace = np.diag(self._linked.sum(axis=1)) - self._linked
        right = self._linked[np.ix_(lost, seen)] @ displacement[seen]
        filled = displacement.copy()
        filled[lost] = np.linalg.lstsq(laplace[np.ix_(lost, lost)], right, rcond=None)[0]
        return filled

    def _jumped(self, partner: Index, points: Float64) -> bool:
        """Both dots and points without a partner: as if they belonged together."""
        lost, spare = int((partner < 0).sum()), len(points) - int((partner >= 0).sum())
        return min(lost, spare) > max(1.0, MISSING * len(partner))

    def _jumps(self, points: Float64, start: Float64) -> list[Float64]:
        """Shifts (2,) of the whole lattice that bring most dots near a point or out of view, the best first."""
        from scipy.spatial import KDTree

        middle = np.argsort(((self._rest - self._rest.mean(axis=0)) ** 2).sum(axis=1))[:WITNESSES]
        shifts = (points[None, :, :] - start[middle][:, None, :]).reshape(-1, 2)
        length = np.linalg.norm(shifts, axis=1)
        shifts = shifts[(length < JUMP * self._pitch) & (length > SURE * self._pitch)]
        if not len(shifts):
            return []
        there = start[None, :, :] + shifts[:, None, :]
        away, _ = KDTree(points).query(there, distance_upper_bound=SURE * self._pitch)
        explained = (np.isfinite(away) | ~self._in_view(there)).sum(axis=1)
        chosen: list[Float64] = []
        for shift in shifts[np.argsort(-explained, kind="stable")]:
            if all(float(np.linalg.norm(shift - other)) > SURE * self._pitch for other in chosen):
                chosen.append(shift)
            if len(chosen) == JUMPS:
                break
        return chosen
