"""Gap and overlap of body and gel: what a squeeze leaves, and whether a shifted body is found out."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.cases.squeeze import close_sensors, squeeze_scene, world_in_contact
from benchmarks.truth.gap import gaps
from tacsim.physics.world import World

UM = 1e-6


@pytest.fixture(scope="module")
def squeezed() -> World:
    world = world_in_contact(squeeze_scene("draft"))
    close_sensors(world, 1e-3)
    return world


def test_body_and_gel_meet_without_gap_or_overlap(squeezed: World) -> None:
    found = gaps(squeezed, 0.5e-3)
    assert 0 < found.gap < 5 * UM and 0 < found.overlap < 5 * UM


def test_a_body_moved_off_one_gel_into_the_other_is_found_out(squeezed: World) -> None:
    before = gaps(squeezed, 0.5e-3)
    state = dict(squeezed.snapshot())
    moved = world_in_contact(squeeze_scene("draft"))
    moved.restore(state | {"position": state["position"] + np.array([0, 0, 0.02], np.float32)})  # [mm]
    found = gaps(moved, 0.5e-3)
    assert found.gap == pytest.approx(20 * UM, abs=before.gap + before.overlap)
    assert found.overlap == pytest.approx(20 * UM, abs=before.gap + before.overlap)


def test_a_hole_in_the_patch_is_a_gap(squeezed: World) -> None:
    state = dict(squeezed.snapshot())
    lowest = state["position"][:, 2] < state["position"][:, 2].min() + 0.3
    middle = lowest & (np.abs(state["position"][:, :2]) < 1.1).all(axis=1)  # whole cells of the patch
    position, contact = state["position"].copy(), state["contact"].copy()
    position[middle, 2] += 0.05
    contact[:, middle] = 0.0
    moved = world_in_contact(squeeze_scene("draft"))
    moved.restore(state | {"position": position, "contact": contact})
    assert middle.sum() == 16
    assert gaps(moved, 0.5e-3).gap == pytest.approx(50 * UM, abs=5 * UM)


def test_without_a_patch_there_is_nothing_to_measure() -> None:
    world = world_in_contact(squeeze_scene("draft"))
    state = dict(world.snapshot())
    world.restore(state | {"contact": np.zeros_like(state["contact"])})
    with pytest.raises(ValueError, match="no contact patch"):
        gaps(world, 0.5e-3)
