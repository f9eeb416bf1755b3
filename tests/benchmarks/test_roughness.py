"""Roughness of a print: what counts, what does not."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.truth.roughness import filter_weights, inside_print, print_roughness
from tacsim.models.scene import GelSurface

UM = 1e-6


def surface(depth: np.ndarray) -> GelSurface:
    """A surface pressed down by `depth` (41, 41) [m], nodes 0.5 mm apart."""
    displacement = np.zeros((*depth.shape, 3), np.float32)
    displacement[..., 2] = -depth
    return GelSurface(displacement, 0.5e-3, (-10e-3, -10e-3))


def square(form: object = 0.0) -> np.ndarray:
    depth = np.zeros((41, 41))
    depth[10:31, 10:31] = (300 * UM + form)[10:31, 10:31] if isinstance(form, np.ndarray) else 300 * UM
    return depth


def test_white_noise_gives_its_own_deviation() -> None:
    random = np.random.default_rng(0)
    found = [print_roughness(surface(square(random.normal(scale=10 * UM, size=(41, 41))))) for _ in range(50)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(10 * UM, rel=0.03)


def test_flat_tilted_and_curved_prints_are_smooth() -> None:
    i, j = np.indices((41, 41)) - 20.0
    assert print_roughness(surface(square())) < 1e-3 * UM
    form = (3 * i - 2 * j - 0.5 * i * i + 0.3 * i * j + 0.01 * j**3) * UM
    assert print_roughness(surface(square(form))) < 1e-3 * UM
    ball = np.maximum(700 * UM - (i * i + j * j) * 0.25e-6 / 16e-3, 0.0)  # cap of a ball of 8 mm
    assert print_roughness(surface(ball)) < 0.1 * UM


def test_steps_of_a_lattice_are_seen() -> None:
    i, j = np.indices((41, 41)) - 20.0
    ball = 700 * UM - (i * i + j * j) * 0.25e-6 / 16e-3
    steps = np.maximum(np.round(ball / (250 * UM)) * 250 * UM, 0.0)
    assert print_roughness(surface(steps)) > 30 * UM


def test_weights_pass_cubics_and_the_rim_is_left_out() -> None:
    weights = filter_weights()
    assert (weights**2).sum() == pytest.approx(1)
    i, j = np.indices((5, 5)) - 2.0
    for a in range(4):
        for b in range(4 - a):
            assert (weights * i**a * j**b).sum() == pytest.approx(0, abs=1e-12), (a, b)
    inside = inside_print(square())
    assert inside.sum() == 17**2 and inside[12:29, 12:29].all()


@pytest.mark.parametrize("depth", [np.zeros((41, 41)), np.eye(41) * 1e-4])
def test_without_a_print_there_is_nothing_to_measure(depth: np.ndarray) -> None:
    with pytest.raises(ValueError, match="press deeper"):
        print_roughness(surface(depth))
