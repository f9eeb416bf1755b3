"""Normal equations of photometric models, against the terms themselves."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.light.photometry import (
    MAX_SIZE,
    ModelSize,
    choose_size,
    left_out_error,
    normal_equations,
    photometric_features,
    ridge_solution,
    solve_weights,
)
from tacsim.models.photometric import term_count


def _pixels(seed: int, count: int = 700) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.5, 0.5, (2, count))
    return rng.normal(0, 0.6, (count, 2)), u, v, rng.normal(0, 0.3, (count, 3))


@pytest.mark.parametrize("chunk", [100, 700, 10_000])
def test_the_sums_are_those_of_the_terms(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calibration.light.photometry.CHUNK_PIXELS", chunk)
    gradient, u, v, change = _pixels(0)
    terms = photometric_features(gradient, u, v, *MAX_SIZE)
    found = normal_equations(gradient, u, v, change)
    np.testing.assert_allclose(found.square[0], terms.T @ terms, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.right, terms.T @ change, rtol=1e-9, atol=1e-12)
    assert found.count == change.size and found.power == pytest.approx((change**2).sum())


def test_a_saturated_channel_leaves_the_others_their_pixels() -> None:
    gradient, u, v, change = _pixels(1)
    lit = np.random.default_rng(2).random(change.shape) > (0.1, 0.4, 0.0)
    terms = photometric_features(gradient, u, v, *MAX_SIZE)
    found = normal_equations(gradient, u, v, change, lit)
    for channel, seen in enumerate(lit.T):
        np.testing.assert_allclose(found.square[channel], terms[seen].T @ terms[seen], rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(found.right[:, channel], terms[seen].T @ change[seen, channel], rtol=1e-7, atol=1e-9)
    assert found.count == lit.sum()


def test_left_out_presses_are_predicted_by_all_others() -> None:
    """The long way: each press's pixels left out of the fit, and predicted pixel by pixel."""
    sets = [_pixels(seed) for seed in range(4)]
    lit = np.random.default_rng(9).random(sets[0][3].shape) > 0.2  # one press has saturated pixels, the others none
    presses = [normal_equations(*pixels, lit if i == 2 else None) for i, pixels in enumerate(sets)]
    size, squares, count = ModelSize(*MAX_SIZE, 1e-4), 0.0, 0
    for left_out, pixels in enumerate(sets):
        terms = photometric_features(*pixels[:3], *MAX_SIZE)
        others = [press for i, press in enumerate(presses) if i != left_out]
        weights = ridge_solution(sum(o.square for o in others), sum(o.right for o in others), size.ridge)
        error = (terms @ weights - pixels[3]) * (lit if left_out == 2 else 1.0)
        squares, count = squares + float((error**2).sum()), count + (int(lit.sum()) if left_out == 2 else error.size)
        every = presses[0] + presses[1] + presses[2] + presses[3]
        np.testing.assert_allclose(solve_weights(every - presses[left_out], size), weights, rtol=1e-6, atol=1e-9)
    assert left_out_error(presses, size.ridge) == pytest.approx(np.sqrt(squares / count), rel=1e-9)


def test_the_size_is_as_large_as_the_presses_speak_for() -> None:
    """Light that is a cubic of the normal and varies along u, of which 8 presses tell; 2 say a cubic at best."""
    rng = np.random.default_rng(4)
    weights = rng.normal(0, 0.5, (term_count(3, 1), 3))
    presses = []
    for seed in range(8):
        gradient, u, v, _ = _pixels(seed, 3000)
        change = photometric_features(gradient, u, v, 3, 1) @ weights + rng.normal(0, 0.02, (3000, 3))
        presses.append(normal_equations(gradient, u, v, change))
    chosen = choose_size(presses)
    assert (chosen.degree, chosen.position) == (3, 1)
    every = presses[0]
    for press in presses[1:]:
        every = every + press
    np.testing.assert_allclose(solve_weights(every, chosen), weights, atol=0.1)
    assert (choose_size(presses[:2]).degree, choose_size(presses[:2]).position) == (3, 0)
