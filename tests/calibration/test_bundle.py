import os
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration.bundle import (
    FILE,
    REFERENCE,
    BadBundle,
    Calibration,
    Provenance,
    read_bundle,
    read_sensor_model,
    write_bundle,
)
from calibration.height.slopes import TERMS, InverseModel
from calibration.lens.rectification import metric_rectification
from calibration.lens.view import GelView, pinhole_lens, view_of_corners
from calibration.normaliser import normaliser_for_calibration, normaliser_for_camera
from tacsim.config.bundle import bundle_digest
from tacsim.interface import TactileFrame
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.photometric import CastShadows, PhotometricModel
from tacsim.models.sensor import CameraNoise, CanonicalGrid, SensorGeometry
from tacsim.optics.render import Renderer
from tests.tacsim.optics.surfaces import dent, flat

RNG = np.random.default_rng(0)
PICTURE = RNG.integers(80, 120, (120, 160, 3), dtype=np.uint8)


def calibration(serial: str = "gs-42") -> Calibration:
    weights = RNG.normal(0, 0.5, (3, 3))
    return Calibration(
        serial=serial,
        geometry=SensorGeometry(width=160, height=120, pixel_pitch=0.1e-3),
        gel_size=(16e-3, 12e-3),
        forward=PhotometricModel(degree=1, position=0, weights=tuple(map(tuple, weights.tolist())), steepest=0.8),
        inverse=InverseModel(weights=tuple((0.0, 0.0) for _ in range(TERMS)), steepest=0.8),
        provenance=Provenance(
            made="2026-01-01T00:00:00+00:00", software="tacsim", ball_radius=2.92e-3, frames=("a.png",)
        ),
        reference="0" * 64,
    )


def camera(bundle: Path, width: int = 160, height: int = 120) -> CameraSensorConfig:
    return CameraSensorConfig(driver="camera", source="x", calibration=str(bundle), width=width, height=height)


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    write_bundle(tmp_path, calibration(), PICTURE)
    return tmp_path


def test_a_bundle_comes_back_bit_by_bit(bundle: Path) -> None:
    for path in (bundle, bundle / FILE):
        read, picture = read_bundle(path, "gs-42")
        assert read.checksum == read.digest()
        np.testing.assert_array_equal(picture, PICTURE)
    written = calibration()
    assert read.geometry == written.geometry
    assert read.gel_size == written.gel_size
    assert read.provenance == written.provenance


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("format: 8", "format: 7", "has format 7, this version of tacsim reads 8; make it again"),
        ("format: 8", "format: 9", "has format 9, this version of tacsim reads 8; make it again"),
        ("format: 8", "form: 8", "names no format"),
        ("noise: null", "noise: {deviation: [1, 1, 1]}", "was changed since it was written"),
        ("noise: null", "noise: {deviation: [1, 1, -1]}", "is damaged"),
        ("noise: null", "noise: {deviation: [1, 1, 1], colours: [0.9, 0.9, -0.9]}", "is damaged"),
        ("serial: gs-42", "serial: gs-43", "was changed since it was written"),
        ("degree: 1", "degree: 2", "is damaged"),
        ("ball_radius: 0.00292", "ball_radius: six", "is damaged"),
        ("ball_radius: 0.00292", "ball_radius: 0.003", "was changed since it was written"),
    ],
)
def test_a_changed_or_older_file_is_refused(bundle: Path, old: str, new: str, words: str) -> None:
    text = (bundle / FILE).read_text(encoding="utf-8")
    assert old in text
    (bundle / FILE).write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(BadBundle, match=words):
        read_bundle(bundle)


def test_what_is_missing_or_foreign_is_named(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.raises(BadBundle, match="belongs to sensor 'gs-42', not to 'other'"):
        read_bundle(bundle, "other")
    other = tmp_path_factory.mktemp("other")
    write_bundle(other, calibration("other"), PICTURE[::-1].copy())
    (bundle / REFERENCE).write_bytes((other / REFERENCE).read_bytes())
    with pytest.raises(BadBundle, match="is not the picture of this calibration"):
        read_bundle(bundle)
    (bundle / REFERENCE).unlink()
    with pytest.raises(BadBundle, match=r"reference\.png is not there"):
        read_bundle(bundle)
    with pytest.raises(BadBundle, match="is not there"):
        read_bundle(other / "nowhere")
    (bundle / FILE).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadBundle):
        read_bundle(bundle)


def test_what_is_no_file_or_too_large_is_refused_unread(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.raises(BadBundle, match="cannot be read"):
        read_bundle(bundle / ("x" * 300))
    for name in (FILE, REFERENCE):
        folder = tmp_path_factory.mktemp("odd")
        write_bundle(folder, calibration(), PICTURE)
        with (folder / name).open("r+b") as file:
            file.truncate(1 << 27)  # of holes
        with pytest.raises(BadBundle, match="is too much for a calibration"):
            read_bundle(folder)
        (folder / name).unlink()
        os.mkfifo(folder / name)
        with pytest.raises(BadBundle, match="is no file"):
            read_bundle(folder)
    with pytest.raises(BadBundle, match=r"is no calibration|cannot be read"):
        read_bundle(bundle / REFERENCE)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: text.replace("format: 8", "format: 8\nformat: 1", 1),
        lambda text: text + "more: 1\n",
        lambda text: "format: 8\nx: !!python/object/apply:os.system [false]\n",
        lambda text: "format: 8\nx: " + "[" * 5000,
        lambda text: re.sub(r"steepest: [0-9.]+", "steepest: .nan", text),
    ],
    ids=["half", "empty", "twice", "unknown key", "code", "deep", "nan"],
)
def test_damage_of_any_kind_is_refused(bundle: Path, spoil) -> None:
    (bundle / FILE).write_text(spoil((bundle / FILE).read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(BadBundle, match=re.escape(str(bundle))):
        read_bundle(bundle)


def test_the_gel_is_as_large_as_the_picture_shows() -> None:
    with pytest.raises(ValueError, match="the picture of its geometry shows"):
        Calibration.model_validate(calibration().model_dump() | {"gel_size": (1.0, 1.0)})


def test_a_picture_of_another_size_is_refused(tmp_path: Path) -> None:
    write_bundle(tmp_path, calibration(), PICTURE[:100].copy())
    with pytest.raises(BadBundle, match=r"\(100, 160, 3\), the calibration is of \(120, 160, 3\)"):
        read_bundle(tmp_path)


def test_the_twin_shows_the_sensors_own_picture_and_changes_with_a_dent(bundle: Path) -> None:
    render = Renderer(read_sensor_model(bundle), (20e-3, 20e-3))
    np.testing.assert_array_equal(render(flat()), PICTURE)
    assert np.abs(render(dent()).astype(int) - PICTURE).max() > 10


def test_a_camera_with_a_calibration_finds_height(bundle: Path) -> None:
    normalise = normaliser_for_camera(camera(bundle), (1.0, 1.0), CanonicalGrid())
    assert normalise.finds_height
    frame = TactileFrame(image=PICTURE, time=0.0, index=0)
    normalise.take_reference(frame)
    seen = normalise(frame, now=0.0)
    assert not seen.contact.any()
    np.testing.assert_array_equal(seen.height, 0.0)
    assert seen.valid.sum() == 64 * 48
    assert normaliser_for_calibration(read_bundle(bundle)[0], CanonicalGrid()).finds_height


def test_a_bundle_keeps_the_skin_and_gives_it_to_the_twin(tmp_path: Path) -> None:
    write_bundle(tmp_path, calibration().model_copy(update={"skin": 0.6}), PICTURE)
    assert read_bundle(tmp_path)[0].skin == 0.6 == read_sensor_model(tmp_path).skin
    write_bundle(tmp_path, calibration(), PICTURE)
    assert read_bundle(tmp_path)[0].skin is None and read_sensor_model(tmp_path).skin == 0.0


def test_a_bundle_keeps_the_noise_and_gives_it_to_the_twin(tmp_path: Path) -> None:
    noise = CameraNoise(deviation=(1.8, 1.5, 2.1), colours=(0.4, 0.4, 0.3), neighbours=(0.7, 0.75))
    write_bundle(tmp_path, calibration().model_copy(update={"noise": noise}), PICTURE)
    assert read_bundle(tmp_path)[0].noise == noise == read_sensor_model(tmp_path).noise


def seen_askew() -> GelView:
    """A gel of 16 x 12 mm as a camera of 320 x 240 px sees it; rectified to 160 x 120 px of 0.1 mm."""
    corners = ((40.0, 30.0), (290.0, 20.0), (280.0, 215.0), (35.0, 222.0))
    return view_of_corners(corners, (16e-3, 12e-3), (240, 320)).model_copy(update={"pixel_pitch": 0.1e-3})


def test_a_bundle_keeps_the_view_and_takes_native_pictures(tmp_path: Path) -> None:
    view = seen_askew()
    native = (
        np.random.default_rng(7).integers(60, 200, (12, 16, 3), dtype=np.uint8).repeat(20, axis=0).repeat(20, axis=1)
    )
    untouched = np.rint(metric_rectification(view)(native)).astype(np.uint8)
    write_bundle(tmp_path, calibration().model_copy(update={"view": view}), untouched)
    read, _ = read_bundle(tmp_path)
    assert read.view == view and read.image_shape == (240, 320)
    with pytest.raises(BadBundle, match="calibrated on pictures of 320 x 240 px, this sensor delivers 160 x 120"):
        normaliser_for_camera(camera(tmp_path), (1.0, 1.0), CanonicalGrid())
    normalise = normaliser_for_camera(camera(tmp_path, 320, 240), (1.0, 1.0), CanonicalGrid())
    normalise.take_reference(TactileFrame(image=native, time=0.0, index=0))
    brighter = native.copy()
    u, v = np.rint(view.project(np.array([[3e-3, -2e-3]]))[0]).astype(int)
    brighter[v - 6 : v + 7, u - 6 : u + 7] += 30
    seen = normalise(TactileFrame(image=brighter, time=0.0, index=1), now=0.0)
    rows, columns = np.nonzero(np.abs(seen.image.astype(int) - 128).max(axis=2) > 5)
    # canonical pixels of 0.125 mm, the sensor's axis between 63 and 64
    assert columns.mean() == pytest.approx(63.5 + 24, abs=1.0) and rows.mean() == pytest.approx(63.5 - 16, abs=1.0)
    # one look-up from native pixels shows the same as the metric picture does
    metric = np.rint(metric_rectification(view)(brighter)).astype(np.uint8)
    assert metric.shape == (120, 160, 3)
    at_once = normalise._rectify(brighter)
    plain = normaliser_for_calibration(calibration(), CanonicalGrid())._rectify(metric)
    assert np.abs(at_once - plain).mean() < 1.5


def test_geometry_and_view_must_agree(tmp_path: Path) -> None:
    other = seen_askew().model_copy(update={"pixel_pitch": 0.2e-3})
    with pytest.raises(ValueError, match="its view gives"):
        Calibration.model_validate(calibration().model_dump() | {"view": other.model_dump()})
    assert pinhole_lens((240, 320)).centre == (159.5, 119.5)


def test_shadows_are_kept_and_are_none_in_bundles_that_lack_the_field(tmp_path: Path) -> None:
    weights = tuple((-0.3 * k / 9, 0.0, 0.1) for k in range(9))
    shadows = CastShadows(lamps=((0.4, -1.2),), weights=weights)
    made = calibration()
    path = write_bundle(
        tmp_path, made.model_copy(update={"forward": made.forward.model_copy(update={"shadows": shadows})}), PICTURE
    )
    assert read_bundle(tmp_path)[0].forward.shadows == shadows
    assert read_sensor_model(tmp_path).photometric.shadows == shadows
    content = yaml.safe_load(path.read_text())
    del content["forward"]["shadows"]  # as older versions wrote it
    content["checksum"] = bundle_digest(content)
    path.write_text(yaml.safe_dump(content))
    assert read_bundle(tmp_path)[0].forward.shadows is None
