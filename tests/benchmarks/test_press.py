"""Press group: our own presses against the truths that they are measured with."""

from __future__ import annotations

import pytest

from benchmarks.cases import press


def test_a_balls_dent_is_that_of_fine_meshes() -> None:
    """2.1 um rms of 1 mm; by the largest, an edge of contact is in the wrong cell."""
    (row,) = press.sphere_press(0.5e-3, 1)
    assert row.note == ""
    assert row.error < 2.4  # um rms
    assert row.error < row.figures["largest_um"] < 25
    assert row.figures["overlap_um"] < 10  # what the gel gives way between its nodes, as a half-space does


@pytest.mark.deep
def test_a_press_ends_where_a_slow_one_does() -> None:
    settled, *speeds = press.quasi_static(1)
    assert settled.error < 1.2 and settled.figures["force_percent"] < 0.5
    by_mach = dict(zip(press.OTHER_MACHS, speeds, strict=True))
    for mach, most in ((0.015, 3.0), (0.05, 5.0), (0.1, 30.0)):  # um at most
        row = by_mach[mach]
        assert 0 < row.figures["rms_um"] < row.error < most
        assert row.substeps is not None and settled.substeps is not None
        assert (row.substeps > settled.substeps) == (mach < press.DEFAULT_MACH)


@pytest.mark.deep
def test_a_shallow_balls_force_goes_to_that_of_an_elastic_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within a percent of the layer's at 0.5 mm (0.85, 0.68 at 0.25), within 4 at 1 mm."""
    monkeypatch.setattr(press, "FORCE_DEPTHS", (0.3e-3,))
    fine, incompressible = press.sphere_force(0.5e-3, 1)
    assert fine.error < 1.0 and incompressible.error < 2.6  # %
    assert incompressible.figures["force_n"] > fine.figures["force_n"]
    monkeypatch.setattr(press, "FORCE_RATIOS", (0.45,))
    (coarse,) = press.sphere_force(1e-3, 1)
    assert fine.error < coarse.error < 4.2


@pytest.mark.deep
def test_a_flat_punchs_force_goes_to_that_of_an_elastic_layer() -> None:
    """Within a percent of the layer's at 0.5 mm (0.64, 0.16 at 0.25), within 4 at 1 mm (2.97)."""
    ((coarse,), (fine,)) = (press.flat_punch(h, 1) for h in (1e-3, 0.5e-3))
    assert fine.error < 1.0  # %
    assert fine.error < coarse.error < 4.0
