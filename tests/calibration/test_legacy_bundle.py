"""A bundle that tacsim 0.1.0 has written is read by every later version, and gives the heights that it gave then.

`heights.json` holds what release 0.1.0 found in `press.png` (a ball of 2.5 mm, pressed 0.5 mm into a rendered gel).
"""

import json
from pathlib import Path

import numpy as np
import pytest

from calibration.bundle import read_bundle
from calibration.normaliser import normaliser_for_calibration
from tacsim.interface import TactileFrame
from tacsim.models.sensor import CanonicalGrid
from tacsim.record.images import read_image

BUNDLE = Path(__file__).parent.parent / "fixtures" / "bundle_0_1_0"


def test_a_bundle_of_the_first_release_gives_the_heights_that_it_gave_then() -> None:
    calibration, reference = read_bundle(BUNDLE, "fixture-0.1.0")
    assert calibration.provenance.software == "tacsim 0.1.0" and len(calibration.residuals) == 8
    expected = json.loads((BUNDLE / "heights.json").read_text(encoding="utf-8"))
    normalise = normaliser_for_calibration(calibration, CanonicalGrid(), reference)
    normalise.take_reference(TactileFrame(reference, time=0.0, index=0))
    seen = normalise(TactileFrame(read_image(BUNDLE / "press.png"), time=0.1, index=1), now=0.2)
    assert seen.height is not None and seen.gradient is not None
    at = tuple(np.array([(cell["row"], cell["column"]) for cell in expected["cells"]]).T)
    # the last bits may differ: OpenCV and SciPy round differently from version to version
    np.testing.assert_allclose(seen.height[at], [cell["height"] for cell in expected["cells"]], rtol=0, atol=2e-8)
    # slopes were those of each pixel's colour then; they have been those of the height since, which is nearer the truth
    slopes = np.stack(np.gradient(seen.height, CanonicalGrid().pitch)[::-1], axis=-1)
    assert np.sqrt(((seen.gradient - slopes) ** 2).mean()) < 0.004  # differences over two cells, at the rim
    then = np.array([cell["gradient"] for cell in expected["cells"]])
    assert np.sqrt(((seen.gradient[at] - then) ** 2).mean()) < 0.006
    assert seen.contact.sum() == expected["contact_cells"]
    assert normalise.diagnostics()["drift"] == pytest.approx(expected["drift"], rel=1e-4)
