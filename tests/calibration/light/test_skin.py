import cv2
import numpy as np
import pytest

from calibration.light.dent import ContactCircle
from calibration.light.noise import measure_skin
from calibration.light.press import BallPress

PITCH, RADIUS, SIDE = 0.06e-3, 20.0, 260
PLACES = [(70, 80), (180, 90), (130, 130), (90, 180), (185, 185)]


def presses(skin: float, own: float, dust: float, slide: float, count: int = 5) -> tuple[list[BallPress], np.ndarray]:
    """Presses that drag the gel along by `slide` [px], less the farther away, and the picture without contact: grain
    of deviation `skin` on the gel, `own` of each picture's noise, `dust` on the lens [grey levels]."""
    rng = np.random.default_rng(0)
    on_gel = cv2.GaussianBlur(rng.normal(0, 1, (SIDE, SIDE)), (0, 0), 0.8)[..., None]
    on_gel = skin / on_gel.std() * on_gel
    on_lens = rng.normal(0, dust, (SIDE, SIDE, 1))
    reference = np.rint(110 + on_gel + on_lens + rng.normal(0, own, (SIDE, SIDE, 3))).astype(np.uint8)
    v, u = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    made = []
    for k, (x, y) in enumerate(PLACES[:count]):
        drag = slide * np.exp(-((np.hypot(u - x, v - y) / (2.2 * RADIUS)) ** 2))
        at = (u - drag * np.cos(k)).astype(np.float32), (v - drag * np.sin(k)).astype(np.float32)
        moved = cv2.remap(on_gel.astype(np.float32), *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)[..., None]
        seen = 110 + moved + on_lens + rng.normal(0, own, (SIDE, SIDE, 3))
        change = (seen - reference) / reference.mean(axis=(0, 1))
        lit, drift = np.ones(reference.shape, dtype=bool), np.zeros(reference.shape)
        made.append(BallPress(str(k), ContactCircle(x, y, RADIUS), change, drift, lit))
    return made, reference


def test_what_is_dragged_along_is_skin_and_a_pictures_own_noise_is_not() -> None:
    share = measure_skin(*presses(skin=3, own=0.3, dust=0, slide=8), PITCH)
    assert share is not None and 0.8 < share <= 1.0
    less = measure_skin(*presses(skin=3, own=3.0, dust=0, slide=8), PITCH)
    assert less is not None and 0.3 < less < 0.6  # of the picture's grain half is its noise


@pytest.mark.parametrize(
    ("skin", "own", "dust", "slide", "count"),
    [(0, 1, 3, 8, 5), (0, 3, 0, 8, 5), (3, 0.3, 0, 0, 5), (3, 0.3, 0, 8, 3)],
    ids=["dust on the lens", "noise", "skin that is not dragged", "three presses"],
)
def test_where_nothing_is_seen_to_move_there_is_none(
    skin: float, own: float, dust: float, slide: float, count: int
) -> None:
    assert measure_skin(*presses(skin, own, dust, slide, count), PITCH) is None
