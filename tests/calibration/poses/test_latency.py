"""Latency between two signals of one motion: injected ones are found, what says nothing is refused."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.poses.latency import NoLatency, estimate_latency

ARM, CAMERA = 0.010, 0.125  # [s]


def depth_at(times: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Taps that go down faster than up: 3 mm above the surface, 1 mm below it [mm]."""
    depth = np.full(times.shape, -3.0)
    for start in starts:
        depth = np.maximum(depth, np.interp(times - start, [0.0, 0.15, 0.25, 0.55], [-3.0, 1.0, 1.0, -3.0]))
    return depth


def record(
    seed: int, camera: float = CAMERA, arm: float = ARM, noise: float = 0.003, power: float = 1.5, rate: float = 30.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times of arrival and both signals; the touch is a power of the depth, and saturates."""
    rng = np.random.default_rng(seed)
    starts = 1.0 + np.cumsum(rng.uniform(0.6, 1.3, 6))
    end = starts[-1] + 1.5
    arm_times = np.arange(0.0, end, 0.002)
    arm_times = arm_times + rng.uniform(0.0, 3e-4, arm_times.shape)
    camera_times = np.arange(0.0, end, 1.0 / rate)
    camera_times = camera_times + rng.uniform(-0.3, 0.3, camera_times.shape) / rate
    touch = np.minimum(0.1 * np.maximum(depth_at(camera_times - camera, starts), 0.0) ** power, 0.08)
    touch = touch + rng.normal(0.0, noise, touch.shape)
    return arm_times, depth_at(arm_times - arm, starts), camera_times, touch


@pytest.mark.parametrize("camera", [0.0, 0.040, 0.125, 0.400])
def test_finds_the_latency_between_irregular_signals(camera: float) -> None:
    for seed in range(5):
        found = estimate_latency(*record(seed, camera))
        assert abs(found.seconds - (camera - ARM)) < 3e-3  # a tenth of a frame period
        assert found.correlation > 0.9 and 0.0 < found.uncertainty < 3e-3 and found.samples > 100


def test_any_growing_response_will_do() -> None:
    for power in (0.5, 1.0, 3.0):
        assert abs(estimate_latency(*record(1, power=power)).seconds - 0.115) < 3e-3


def test_signals_without_noise_at_a_high_rate_give_a_tenth_of_a_millisecond() -> None:
    assert abs(estimate_latency(*record(3, noise=0.0, rate=200.0)).seconds - 0.115) < 1e-4


@pytest.mark.slow
def test_the_uncertainty_is_that_of_the_errors() -> None:
    found = [estimate_latency(*record(seed)) for seed in range(30)]
    errors = np.array([one.seconds - (CAMERA - ARM) for one in found])
    spread, said = float(np.sqrt((errors**2).mean())), float(np.sqrt(np.mean([one.uncertainty**2 for one in found])))
    assert 0.4 < said / spread < 2.5
    assert abs(errors.mean()) < 3.0 * spread / np.sqrt(30)  # no bias that would show


def test_neither_scale_nor_offset_matter() -> None:
    times, depth, seen_at, touch = record(2)
    pose_as_json = estimate_latency(times, depth, seen_at, touch).seconds
    other = estimate_latency(times + 5.0, 1e-3 * depth + 0.4, seen_at + 5.0, 20.0 * touch - 3.0).seconds
    assert other == pytest.approx(pose_as_json, abs=1e-5)


def test_an_arm_later_than_the_camera_is_negative() -> None:
    assert estimate_latency(*record(0, camera=0.0, arm=0.060)).seconds == pytest.approx(-0.060, abs=3e-3)


def test_signals_that_do_not_correlate_are_refused() -> None:
    times, depth, seen_at, touch = record(0)
    rng = np.random.default_rng(0)
    with pytest.raises(NoLatency, match="do not correlate"):
        estimate_latency(times, depth, seen_at, rng.normal(size=seen_at.shape))
    with pytest.raises(NoLatency, match="do not correlate"):
        estimate_latency(times, -depth, seen_at, touch)
    with pytest.raises(NoLatency, match=r"do not correlate|fit alike|edge"):
        estimate_latency(*record(0)[:2], *record(7)[2:])  # taps of another record


def test_regular_taps_fit_several_latencies() -> None:
    starts = 1.0 + 0.6 * np.arange(15)
    times, seen_at = np.arange(0.0, 11.5, 0.002), np.arange(0.0, 11.5, 1 / 30)
    touch = np.maximum(depth_at(seen_at - 0.115, starts), 0.0)
    with pytest.raises(NoLatency, match="fit alike; tap at uneven intervals"):
        estimate_latency(times, depth_at(times, starts), seen_at, touch, search=(-0.8, 0.8))


def test_a_latency_outside_the_search_is_refused() -> None:
    with pytest.raises(NoLatency, match=r"at the edge of the search|do not correlate"):
        estimate_latency(*record(0), search=(-0.05, 0.08))


def test_too_short_a_record_is_refused() -> None:
    times, depth, seen_at, touch = record(0)
    few = seen_at < 1.4
    with pytest.raises(NoLatency, match=r"only .* pictures lie where"):
        estimate_latency(times, depth, seen_at[few], touch[few])


def test_a_signal_that_never_changes_is_refused() -> None:
    times, depth, seen_at, touch = record(0)
    with pytest.raises(NoLatency, match="touch: the signal never changes"):
        estimate_latency(times, depth, seen_at, np.full_like(touch, 0.3))
    with pytest.raises(NoLatency, match="depth: the signal never changes"):
        estimate_latency(times, np.zeros_like(depth), seen_at, touch)


def test_what_is_no_signal_is_refused() -> None:
    times, depth, seen_at, touch = record(0)
    broken = touch.copy()
    broken[3] = np.nan
    for given, text in (
        ((times, depth, seen_at, broken), "must be finite"),
        ((times[::-1], depth, seen_at, touch), "times must increase"),
        ((times, depth[:-1], seen_at, touch), "as many times as values"),
        ((times, depth, seen_at[:1], touch[:1]), "as many times as values"),
    ):
        with pytest.raises(ValueError, match=text):
            estimate_latency(*given)
    with pytest.raises(ValueError, match="two increasing bounds"):
        estimate_latency(times, depth, seen_at, touch, search=(0.5, -0.1))
