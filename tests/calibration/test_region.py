"""Only a polygon of the picture shows gel: what is beside it, still or moving, changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from calibration.bundle import read_bundle
from calibration.lens.rectification import rectification_of_corners
from calibration.lens.view import BadCorners
from calibration.normaliser import normaliser_for_camera
from tacsim.interface import TactileFrame
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.sensor import CanonicalGrid, Markers, SensorGeometry, SensorModel
from tacsim.optics.grid import canonical_image
from tacsim.optics.markers import marker_flow
from tacsim.optics.render import Renderer
from tests.calibration.presses import BALL, COLUMNS, PITCH, ROWS, HiddenSensor
from tests.robot.cli.invoked import tacsim
from tests.tacsim.optics.surfaces import dent, flat

LEFT, TOP = 50, 30  # of the gel in the camera's picture [px]
SHAPE = (ROWS + 60, COLUMNS + 90)
REGION = tuple((LEFT + u, TOP + v) for u, v in [(20, 0), (259, 0), (259, 180), (240, 199), (0, 199), (0, 20)])
GRID = CanonicalGrid()


def framed(gel: np.ndarray, seed: int) -> np.ndarray:
    """The gel in a housing that shines now here, now there."""
    rng = np.random.default_rng(seed)
    picture = np.full((*SHAPE, 3), 12, dtype=np.uint8)
    for _ in range(30):
        v, u = rng.integers(0, SHAPE[0] - 12), rng.integers(0, SHAPE[1] - 12)
        picture[v : v + 12, u : u + 12] = rng.integers(20, 250, 3)
    picture[TOP : TOP + ROWS, LEFT : LEFT + COLUMNS] = gel
    picture[TOP + 185 : TOP + ROWS, LEFT + 245 : LEFT + COLUMNS] = 12  # a corner of the gel is cut off
    return picture


def camera(**more: object) -> CameraSensorConfig:
    return CameraSensorConfig.model_validate(
        {"driver": "camera", "source": "x", "width": SHAPE[1], "height": SHAPE[0], **more}
    )


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("region")
    sensor, frames = HiddenSensor(6), folder / "frames"
    frames.mkdir()
    Image.fromarray(framed(sensor.empty(), 0)).save(frames / "background.png")
    for number, press in enumerate(sensor.presses(5)):
        Image.fromarray(framed(press.image, number + 1)).save(frames / f"{number}.png")
    Image.fromarray(framed(sensor.press(0.45e-3, 120, 110).image, 99)).save(folder / "unseen.png")
    corners = " ".join(f"{u},{v}" for u, v in REGION)
    words = ["calibrate", "sensor", str(frames), "--ball-diameter", f"{2e3 * BALL} mm", "--region", corners]
    done = tacsim(*words, "--pixel-pitch", f"{1e3 * PITCH} mm", "--out", folder / "out")
    assert done.exit_code == 4 and "verdict: unverified scale" in done.output, done.output  # nothing checks the pitch
    return folder


@pytest.mark.slow
def test_a_sensor_is_calibrated_within_its_region(bundle: Path) -> None:
    calibration, reference = read_bundle(bundle / "out")
    assert calibration.region == REGION and calibration.image_shape == SHAPE
    assert reference.shape == (ROWS, COLUMNS, 3)
    assert calibration.geometry.pixel_pitch == pytest.approx(PITCH)
    normalise = normaliser_for_camera(camera(calibration=str(bundle / "out")), (1.0, 1.0), GRID)
    empty = np.asarray(Image.open(bundle / "frames" / "background.png"))
    normalise.take_reference(TactileFrame(empty, time=0.0, index=0))
    seen = normalise(TactileFrame(np.asarray(Image.open(bundle / "unseen.png")), time=0.1, index=1), now=0.2)
    assert seen.height is not None
    assert seen.height.max() == pytest.approx(0.45e-3, rel=0.15)
    y, x = np.unravel_index(seen.height.argmax(), seen.height.shape)
    assert (x - 31.5) * GRID.pitch == pytest.approx((120 - 129.5) * PITCH, abs=0.3e-3)
    assert (y - 31.5) * GRID.pitch == pytest.approx((110 - 99.5) * PITCH, abs=0.3e-3)
    assert not seen.height[~seen.valid].any()


def test_a_region_hides_what_is_beside_it() -> None:
    whole = rectification_of_corners(None, (16e-3, 16e-3), SHAPE, canonical_image(GRID))
    inside = whole.within(((0, 0), (SHAPE[1] / 2, 0), (SHAPE[1] / 2, SHAPE[0]), (0, SHAPE[0])))
    assert inside.valid.sum() == pytest.approx(whole.valid.sum() / 2, rel=0.02)
    assert not inside.valid[:, 70:].any() and whole.within(None) is whole
    with pytest.raises(BadCorners, match="encloses"):
        whole.within(((0, 0), (5, 0), (5, 5)))
    with pytest.raises(ValidationError, match="a calibration brings its own region"):
        camera(calibration="x", region=REGION)


@pytest.mark.parametrize("words", ["1,2 3,4", "a,b c,d e,f", "1 2 3", "nan,1 2,2 5,5", "1,1 inf,1 5,5"])
def test_what_is_no_polygon_is_refused(words: str, tmp_path: Path) -> None:
    more = ["--ball-diameter", "4 mm", "--pixel-pitch", "0.1 mm", "--region", words]
    done = tacsim("calibrate", "sensor", tmp_path, *more, COLUMNS="300")
    assert done.exit_code == 2 and "is no polygon of three points" in done.output


def test_a_camera_finds_flow_by_the_pitch_of_its_dots_within_a_region() -> None:
    markers = Markers(rows=5, columns=7, pitch=1.9e-3, radius=0.22e-3)
    model = SensorModel(geometry=SensorGeometry(width=COLUMNS, height=ROWS, pixel_pitch=0.065e-3), markers=markers)
    render = Renderer(model, (20e-3, 20e-3))
    region = ((LEFT, TOP), (LEFT + COLUMNS - 1, TOP), (LEFT + COLUMNS - 1, TOP + ROWS - 1), (LEFT, TOP + ROWS - 1))

    def shown(image: np.ndarray, seed: int) -> np.ndarray:
        picture = framed(image, seed)
        picture[TOP : TOP + ROWS, LEFT : LEFT + COLUMNS] = image
        return picture

    normalise = normaliser_for_camera(camera(marker_pitch=1.9e-3, region=region), (16e-3, 16e-3), GRID)
    assert normalise.finds_flow and not normalise.finds_height
    with pytest.raises(ValueError, match="no lattice of dark dots"):
        normalise.take_reference(TactileFrame(np.full((*SHAPE, 3), 100, dtype=np.uint8), time=0.0, index=0))
    normalise.take_reference(TactileFrame(shown(render(flat()), 1), time=0.0, index=1))
    assert normalise.visible_size == pytest.approx((COLUMNS * 0.065e-3, ROWS * 0.065e-3), rel=0.01)
    slid = dent((0.5e-3, 0.4e-3), 0.4e-3, (0.3e-3, -0.1e-3))
    seen = normalise(TactileFrame(shown(render(slid), 2), time=0.1, index=2), now=0.2)
    assert seen.flow is not None
    np.testing.assert_allclose(seen.flow, marker_flow(slid, markers), atol=0.2 * 0.065e-3)  # a fifth of a pixel
    with pytest.raises(ValidationError, match=r"give one of .*\(the others null\)"):
        camera(marker_pitch=1.9e-3, corners=((0, 0), (9, 0), (9, 9), (0, 9)))
