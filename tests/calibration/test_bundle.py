from pathlib import Path

import numpy as np
import pytest

from calibration.bundle import (
    FILE,
    REFERENCE,
    BadBundle,
    Calibration,
    Provenance,
    read_bundle,
    sensor_model,
    write_bundle,
)
from calibration.inverse import TERMS, InverseModel
from calibration.normaliser import for_calibrated, for_camera
from tacsim.hardware import CameraSensorFacts
from tacsim.interface import TactileFrame
from tacsim.optics.geometry import CanonicalGrid, SensorGeometry
from tacsim.optics.photometric import PhotometricModel
from tacsim.optics.render import Renderer
from tests.tacsim.optics.surfaces import dent, flat

RNG = np.random.default_rng(0)
PICTURE = RNG.integers(80, 120, (120, 160, 3), dtype=np.uint8)


def calibration(serial: str = "gs-42") -> Calibration:
    weights = RNG.normal(0, 0.5, (3, 3))
    return Calibration(
        format=1,
        serial=serial,
        geometry=SensorGeometry(width=160, height=120, pixel_pitch=0.1e-3),
        gel_size=(16e-3, 12e-3),
        forward=PhotometricModel(degree=1, position=0, weights=tuple(map(tuple, weights.tolist())), steepest=0.8),
        inverse=InverseModel(weights=tuple((0.0, 0.0) for _ in range(TERMS)), steepest=0.8),
        skirt_length=0.8e-3,
        skirt_fraction=0.6,
        provenance=Provenance(
            made="2026-01-01T00:00:00+00:00", software="tacsim", ball_radius=2.92e-3, frames=("a.png",)
        ),
        reference="0" * 64,
    )


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
        ("format: 1", "format: 0", "has format 0, this version of tacsim reads 1"),
        ("format: 1", "form: 1", "names no format"),
        ("serial: gs-42", "serial: gs-43", "was changed since it was written"),
        ("degree: 1", "degree: 2", "is damaged"),
        ("skirt_fraction: 0.6", "skirt_fraction: six", "is damaged"),
        ("skirt_fraction: 0.6", "skirt_fraction: 0.7", "was changed since it was written"),
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


def test_a_picture_of_another_size_is_refused(tmp_path: Path) -> None:
    write_bundle(tmp_path, calibration(), PICTURE[:100].copy())
    with pytest.raises(BadBundle, match=r"\(100, 160, 3\), the calibration is of \(120, 160, 3\)"):
        read_bundle(tmp_path)


def test_the_twin_shows_the_sensors_own_picture_and_changes_with_a_dent(bundle: Path) -> None:
    render = Renderer(sensor_model(bundle), (20e-3, 20e-3))
    np.testing.assert_array_equal(render(flat()), PICTURE)
    assert np.abs(render(dent()).astype(int) - PICTURE).max() > 10


def test_a_camera_with_a_calibration_finds_height(bundle: Path) -> None:
    normalise = for_camera(
        CameraSensorFacts(driver="camera", source="x", calibration=str(bundle)), (1.0, 1.0), CanonicalGrid()
    )
    assert normalise.finds_height
    frame = TactileFrame(image=PICTURE, time=0.0, index=0)
    normalise.take_reference(frame)
    seen = normalise(frame, now=0.0)
    assert not seen.contact.any()
    np.testing.assert_array_equal(seen.height, 0.0)
    assert seen.valid.sum() == 64 * 48
    assert for_calibrated(read_bundle(bundle)[0], CanonicalGrid()).finds_height
