"""Materials group: the product's body and gel against closed forms, and how fast they come near them."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from benchmarks.cases import materials
from benchmarks.truth.clay import CLAY


def orders(errors: list[float]) -> list[float]:
    """Of convergence, between one resolution and half of it."""
    return [math.log2(coarse / fine) for coarse, fine in pairwise(errors)]


@pytest.mark.slow
def test_a_squeezed_cube_yields_at_its_yield_stress_the_nearer_the_finer() -> None:
    """F/A = sigma_y between frictionless plates; volume shrinks by sigma_y / 3K, which plastic flow leaves alone.

    The error is of first order, since stress is smeared over the cell at each plate; its limit is the yield stress."""
    rows = [materials.yield_plateau(4e-3, h, 1)[0] for h in (0.5e-3, 0.25e-3, 0.125e-3)]
    assert all(row.note == "" for row in rows)
    assert rows[-1].error < 3.0  # %
    errors = [row.error for row in rows]
    assert orders(errors) == pytest.approx([1.0, 1.0], abs=0.1)
    assert 2.0 * errors[-1] - errors[-2] == pytest.approx(0.0, abs=0.3)  # %, by Richardson's extrapolation
    assert CLAY.yield_stress is not None
    bulk = CLAY.youngs_modulus / (3 * (1 - 2 * CLAY.poisson_ratio))
    assert rows[-1].figures["stress_pa"] > CLAY.yield_stress  # from above: a coarse body is stiff
    assert rows[-1].figures["mean_j"] == pytest.approx(math.exp(-CLAY.yield_stress / (3 * bulk)), abs=2e-4)


@pytest.mark.deep
def test_sheared_points_bear_what_they_yield_at() -> None:
    (row,) = materials.simple_shear(1)
    assert row.figures["against_float64_percent"] < 1e-3
    assert row.error < 0.6  # %, of the finite elastic strain: the float64 law has it too
    assert row.figures["float64_against_closed_form_percent"] == pytest.approx(row.error, abs=1e-3)


@pytest.mark.deep
def test_waves_run_at_the_speed_of_the_continuum_to_second_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(materials, "HALF_PERIODS", 2)
    for wave, resolutions in ((materials.body_wave, (0.5e-3, 0.25e-3)), (materials.gel_wave, (1e-3, 0.5e-3))):
        coarse, fine = (wave(h, 1) for h in resolutions)
        assert [row.variant.rpartition(", ")[2] for row in fine] == ["pressure wave", "shear wave"]
        for before, after in zip(coarse, fine, strict=True):
            assert after.error < 0.45  # %
            assert orders([before.error, after.error])[0] > 1.8
        truths = [row.figures["half_period_truth"] for row in fine]  # [mm], at a pressure wave of speed 1: c_p / c_s
        assert truths == pytest.approx([8.0, 8.0 * math.sqrt(2 * (1 - 0.45) / (1 - 2 * 0.45))])


@pytest.mark.slow
def test_a_cube_drawn_apart_yields_and_keeps_its_momentum() -> None:
    (row,) = materials.plasticine_alone(4e-3, 0.5e-3, 1)
    assert row.figures["yielded"] > 0.5
    assert row.error < 3e-6  # 60 substeps round alike, since the stencils stay
