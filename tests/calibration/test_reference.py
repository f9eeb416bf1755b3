import numpy as np
import pytest

from calibration.reference import UnusableReference, make_reference

VALID = np.ones((20, 30), dtype=bool)


def _grey(level: float) -> np.ndarray:
    return np.full((20, 30, 3), level, dtype=np.float32)


def test_difference_is_relative_to_the_mean_of_each_channel_over_the_gel() -> None:
    valid = VALID.copy()
    valid[:, 20:] = False
    image = _grey(0.0)
    image[:, :20] = (50.0, 100.0, 200.0)
    image[:10, :20] *= 0.5  # the mean over the gel is 3/4 of the bright half
    reference = make_reference(image, valid)
    np.testing.assert_allclose(reference.mean, (37.5, 75.0, 150.0))
    change = reference.difference(image + 15.0)
    np.testing.assert_allclose(change[:, :20], np.broadcast_to((0.4, 0.2, 0.1), (20, 20, 3)), rtol=1e-5)
    assert not change[:, 20:].any()


def test_unusable_references_are_refused() -> None:
    with pytest.raises(UnusableReference, match=r"is dark: mean R, G, B over the gel 3.0, 3.0, 3.0, at least 8"):
        make_reference(_grey(3.0), VALID)
    one_light_out = _grey(100.0)
    one_light_out[..., 2] = 1.0
    with pytest.raises(UnusableReference, match="is dark"):
        make_reference(one_light_out, VALID)
    glare = _grey(100.0)
    glare[:3, :, 0] = 255.0
    with pytest.raises(UnusableReference, match=r"saturated on 15\.0% of the gel, at most 5%"):
        make_reference(glare, VALID)
    make_reference(glare, VALID, colour=False)
    make_reference(glare, np.pad(VALID[3:], ((3, 0), (0, 0))))  # glare beside the gel does no harm
    with pytest.raises(UnusableReference, match="shows no gel"):
        make_reference(_grey(100.0), ~VALID)
    with pytest.raises(UnusableReference, match=r"reference is \(20, 30, 3\), expected \(10, 30, 3\)"):
        make_reference(_grey(100.0), VALID[:10])


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="take a fresh reference"):
        make_reference(_grey(100.0), VALID).difference(_grey(100.0)[:10])
