"""Noise of made-up cameras, whose truth is drawn by other means than the renderer's."""

import numpy as np
import pytest

from calibration.light.dent import ContactCircle
from calibration.light.noise import NoiseUnknown, measure_noise, measure_press_noise
from calibration.light.press import BallPress, mean_reference_colour

SHAPE = (200, 260)
V, U = np.mgrid[: SHAPE[0], : SHAPE[1]] / 100.0
RNG = np.random.default_rng(4)
STILL = RNG.uniform(70, 150, (*SHAPE, 3))  # texture that stands still
DEVIATION, NEIGHBOURS, COLOURS = (1.8, 1.4, 2.2), (0.6, 0.75), (0.5, 0.3, 0.2)


def noisy(deviation: tuple[float, ...] = DEVIATION, correlated: bool = True) -> np.ndarray:
    """One frame's noise, of a normal Markov field; by its covariance over whole rows, columns and colours."""
    noise = RNG.standard_normal((*SHAPE, 3))
    if correlated:
        for axis, beside in ((1, NEIGHBOURS[0]), (0, NEIGHBOURS[1])):
            steps = np.abs(np.subtract.outer(np.arange(SHAPE[axis]), np.arange(SHAPE[axis])))
            noise = np.moveaxis(np.tensordot(np.linalg.cholesky(beside**steps), noise, (1, axis)), 0, axis)
        rg, rb, gb = COLOURS
        noise = noise @ np.linalg.cholesky([[1, rg, rb], [rg, 1, gb], [rb, gb, 1]]).T
    return noise * deviation


def camera(count: int, drift: float = 0.0, **options: object) -> list[np.ndarray]:
    """Frames of a camera whose light drifts by about `drift` grey levels a frame, not the same everywhere."""
    slow = drift * (1.0 + 0.6 * U - 0.8 * V + 0.3 * U * V)[..., None] * [1.0, -0.5, 0.7]
    return [
        np.clip(np.rint(STILL + k * slow + noisy(**options)), 0, 255).astype(np.uint8)  # type: ignore[arg-type]
        for k in range(count)
    ]


@pytest.mark.parametrize("count", [2, 5, 8])
@pytest.mark.parametrize("drift", [0.0, 1.5])
def test_hidden_noise_is_recovered_and_drift_is_none(count: int, drift: float) -> None:
    found = measure_noise(camera(count, drift))
    # rounding is part of what a camera delivers
    truth = np.sqrt(np.square(DEVIATION) + 1 / 12)
    assert found.deviation == pytest.approx(truth, rel=0.05)
    assert found.neighbours == pytest.approx(NEIGHBOURS, abs=0.06)
    assert found.colours == pytest.approx(COLOURS, abs=0.07)


@pytest.mark.parametrize("deviation", [(0.5, 1.0, 4.0), (0.4, 0.4, 0.4)])
def test_white_noise_of_any_size_is_recovered(deviation: tuple[float, ...]) -> None:
    found = measure_noise(camera(4, deviation=deviation, correlated=False))
    assert found.deviation == pytest.approx(np.sqrt(np.square(deviation) + 1 / 12), rel=0.03)
    assert found.neighbours == pytest.approx((0.0, 0.0), abs=0.02)
    assert found.colours == pytest.approx((0.0, 0.0, 0.0), abs=0.03)


def test_a_touch_in_one_of_the_pictures_does_not_count() -> None:
    frames = camera(3)
    frames[1][40:120, 60:150] = np.clip(frames[1][40:120, 60:150] + RNG.normal(0, 30, (80, 90, 3)), 0, 255)
    assert measure_noise(frames).deviation == pytest.approx(measure_noise(camera(3)).deviation, rel=0.08)


def test_what_is_saturated_or_black_does_not_count() -> None:
    frames = camera(2)
    for frame in frames:
        frame[:, :130] = np.where(frame[:, :130] > 110, 255, frame[:, :130])
        frame[120:] = 0
    assert measure_noise(frames).deviation == pytest.approx(np.sqrt(np.square(DEVIATION) + 1 / 12), rel=0.15)
    dark = [frame // 40 for frame in camera(2)]  # 1 to 4
    with pytest.raises(NoiseUnknown, match="neither black nor saturated"):
        measure_noise(dark)


def test_without_two_different_pictures_nothing_is_known() -> None:
    frames = camera(2)
    for few, words in (
        ([], "there is none"),
        (frames[:1], "there is 1"),
        ([frames[0], frames[0].copy()], "all the same"),
        ([frames[0], frames[1][1:]], "differ in size"),
    ):
        with pytest.raises(NoiseUnknown, match=words):
            measure_noise(few)
    speck = frames[0].copy()
    speck[5, 5] += 9
    with pytest.raises(NoiseUnknown, match="do not differ on most of the untouched gel"):
        measure_noise([frames[0], speck])
    # of a source that shows a picture again only the others count
    one, other, third = camera(3)
    assert measure_noise([one, other, one, third]).deviation == pytest.approx(
        np.sqrt(np.square(DEVIATION) + 1 / 12), rel=0.06
    )


def test_the_noise_that_is_drawn_is_measured_again() -> None:
    from tacsim.optics.noise import NoiseSource

    noise = measure_noise(camera(6))
    draw = NoiseSource(noise, SHAPE)
    again = measure_noise([draw(np.rint(STILL).astype(np.uint8), frame) for frame in range(6)])
    assert again.deviation == pytest.approx(noise.deviation, rel=0.04)
    assert again.neighbours == pytest.approx(noise.neighbours, abs=0.05)
    assert again.colours == pytest.approx(noise.colours, abs=0.06)


def presses(circles: list[tuple[float, float, float]]) -> tuple[list[BallPress], np.ndarray]:
    """Presses with contact of so many pixels, in which the picture is a wild one, and the one picture without."""
    reference, *frames = camera(1 + len(circles))
    mean, lit = mean_reference_colour(reference), np.ones((*SHAPE, 3), dtype=bool)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    made = []
    for frame, (x, y, radius) in zip(frames, circles, strict=True):
        change = frame.astype(np.float64) - reference
        change += 60.0 * RNG.normal(0, 1, change.shape) * (np.hypot(u - x, v - y) < 2.9 * radius)[..., None]
        made.append(BallPress("made", ContactCircle(x, y, radius), change / mean, np.zeros(change.shape), lit))
    return made, reference


def test_noise_is_told_beside_the_contacts_where_there_is_one_picture_without() -> None:
    found = measure_press_noise(*presses([(80, 60, 24), (180, 130, 20), (130, 100, 28), (70, 140, 22)]))
    assert found.deviation == pytest.approx(np.sqrt(np.square(DEVIATION) + 1 / 12), rel=0.06)
    assert found.neighbours == pytest.approx(NEIGHBOURS, abs=0.08)
    assert found.colours == pytest.approx(COLOURS, abs=0.1)
    with pytest.raises(NoiseUnknown, match="0 parts of 32 x 32 px are untouched"):
        measure_press_noise(*presses([(130, 100, 80)]))
