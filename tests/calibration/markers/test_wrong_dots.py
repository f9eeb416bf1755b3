"""Dots that are missing in rows, or double: truth is where they were drawn."""

import numpy as np
import pytest

from calibration.markers.dots import NoLattice, find_lattice
from calibration.markers.flow import MarkerFlow, NoMarkers, find_markers, marker_flow
from calibration.markers.tracker import DotTracker
from tacsim.models.sensor import Markers, SensorGeometry
from tests.calibration.dotted import draw, lattice_points

PITCH, MM = 20.0, 0.075e-3  # [px], [m/px]
MIDDLE = np.array([159.5, 119.5])


@pytest.mark.parametrize(("axis", "at"), [(0, 7), (0, 3), (1, 5), (1, 2)])
def test_a_missing_row_or_column_is_named(axis: int, at: int) -> None:
    points = lattice_points(11, 12, PITCH)
    part = np.delete(points, at, axis=axis).reshape(-1, 2)
    lattice = find_lattice(part, pitch=PITCH)
    assert lattice.present.shape == (11, 12)
    assert not np.take(lattice.present, at, axis=axis).any() and lattice.present.sum() == len(part)
    with pytest.raises(NoLattice, match=f"{('row', 'column')[axis]} {at + 1} of {(11, 12)[axis]} shows no dot"):
        find_markers(draw(part + MIDDLE, 4.0, (240, 320)))


@pytest.mark.parametrize("axis", [0, 1])
def test_a_missing_row_of_a_known_lattice_is_refused(axis: int) -> None:
    points = lattice_points(9, 11, PITCH)
    geometry = SensorGeometry(width=320, height=240, pixel_pitch=MM)
    flow = marker_flow(Markers(rows=9, columns=11, pitch=PITCH * MM, radius=4 * MM), geometry, (24e-3, 18e-3))
    assert isinstance(flow, MarkerFlow)
    flow.take_reference(draw(points + MIDDLE, 4.0))
    with pytest.raises(NoMarkers, match="shows no dot"):
        flow.take_reference(draw(np.delete(points, 4, axis=axis) + MIDDLE, 4.0))


@pytest.mark.parametrize("aside", [(0.33, 0.0), (0.0, -0.3), (0.2, 0.2)])
def test_a_dot_that_jumps_alone_counts_as_not_seen(aside: tuple[float, float]) -> None:
    """A double dot has its centre between the two: a third of a pitch, that none of its neighbours moves."""
    rest = lattice_points(9, 11, 1.5).reshape(-1, 2)
    moved = np.exp(-(rest**2).sum(axis=1) / 16)[:, None] * np.array([0.8, 0.2])
    tracker, double = DotTracker(rest, 1.5), 47
    tracker(rest + 0.5 * moved)
    points = rest + moved
    points[double] += 1.5 * np.array(aside)
    found = tracker(points)
    assert not found.visible[double] and found.visible.sum() == len(rest) - 1
    assert np.linalg.norm(found.displacement - moved, axis=1).max() < 0.1
