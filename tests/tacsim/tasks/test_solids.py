"""Distances between a body and a solid, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from tacsim.tasks.solids import (
    SAMPLE_POINTS,
    Solid,
    centre_points,
    chamfer_distance,
    earth_movers_distance,
    intersection_over_union,
    select_evenly,
)

V = 1e-6  # [m^3]: a cube of 10 mm


def cloud(size: tuple[float, float, float], spacing: float = 0.5e-3) -> np.ndarray:
    """A box as a lattice of particles, centred."""
    axes = [(np.arange(n) - (n - 1) / 2) * spacing for n in (round(s / spacing) for s in size)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def ball(radius: float, number: int = 20_000) -> np.ndarray:
    """A ball as points, by quantiles of the radius and a spiral of directions."""
    k = np.arange(number) + 0.5
    z = 1.0 - 2.0 * k / number
    turn = np.pi * (1 + 5**0.5) * k
    r = radius * np.random.default_rng(1).permutation(k / number) ** (1 / 3)
    s = np.sqrt(1 - z * z)
    return r[:, None] * np.stack([s * np.cos(turn), s * np.sin(turn), z], axis=1)


@pytest.mark.parametrize("slenderness", [1.0, 3.0])
def test_a_rod_has_the_volume_and_lies_along_x(slenderness: float) -> None:
    rod = Solid.make_rod(V, slenderness)
    length, width, height = rod.size
    assert width == pytest.approx(height) and length == pytest.approx(slenderness * width)
    assert np.pi / 4 * width**2 * length == pytest.approx(V)
    assert np.ptp(rod.points[:, 0]) == pytest.approx(length, rel=0.1)
    end = np.array([[length / 2 + 1e-3, 0, 0], [0, width / 2 + 1e-3, 0], [0, 0, 0.0]])
    assert rod.distance(end) == pytest.approx([1e-3, 1e-3, -min(width, length) / 2])


def test_a_ball_has_the_volume() -> None:
    assert np.pi / 6 * Solid.make_ball(V).size[0] ** 3 == pytest.approx(V)


def test_what_is_the_solid_is_at_no_distance() -> None:
    for solid in (Solid.make_ball(V), Solid.make_rod(V, 2.0)):
        body = solid.points
        assert chamfer_distance(body, solid, V) == pytest.approx(0.0, abs=1e-12)
        assert earth_movers_distance(select_evenly(body), solid.sample_points) == 0.0
        assert intersection_over_union(body, solid) == pytest.approx(1.0)


def test_chamfer_of_a_larger_ball() -> None:
    """Mean of r - R over a ball of radius S > R, where r > R: 3/S^3 (S^4/4 - R S^3/3 + R^4/12); and nothing of the
    solid lies outside, so half of it."""
    solid = Solid.make_ball(V)
    r = float(solid.size[0]) / 2
    s = 1.5 * r
    expected = 3 / s**3 * (s**4 / 4 - r * s**3 / 3 + r**4 / 12)
    assert chamfer_distance(ball(s), solid, V * 1.5**3) == pytest.approx(expected / 2, rel=0.01)


def test_chamfer_of_a_smaller_ball_is_the_other_half() -> None:
    solid = Solid.make_ball(V)
    r = float(solid.size[0]) / 2
    s = r / 1.5
    expected = 3 / r**3 * (r**4 / 4 - s * r**3 / 3 + s**4 / 12)
    body = ball(s, 100_000)
    reach = 0.5 * np.sqrt(3.0) * (V / 1.5**3 / len(body)) ** (1 / 3)
    found = chamfer_distance(body, solid, V / 1.5**3)
    assert expected / 2 - reach < found < expected / 2
    assert found == pytest.approx(expected / 2, rel=0.12)


def test_earth_movers_distance_of_a_shifted_cloud_is_the_shift() -> None:
    """No way to move a cloud onto its translate is shorter in the mean than to translate it (Jensen)."""
    one = select_evenly(cloud((10e-3, 10e-3, 10e-3)))
    assert len(one) == SAMPLE_POINTS
    assert earth_movers_distance(one, one + [3e-3, 0, -4e-3]) == pytest.approx(5e-3, rel=1e-12)


def test_earth_movers_distance_of_two_spheres_is_the_difference_of_their_radii() -> None:
    one = ball(1.0, 500)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    assert earth_movers_distance(one, 1.4 * one) == pytest.approx(0.4, rel=1e-6)


def test_iou_of_a_cube_and_a_ball() -> None:
    """The cube's corners beyond the ball are as much as the ball's six caps beyond the cube, of height h = r - a / 2
    and volume pi h^2 (3 r - h) / 3 each; they do not meet, since r < a / sqrt 2."""
    a, solid = 10e-3, Solid.make_ball(V)
    r = float(solid.size[0]) / 2
    h = r - a / 2
    caps = 6 * np.pi * h**2 * (3 * r - h) / 3
    assert r < a / np.sqrt(2)
    assert intersection_over_union(cloud((a, a, a), 0.25e-3), solid) == pytest.approx((V - caps) / (V + caps), abs=3e-3)


def test_iou_of_a_shifted_rod() -> None:
    """By s along its length L: (L - s) / (L + s)."""
    rod = Solid.make_rod(V, 2.0)
    length = float(rod.size[0])
    body = rod.points + [0.25 * length, 0, 0]
    assert intersection_over_union(body, rod) == pytest.approx(0.75 / 1.25, rel=0.03)
    assert intersection_over_union(rod.points + [2 * length, 0, 0], rod) == 0.0


def test_a_cloud_is_compared_where_it_lies_best() -> None:
    body = cloud((10e-3, 10e-3, 10e-3)) + [1.0, 2.0, 3.0]
    assert centre_points(body).mean(axis=0) == pytest.approx([0, 0, 0], abs=1e-12)
    assert chamfer_distance(centre_points(body), Solid.make_ball(V), V) < 1e-3
