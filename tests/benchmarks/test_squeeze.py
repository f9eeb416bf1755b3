"""Squeeze group at a small size: a cube of 6 mm, squeezed by 1.5 mm, four control steps."""

from __future__ import annotations

import pytest

from benchmarks.cases import squeeze
from tacsim.models.scene import Box, Scene

SIDE = 6e-3


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is kept between runs: the slow limits are computed, too."""
    full_size = squeeze.squeeze_scene

    def scene(preset: str, physics: str = "hybrid", **settling: float) -> Scene:
        whole = full_size(preset, physics, **settling)
        assert whole.body is not None
        body = whole.body.model_copy(update={"geometry": Box(size=(SIDE, SIDE, SIDE))})
        gel = whole.gel.model_copy(update={"size": (14e-3, 14e-3, 4e-3)})
        return whole.model_copy(update={"body": body, "gel": gel})

    monkeypatch.setattr(squeeze, "squeeze_scene", scene)
    monkeypatch.setattr(squeeze, "cached", lambda name, question, compute: compute())
    monkeypatch.setattr(squeeze, "SQUEEZE", 1.5e-3)
    monkeypatch.setattr(squeeze, "STEPS", 4)


@pytest.mark.deep
def test_a_squeeze_ends_where_a_slow_one_does() -> None:
    driven, settled, balance, overlap, gap = squeeze.squeeze("draft", "hybrid", 1)
    assert driven.substeps is not None and settled.substeps is not None and driven.substeps < settled.substeps
    assert driven.error < 2.0 and settled.error < 2.0  # % of force
    assert settled.note == ""
    assert 1.2 < settled.figures["truth_n"] < 1.7  # 30 kPa on 36 mm^2 and more, since it has grown wider: 1.44
    assert balance.error < 0.5  # %
    assert balance.figures["lower_n"] == pytest.approx(settled.figures["force_n"], rel=0.01)
    assert 0 < overlap.error < 0.02 and 0 <= gap.error < 0.02  # mm


@pytest.mark.deep
def test_a_settled_squeeze_is_within_one_percent_of_a_slow_one() -> None:
    assert squeeze.squeeze("draft", "hybrid", 1)[1].error < 1.0  # % of force


@pytest.mark.deep
def test_a_control_step_ends_near_where_a_slow_one_does() -> None:
    settled, flowing = squeeze.control_step("draft", "hybrid", 1)
    assert settled.note == "" and settled.error < 1.0  # % of force, rms
    assert flowing.error < 2.0
    for row in (settled, flowing):
        assert row.figures["first_step_percent"] <= row.figures["worst_percent"] < 15.0
    assert settled.substeps is not None and flowing.substeps is not None
    assert flowing.substeps < settled.substeps / 3  # no hold


def test_a_body_between_sensors_that_part_sideways_goes_half_way() -> None:
    (row,) = squeeze.reposition("draft", "hybrid", 1)
    assert row.note == "" and row.error < 0.02  # mm
    assert row.figures["travel_mm"] == pytest.approx(1.5, abs=0.02)
