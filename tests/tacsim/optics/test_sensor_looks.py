"""The shipped sensors look like themselves: colour of the untouched gel, and the colour of each side of a dent.

The expected numbers were measured on public pictures (configs/sensors names them); no picture is needed here.
"""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from tacsim.config import load_scene, load_sensor
from tacsim.config.gel import fit_gel
from tacsim.interface import FloatArray
from tacsim.models.sensor import BackgroundPolynomial, Lighting, SensorModel
from tacsim.optics.render import Renderer, polynomial_image, untouched_image
from tests.tacsim.optics.surfaces import make_surface

# mean R, G, B of a real untouched gel [grey levels], and where each colour is brighter: its slope by x and y across the
# picture [grey levels]
UNTOUCHED = {
    "digit": ((94, 103, 95), ((-126, -48), (73, -42), (-56, -19))),
    "gelsight-mini": ((83, 96, 110), ((-12, 51), (-6, -13), (-9, -40))),
    "9dtact": ((160, 162, 161), ((0, -5), (-2, -2), (2, -7))),
}
# sign of the change of R, G, B on the side of a dent that is right, below, left, above; 0: weak on real pictures
SIDES = {
    "digit": ((1, -1, 0), (-1, 0, 1), (-1, 1, -1), (1, 1, -1)),
    "gelsight-mini": ((0, 1, 0), (-1, 0, 1), (0, -1, 0), (1, 0, -1)),
    "gelsight-wedge": ((0, -1, 0), (1, 0, -1), (0, 1, 0), (-1, 0, 1)),
}
GEL = (30e-3, 26e-3)


def picture(name: str, depth: float) -> FloatArray:
    """(H, W, 3) picture of a round dent of this depth [m] in the middle, in grey levels."""
    spread = 1.5e-3  # of the dent: at this distance it is as steep as it gets [m]
    surface = make_surface(
        lambda x, y: (0 * x, 0 * y, -depth * np.exp(-(x**2 + y**2) / (2 * spread**2))), size=GEL, spacing=0.25e-3
    )
    return Renderer(load_sensor(name), GEL)(surface).astype(np.float64)


def mean_near(image: FloatArray, name: str, x: float, y: float) -> FloatArray:
    """(3,) mean colour within 0.3 mm of a place [m] on the gel."""
    geometry = load_sensor(name).geometry
    v, u = np.mgrid[: geometry.height, : geometry.width]
    at_x, at_y = ((p - p0) * geometry.pixel_pitch for p, p0 in zip((u, v), geometry.principal, strict=True))
    return np.asarray(image[np.hypot(at_x - x, at_y - y) < 0.3e-3].mean(axis=0))


@pytest.mark.parametrize("name", UNTOUCHED)
def test_untouched_gel_has_the_colour_of_the_real_one(name: str) -> None:
    image = picture(name, 0.0)
    mean, slopes = UNTOUCHED[name]
    np.testing.assert_allclose(image.mean(axis=(0, 1)), mean, atol=3)
    rows, columns = image.shape[:2]
    v, u = np.mgrid[:rows, :columns] / np.array([rows, columns])[:, None, None] - 0.5
    fit = np.stack([np.ones_like(u), u, v], axis=-1).reshape(-1, 3)
    found = np.linalg.lstsq(fit, image.reshape(-1, 3), rcond=None)[0]
    np.testing.assert_allclose(found[1:].T, slopes, atol=4)


@pytest.mark.parametrize("name", SIDES)
def test_each_side_of_a_dent_has_the_colour_of_the_real_one(name: str) -> None:
    change = picture(name, 0.9e-3) - picture(name, 0.0)
    steepest, least = 1.5e-3, 8.0  # place of the largest slope [m]; a clear change of colour [grey levels]
    for (x, y), signs in zip(((1, 0), (0, 1), (-1, 0), (0, -1)), SIDES[name], strict=True):
        found = mean_near(change, name, x * steepest, y * steepest)
        assert all(sign * value > least for sign, value in zip(signs, found, strict=True) if sign), (x, y, found)


def test_a_9dtact_is_dark_where_it_is_pressed_and_brighter_around() -> None:
    change = picture("9dtact", 1.5e-3) - picture("9dtact", 0.0)
    assert (mean_near(change, "9dtact", 0.0, 0.0) < -20).all()
    sides = [mean_near(change, "9dtact", x, y) for x, y in ((4e-3, 0), (0, 4e-3), (-4e-3, 0), (0, -4e-3))]
    assert all((side > 2).all() for side in sides)
    np.testing.assert_allclose(sides, np.mean(sides, axis=0)[None].repeat(4, axis=0), atol=2)  # no direction


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("digit", (16, 19, 3.5)), ("gelsight-mini", (25.25, 20.75, 4.5)), ("gelsight-wedge", (35, 25.5, 5.5)),
        ("9dtact", (28, 21, 4)),
    ],
)  # fmt: skip
def test_a_scene_takes_the_gel_of_the_sensor(name: str, size: tuple[float, float, float]) -> None:
    plain = load_scene("press", ["preset=draft"])
    scene, notes = fit_gel(plain, {"lower": load_sensor(name)})
    element = scene.fitted_element_size("lower")
    assert scene.gel.size[2] == pytest.approx(size[2] * 1e-3)
    assert scene.gel.size[:2] == pytest.approx([side * 1e-3 for side in size[:2]], abs=element / 2 * 1.001)
    assert notes[0].endswith("the thickness is the sensor's")
    unchanged, nothing = fit_gel(plain, {"lower": load_sensor("ideal")})
    assert unchanged == plain and not nothing


def test_a_polynomial_background_is_its_formula() -> None:
    weights = ((0.5, 0.4, 0.3), (0.2, 0.0, -0.1), (0.0, 0.1, 0.0), (0.0, 0.0, 0.3), (0.4, 0.0, 0.0), (0.0, -0.2, 0.0))
    background = BackgroundPolynomial(degree=2, weights=weights)
    image = polynomial_image(background, (20, 30))
    u, v = (4 + 0.5) / 30 - 0.5, (15 + 0.5) / 20 - 0.5
    expected = [0.5 + 0.2 * u + 0.4 * u * v, 0.4 + 0.1 * v - 0.2 * v * v, 0.3 - 0.1 * u + 0.3 * u * u]
    np.testing.assert_allclose(image[15, 4], expected, rtol=1e-6)
    np.testing.assert_allclose(untouched_image(Lighting(background=background), (20, 30)), image, atol=1e-6)


def test_what_does_not_fit_together_is_refused() -> None:
    with pytest.raises(ValidationError, match="weights has 2 rows; a polynomial of degree 1 has 3"):
        BackgroundPolynomial(degree=1, weights=((0.5, 0.5, 0.5), (0.0, 0.0, 0.0)))
    with pytest.raises(ValidationError, match="gel_thickness is given without gel_size; give both, or neither"):
        SensorModel(gel_thickness=4e-3)
