"""Cost by scene, a second world, slab theory, rest, sliding."""

from __future__ import annotations

import math

import pytest

from benchmarks.cases import large_strain, scenes, slide, squeeze
from benchmarks.cases.squeeze import close_sensors, squeeze_scene, world_in_contact
from tacsim.interface import Pose
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.worlds.batch import Batch


def test_slab_theory() -> None:
    """Hill: a slab as wide as it is high bears 1 + 1 / (3 sqrt 3) of its yield stress; of ten times the width, 2.92."""
    assert large_strain.slab_force(30e3, 1e-6, 1e-2) == pytest.approx(3.0 * (1 + 1 / (3 * math.sqrt(3))))
    assert large_strain.slab_force(30e3, 1e-6, 1e-2 / 100 ** (1 / 3)) / (3.0 * 100 ** (1 / 3)) == pytest.approx(
        2.9245, abs=1e-4
    )


def test_a_slab_row_tells_what_the_body_itself_went_through() -> None:
    (row,) = large_strain._slab_rows(squeeze_scene("draft"), (0.15,), "closed by {:.0f} %")
    assert row.variant == "closed by 15 %"
    height = row.figures["height_mm"]
    assert 8.5 < height < 10  # the gels give way by the rest
    assert row.figures["squeezed_percent"] == pytest.approx(100 - 10 * height)
    assert f"{height:.2f} mm high" in row.note
    assert row.figures["slab_n"] == pytest.approx(large_strain.slab_force(30e3, 1e-6, height * 1e-3))


@pytest.mark.deep
def test_a_squeeze_is_judged_by_its_own_limit_and_by_one_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {"draft": 4.3, "standard": 4.0}
    monkeypatch.setattr(squeeze, "slow_force", lambda preset, physics="hybrid": limits[preset])
    rows = {row.variant: row for row in squeeze.squeeze("draft", "hybrid", 1)}
    (common,) = squeeze.settled_squeeze("draft", "hybrid", 1)
    force = common.figures["force_n"]
    assert rows["settled to 1 %"].error == pytest.approx(abs(force / 4.3 - 1) * 100)
    assert common.error == pytest.approx(abs(force / 4.0 - 1) * 100)
    assert rows["overlap"].error < 0.02 and 0 < rows["gap"].error < 0.02  # mm: what must be reached


def test_a_second_world_is_the_first_once_more() -> None:
    (row,) = scenes.second_world("draft", 1)
    assert row.error == 0.0
    assert row.figures["second_ms"] > 0 and row.figures["first_ms"] > 0


@pytest.mark.slow
def test_a_first_motion_is_the_same_with_kernels_of_another_process() -> None:
    rows = scenes.first_motion(1)
    assert [row.variant for row in rows] == ["kernels compiled", "kernels kept"]
    assert all(row.error == 0.0 and row.figures["force_n"] > 0.1 for row in rows)


def test_a_batch_that_diverges_is_no_row(monkeypatch: pytest.MonkeyPatch) -> None:
    lost = SimulationDiverged("lost", "made up")
    monkeypatch.setattr(Batch, "move", lambda self, targets: [None, lost])
    with pytest.raises(SimulationDiverged):
        scenes.batch(2, 1)


@pytest.mark.parametrize("shape", [scenes._ball, scenes._cylinder, scenes._box], ids=["ball", "cylinder", "box"])
def test_an_indenter_costs_and_presses(shape: object) -> None:
    (row,) = scenes.rigid(shape, 1)  # type: ignore[arg-type]
    assert row.substeps and row.substeps > 0
    assert row.figures["force_n"] > 0.1 and row.figures["ready_ms"] > 0
    assert row.error <= 1.0  # settled to 1 %


@pytest.mark.deep
def test_a_sheared_body_rests_where_it_is() -> None:
    world = world_in_contact(squeeze_scene("draft"))
    close_sensors(world, 0.3e-3)
    pose = world.pose("upper")
    world.move({"upper": Pose(pose.position + [0.2e-3, 0, 0], pose.quaternion)})
    before = world.truth()
    stats = large_strain._hold_still(world, "draft", 60)
    after = world.truth()
    assert stats.substeps == 60 and not stats.settled
    assert before is not None and after is not None
    assert 0 < abs(after.position - before.position).max() < 5e-6


@pytest.mark.deep
def test_the_plate_slides_until_friction_is_built_up() -> None:
    (row,) = slide.sliding_force(1e-3, 1)
    assert row.figures["way_mm"] >= 2
    assert row.error < 1.0 and row.note == ""


def test_a_plate_that_has_not_slid_far_enough_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slide, "SLIDES", 1)
    (row,) = slide.sliding_force(1e-3, 1)
    assert "still changes after 0.5 mm" in row.note and row.error > 20
