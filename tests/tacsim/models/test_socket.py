"""A socket: a block with a hole, as a fixture of a scene."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from tacsim.models.shape import Box, Fixture, RigidObject, Socket

SOCKET = Socket(opening=(10.5e-3, 8e-3), depth=12e-3, wall=5e-3)


def test_walls_leave_the_hole_open_and_fill_the_block() -> None:
    places = np.random.default_rng(0).uniform([-12e-3, -12e-3, -13e-3], [12e-3, 12e-3, 1e-3], (4000, 3))
    number = sum(
        (np.abs(places - centre) < np.array(box.size) / 2).all(axis=1).astype(int) for centre, box in SOCKET.walls()
    )
    inside = (np.abs(places[:, :2]) < [5.25e-3, 4e-3]).all(axis=1)
    block = (np.abs(places[:, :2]) < [10.25e-3, 9e-3]).all(axis=1) & (places[:, 2] < 0) & (places[:, 2] > -12e-3)
    assert np.array_equal(number, (block & ~inside).astype(int))  # each point of the block is in one wall


def test_walls_stand_below_the_mouth() -> None:
    for centre, box in SOCKET.walls():
        assert isinstance(box, Box)
        assert centre[2] + box.size[2] / 2 == pytest.approx(0.0)


def test_only_a_fixture_is_a_socket() -> None:
    assert isinstance(Fixture.model_validate({"geometry": {"shape": "socket"}}).geometry, Socket)
    with pytest.raises(ValidationError, match="socket"):
        RigidObject.model_validate({"geometry": {"shape": "socket"}})
