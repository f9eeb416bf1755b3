"""`tacsim calibrate lens`, and what comes of its view in `tacsim calibrate sensor` and in rig files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calibration.bundle import read_bundle, write_bundle
from calibration.lens.view import GelView, Lens
from tacsim.config import load_model, load_rig
from tacsim.record.images import encode_png, read_image
from tests.calibration.boards import DOTS, LENS, facing, photograph, tilted
from tests.calibration.presses import BALL, COLUMNS, PITCH, ROWS, HiddenSensor
from tests.calibration.test_bundle import PICTURE, calibration
from tests.robot.cli.invoked import plain_text, tacsim

BOARD = ["--board", "dots:9x7:2.5 mm"]


def run(*words: object) -> tuple[int, str, str]:
    done = tacsim("calibrate", *words)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.stdout, plain_text(done.stderr)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board")
    for i, pose in enumerate(tilted(DOTS, 7)):
        (folder / f"{i}.png").write_bytes(encode_png(photograph(DOTS, pose, seed=i)))
    (folder / "empty.png").write_bytes(encode_png(np.full((480, 640, 3), 128, np.uint8)))
    return folder


@pytest.mark.slow
def test_calibrate_lens_folder_gives_lens_and_image_gives_view(pictures: Path, tmp_path: Path) -> None:
    code, said, _ = run("lens", pictures, *BOARD, "--out", tmp_path / "lens")
    assert code == 0, said
    assert "left out: empty.png: the board" in said and "residual" in said
    lens = load_model(Lens, tmp_path / "lens" / "lens.yaml")
    np.testing.assert_allclose(lens.focal, LENS.focal, rtol=0.02)
    (tmp_path / "gel.png").write_bytes(encode_png(photograph(DOTS, facing(DOTS, [0.1, -0.1, 0.0], 0.032))))
    known = ["--lens", tmp_path / "lens" / "lens.yaml", "--size", "18 mm, 14 mm"]
    code, said, _ = run("lens", tmp_path / "gel.png", *BOARD, *known, "--out", tmp_path / "view")
    assert code == 0, said
    assert "px, 0.0" in said  # residual in px and mm
    view = load_model(GelView, tmp_path / "view" / "view.yaml")
    assert view.size == pytest.approx((18e-3, 14e-3)) and view.lens == lens
    shape = (view.geometry.height, view.geometry.width, 3)
    assert read_image(tmp_path / "view" / "rectified.png").shape == shape


@pytest.mark.slow
def test_calibrate_sensor_with_oblique_view_succeeds(tmp_path: Path) -> None:
    made = HiddenSensor(3)
    corners = np.array([(30.0, 22.0), (295.0, 15.0), (285.0, 220.0), (25.0, 225.0)], dtype=np.float32)
    edges = np.array([(0, 0), (COLUMNS, 0), (COLUMNS, ROWS), (0, ROWS)], dtype=np.float32) - 0.5
    askew = cv2.getPerspectiveTransform(edges, corners)
    frames = tmp_path / "frames"
    frames.mkdir()
    pictures = {"background": made.empty()} | {f"press{i}": press.image for i, press in enumerate(made.presses(5))}
    for name, metric in pictures.items():
        native = cv2.warpPerspective(metric, askew, (320, 240), borderMode=cv2.BORDER_REPLICATE)
        (frames / f"{name}.png").write_bytes(encode_png(np.asarray(native)))
    four = ",".join(f"{value:g}" for value in corners.ravel())
    size = f"{COLUMNS * PITCH} m, {ROWS * PITCH} m"
    code, _, err = run("lens", frames / "background.png", "--corners", four, "--size", size, "--out", tmp_path / "view")
    assert code == 0, err
    ball = ["--ball-radius", f"{BALL} m"]
    seen = ["--view", tmp_path / "view" / "view.yaml"]
    code, _, err = run("sensor", frames, *ball, *seen, "--out", tmp_path / "bundle")
    assert code == 4, err  # four corners and a size say how large a pixel is, and nothing checks it
    calibration, reference = read_bundle(tmp_path / "bundle")
    assert calibration.view == load_model(GelView, tmp_path / "view" / "view.yaml")
    assert calibration.geometry == calibration.view.geometry
    assert reference.shape == (calibration.geometry.height, calibration.geometry.width, 3)
    # The perspective is gone: contacts are round and as large as the ball's depth makes them.
    truth = {f"press{i}.png": press.circle[2] * PITCH for i, press in enumerate(HiddenSensor(3).presses(5))}
    assert len(calibration.residuals) == 5
    for residual in calibration.residuals:
        radius = residual.circle[2] * calibration.geometry.pixel_pitch
        assert radius == pytest.approx(truth[residual.frame], rel=0.06)
    assert np.median([residual.angle for residual in calibration.residuals]) < 4.0  # degrees
    # Compared with its own frames, whose pictures are the camera's: through the view, and on the gel.
    bundles = ["--calibration-a", str(tmp_path / "bundle"), "--calibration-b", str(tmp_path / "bundle")]
    words = ["compare", str(frames), str(frames), *bundles, "--out", str(tmp_path / "compared")]
    done = tacsim(*words)
    assert done.exit_code == 0, done.output
    overall = json.loads((tmp_path / "compared" / "compare.json").read_text())["overall"]
    assert overall["contact_iou"]["mean"] == pytest.approx(1.0)
    assert overall["gradient_angle"]["mean"] == pytest.approx(0.0, abs=1e-3)
    code, _, err = run("sensor", frames, *ball, *seen, "--pixel-pitch", "0.08 mm", "--out", tmp_path / "no")
    assert code == 2 and "either --pixel-pitch or --view" in err
    (frames / "background.png").write_bytes(encode_png(pictures["background"]))
    code, _, err = run("sensor", frames, *ball, *seen, "--out", tmp_path / "no")
    assert code == 2 and "all pictures of a folder must have one size" in err
    for name, metric in pictures.items():
        (frames / f"{name}.png").write_bytes(encode_png(metric))
    code, _, err = run("sensor", frames, *ball, *seen, "--out", tmp_path / "no")
    assert code == 2 and "the view was calibrated on 320 x 240 px" in err


@pytest.mark.slow
def test_calibrate_lens_invalid_input_exits_with_2(pictures: Path, tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "a.png").write_bytes((pictures / "0.png").read_bytes())
    (tmp_path / "mixed").mkdir()
    (tmp_path / "mixed" / "a.png").write_bytes((pictures / "0.png").read_bytes())
    (tmp_path / "mixed" / "b.png").write_bytes(encode_png(photograph(DOTS, tilted(DOTS)[0])[:400]))
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(LENS.model_copy(update={"width": 320}).model_dump()))
    (tmp_path / "text.png").write_text("no picture")
    picture = pictures / "0.png"
    for words, said in (
        ([picture, "--board", "dots:8x7:2.5 mm"], "more dots than 8 x 7"),
        ([picture, "--board", "dots:11x7:2.5 mm"], "is not found"),
        ([pictures / "empty.png", *BOARD], "is not found"),
        ([picture, "--board", "dots"], "is no board"),
        ([picture], "either --board or --corners"),
        ([picture, "--corners", "1,2,3"], "8 numbers are needed"),
        ([picture, "--corners", "9,9,0,0,9,0,0,9", "--size", "16 mm, 12 mm"], "no convex quadrangle"),
        ([picture, "--corners", "0,0,9,0,9,9,0,9"], "give the gel's --size"),
        ([picture, *BOARD, "--lens", tmp_path / "small.yaml"], "the lens was calibrated at 320 x 480 px"),
        ([tmp_path / "text.png", *BOARD], "text.png"),
        ([tmp_path / "none.png", *BOARD], "none.png"),
        ([tmp_path / "one", *BOARD], "1 picture(s) of a board are too few for a lens"),
        ([tmp_path / "mixed", *BOARD], "differ in size"),
    ):
        code, out, err = run("lens", *words, "--out", tmp_path / "out")
        assert code == 2 and said in err, (words, code, out, err)
        assert not (tmp_path / "out").exists()


RIG = """
name: wall
clock: wall
sensors:
  gel: { driver: camera, source: "http://127.0.0.1:9/", CAMERA, width: 160, height: 120 }
"""


def doctor(rig: Path) -> tuple[int, str]:
    done = tacsim("doctor", "--rig", rig)
    return done.exit_code, plain_text(done.output)


@pytest.mark.slow
def test_bundle_path_is_relative_to_rig_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lab" / "gs").mkdir(parents=True)
    write_bundle(tmp_path / "lab" / "gs", calibration(), PICTURE)
    rig = tmp_path / "lab" / "rig.yaml"
    rig.write_text(RIG.replace("CAMERA", "calibration: gs"))
    monkeypatch.chdir(tmp_path)
    (sensor,) = load_rig(rig).config.sensors.values()
    assert sensor.calibration == str((tmp_path / "lab" / "gs").resolve())  # type: ignore[union-attr]
    # of an option: from where it was typed
    (other,) = load_rig(rig, overrides=["sensors.gel.calibration=lab/gs"]).config.sensors.values()
    assert other == sensor
    assert read_bundle(Path(sensor.calibration))[0].serial == "gs-42"  # type: ignore[union-attr, arg-type]
    code, _ = doctor(rig)
    assert code == 1  # the bundle is well; nobody answers at the camera's address


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ("calibration: gs", "sensors.gel: .*calibrated on pictures of 160 x 120 px, this sensor delivers 320 x 120"),
        ("calibration: nowhere", "sensors.gel: .*nowhere.* is not there"),
        ("corners: [[9, 9], [0, 0], [9, 0], [0, 9]]", "sensors.gel: corners .* no convex quadrangle"),
        ("model: ideal", "sensors.gel delivers 320 x 120 px .*model 'ideal' shows 320 x 240"),
    ],
)
def test_wrong_calibration_exits_with_2(camera: str, words: str, tmp_path: Path) -> None:
    import re

    (tmp_path / "gs").mkdir()
    write_bundle(tmp_path / "gs", calibration(), PICTURE)
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.replace("CAMERA", camera).replace("width: 160", "width: 320"))
    code, said = doctor(rig)
    assert code == 2 and re.search(words, said), said
    done = tacsim("run", rig, "--out", tmp_path / "o")
    assert done.exit_code == 2 and re.search(words, plain_text(done.output)), done.output
