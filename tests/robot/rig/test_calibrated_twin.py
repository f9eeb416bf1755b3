"""A calibrated bundle is a sensor model wherever a model can stand, and the circle closes: pictures of a sensor, its
bundle, the bundle's pictures, and the surfaces found in them."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.bundle import read_bundle, read_sensor_model, write_bundle
from calibration.frame_normaliser import FrameNormaliser
from calibration.lens.view import view_of_corners
from calibration.normaliser import normaliser_for_calibration, normaliser_for_camera, normaliser_for_simulation
from robot.mock.cell.cell import _sensor_models
from tacsim.config import ConfigError, load_rig, load_sensor
from tacsim.interface import TactileFrame
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import CanonicalGrid, Lighting, Markers, SensorGeometry, SensorModel
from tacsim.optics.render import Renderer
from tacsim.optics.surface import surface_map
from tests.robot.cli.invoked import TINY, tacsim
from tests.tacsim.optics.surfaces import make_surface

GRID = CanonicalGrid()
GEL = (15.6e-3, 12.4e-3)  # seen by 240 x 190 px of 65 um
PITCH = 0.065e-3
PLACES = [(-4e-3, -2.5e-3), (3.5e-3, 2.6e-3), (0.2e-3, 0.1e-3), (-3.6e-3, 2.4e-3), (4e-3, -2.6e-3), (0.5e-3, -3e-3)]
DEPTHS = (0.5e-3, 0.35e-3, 0.6e-3, 0.4e-3, 0.45e-3, 0.3e-3)
BALL, DECAY = 4e-3, 1.1e-3  # radius of the ball, and how fast the gel beside it comes up again [m]


def dent(depth: float, x: float, y: float, slide: tuple[float, float] = (0.0, 0.0)) -> GelSurface:
    """The gel under the ball, `depth` deep at x, y [m], as a thin layer shows it: untouched a few DECAY beside the
    contact, unlike a half-space. `slide`: the surface at the contact is dragged along."""
    # contact radius a: the ball's height there meets the skirt's, a / BALL * DECAY / 2 (slope of a Gaussian's flank)
    a = np.sqrt((DECAY / 2) ** 2 + 2 * BALL * depth) - DECAY / 2 if depth > 0 else 0.0

    def displace(at_x: np.ndarray, at_y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r = np.hypot(at_x - x, at_y - y)
        beside = np.exp(-2 * np.maximum(r - a, 0.0) / DECAY)
        height = np.where(r < a, depth - r**2 / (2 * BALL), a / BALL * DECAY / 2 * beside) if depth > 0 else 0 * r
        drag = np.exp(-((r / 3e-3) ** 2))
        return slide[0] * drag, slide[1] * drag, -height

    return make_surface(displace, size=(15.5e-3, 12.5e-3), spacing=0.25e-3)


def hidden(markers: Markers | None = None) -> SensorModel:
    """The sensor that is calibrated: Phong's light, of which the calibration knows nothing."""
    return SensorModel(geometry=SensorGeometry(width=240, height=190, pixel_pitch=PITCH), markers=markers, texture=0.0)


def calibrate(folder: Path, sensor: SensorModel, *options: str, presses: int = 6, slide: float = 0.0) -> Path:
    """A bundle of rendered presses of a ball, by the command line, as `sensors/finger` in `folder`; `slide` [m]: how
    far each drags the gel along, one in this and another in that direction."""
    render, rng = Renderer(sensor, GEL), np.random.default_rng(0)
    frames = folder / "frames"
    frames.mkdir()

    def photograph(name: str, surface: GelSurface) -> None:
        picture = render(surface) + rng.normal(0, 1.0, (190, 240, 3))
        Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8)).save(frames / name)

    photograph("background.png", dent(0.0, 0.0, 0.0))
    photograph("background_2.png", dent(0.0, 0.0, 0.0))
    for number, ((x, y), depth) in enumerate(zip(PLACES[:presses], DEPTHS, strict=False)):
        photograph(f"press_{number}.png", dent(depth, x, y, (slide * np.cos(number), slide * np.sin(number))))
    sensors = folder / "sensors"
    sensors.mkdir()
    done = tacsim(
        *("calibrate", "sensor", str(frames), "--ball-radius", f"{BALL * 1e3} mm", "--serial", "gs-7"),
        *("--pixel-pitch", f"{PITCH * 1e3} mm", "--out", str(sensors / "finger"), *options),
    )
    assert done.exit_code in (0, 4), done.output  # nothing need check its lengths
    return sensors / "finger"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    calibrate(folder, hidden())
    return folder


@pytest.fixture
def finger(lab: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The bundle; the current folder is the one where it goes by its name."""
    monkeypatch.chdir(lab)
    return lab / "sensors" / "finger"


def finds(bundle: Path) -> tuple[Callable[[GelSurface], np.ndarray], FrameNormaliser]:
    """What renders with a bundle, and what finds surfaces in its pictures by the same bundle, its reference taken."""
    calibration, untouched = read_bundle(bundle)
    normalise = normaliser_for_calibration(calibration, GRID, untouched)
    render = Renderer(read_sensor_model(bundle), GEL)
    normalise.take_reference(TactileFrame(render(dent(0.0, 0.0, 0.0)), time=0.0, index=0))
    return render, normalise


@pytest.mark.slow
def test_heights_in_simulated_images_equal_rendered_heights(finger: Path) -> None:
    """Heights found in the twin's pictures are those that it rendered, in places and depths that no press had. The
    bounds are those of the calibration itself: 3.0 to 3.6 % of the depth, root mean square in contact, and 4 % at its
    deepest, were measured."""
    render, normalise = finds(finger)
    dents = [(0.45e-3, -1.5e-3, 1e-3), (0.55e-3, 2.2e-3, -0.8e-3), (0.3e-3, 3e-3, 3e-3)]
    for number, (depth, x, y) in enumerate(dents, start=1):
        surface = dent(depth, x, y)
        found = normalise(TactileFrame(render(surface), time=0.1, index=number), now=0.1)
        true = surface_map(surface, GRID, None)
        assert found.height is not None and found.gradient is not None
        pressed = found.valid & (true.height > 0.3 * depth)
        assert np.sqrt(((found.height - true.height)[pressed] ** 2).mean()) < 0.05 * depth
        assert found.height.max() == pytest.approx(true.height.max(), rel=0.06)
        assert np.abs(found.gradient - true.gradient)[pressed].mean() < 0.01  # of slopes up to 0.5


def test_calibrated_simulation_image_matches_sensor(finger: Path) -> None:
    """On a dent that the calibration has not seen: 1.5 grey levels off in contact, where it changes by 23."""
    twin, sensor = Renderer(load_sensor("finger"), GEL), Renderer(hidden(), GEL)
    surface, flat = dent(0.5e-3, 1.5e-3, 1e-3), dent(0.0, 0.0, 0.0)
    seen, wanted, untouched = (each.astype(float) for each in (twin(surface), sensor(surface), sensor(flat)))
    touched = np.abs(wanted - untouched).max(axis=2) > 8
    assert np.abs(seen - wanted)[touched].mean() < 2.0
    assert np.abs(wanted - untouched)[touched].mean() > 20.0


@pytest.mark.parametrize("said", ["finger", "sensors/finger", "sensors/finger/calibration.yaml", "mine.yaml"])
def test_sensor_name_and_paths_load_same_model(finger: Path, lab: Path, said: str) -> None:
    (lab / "mine.yaml").write_text("extends: finger\n", encoding="utf-8")
    model = load_sensor(said)
    assert model == read_sensor_model(finger) == read_sensor_model(Path("finger"))
    assert model.name == "gs-7" and model.photometric is not None and model.noise is not None
    assert model.lighting.background == str(finger / "reference.png")
    in_rig = load_rig("sim", overrides=[f"sensors.lower.model={said}"]).config.sensors["lower"]
    assert in_rig.model == model  # type: ignore[union-attr]


def test_sensor_name_with_space_is_loaded(finger: Path, lab: Path) -> None:
    (lab / "sensors" / "my finger").symlink_to(finger)
    try:
        assert load_sensor("my finger") == load_sensor("finger")
        assert read_bundle(Path("my finger"))[0].serial == "gs-7"
    finally:
        (lab / "sensors" / "my finger").unlink()


def test_rig_file_finds_sensors_in_its_folder(finger: Path, lab: Path, tmp_path: Path, monkeypatch) -> None:
    rig = lab / "rig.yaml"
    rig.write_text("extends: sim\nsensors: {upper: {driver: sim, arm: upper, model: finger}}\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load_rig(rig).config.sensors["upper"].model.name == "gs-7"  # type: ignore[union-attr]
    with pytest.raises(ConfigError, match="no sensor 'finger'"):
        load_rig("sim", overrides=["sensors.lower.model=finger"])  # what is typed starts from the current folder
    replay = lab / "replay.yaml"
    replay.write_text("extends: replay\nsensors: {finger: {calibration: finger}}\n", encoding="utf-8")
    assert load_rig(replay).config.sensors["finger"].calibration == str(finger)  # type: ignore[union-attr]


def test_unknown_sensor_model_is_refused_with_hint(finger: Path, lab: Path) -> None:
    def refused(said: str) -> str:
        with pytest.raises(ConfigError) as error:
            load_rig("sim", overrides=[f"sensors.lower.model={said}"])
        return str(error.value)

    assert "did you mean 'finger'?" in refused("fingr")
    assert "did you mean 'sensors/finger'?" in refused("sensors/fnger")
    assert "'frames' is a folder without calibration.yaml" in refused("frames")
    (lab / "sensors" / "digit.yaml").write_text("extends: ideal\n", encoding="utf-8")
    assert "'digit' may be" in refused("digit") and "write the path" in refused("digit")
    assert load_sensor("sensors/digit.yaml").name == "ideal"


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda text: text[: len(text) // 2], "is damaged|was changed"),
        (
            lambda text: re.sub(r"format: \d", "format: 9", text),
            "has format 9, this version of tacsim reads 8",
        ),
        (lambda text: text.replace("serial: gs-7", "serial: gs-8"), "was changed since it was written"),
        (lambda text: "", "names no format"),
    ],
    ids=["half", "newer", "changed", "empty"],
)
def test_incomplete_bundle_is_refused(finger: Path, tmp_path: Path, spoil, words: str) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "reference.png").write_bytes((finger / "reference.png").read_bytes())
    text = (finger / "calibration.yaml").read_text(encoding="utf-8")
    (broken / "calibration.yaml").write_text(spoil(text), encoding="utf-8")
    with pytest.raises(ConfigError, match=words) as said:
        load_sensor(broken)
    assert r"\n" not in str(said.value)
    (broken / "calibration.yaml").write_text(text, encoding="utf-8")
    (broken / "reference.png").unlink()
    with pytest.raises(ConfigError, match=r"reference\.png is not there") as missing:
        load_sensor(broken)
    assert "did you mean" not in str(missing.value)


def test_gel_has_sensor_size_in_whole_elements(finger: Path) -> None:
    loaded = load_rig("sim", overrides=["sensors.lower.model=finger"])
    scene = loaded.config.scene
    assert scene is not None and scene.gel.size == pytest.approx((16e-3, 12e-3, 4e-3))  # 15.6 x 12.35 mm
    assert loaded.config.task is not None and loaded.config.task.scene == scene
    (note,) = loaded.notes
    assert "gel 16 x 12 mm in whole elements of 1 mm" in note and "15.6 x 12.35 mm by the model of gs-7" in note
    fine = load_rig("sim", overrides=["sensors.lower.model=finger", "scene.preset=standard"]).config.scene
    assert fine is not None and fine.gel.size == pytest.approx((15.5e-3, 12.5e-3, 4e-3))
    said = load_rig("sim", overrides=["sensors.lower.model=finger", "scene.gel.size=[20 mm, 20 mm, 4 mm]"])
    assert said.config.scene is not None and said.config.scene.gel.size == (20e-3, 20e-3, 4e-3)
    assert "as given on the command line" in said.notes[0]
    assert not load_rig("sim").notes


@pytest.mark.slow
def test_untrusted_calibration_is_reported_everywhere(finger: Path) -> None:
    calibration, untouched = read_bundle(finger)
    assert not read_sensor_model(finger).caution
    origin = calibration.provenance.model_copy(update={"warnings": ("verdict: do not trust; 2 presses",)})
    doubted = finger.with_name("doubted")
    doubted.mkdir(exist_ok=True)
    write_bundle(doubted, calibration.model_copy(update={"provenance": origin}), untouched)
    for more in ([], ["scene.gel.size=[20 mm, 20 mm, 4 mm]"]):
        notes = load_rig("sim", overrides=["sensors.lower.model=doubted", *more]).notes
        assert notes[-1] == "sensor lower: gs-7: verdict: do not trust; 2 presses"
    pressed = ("press", "sphere", "--preset", "learn", "--radius", "4 mm", "--depth", "0.4 mm")
    done = tacsim(*pressed, "--sensor", "doubted", "--out", finger.parent / "pressed")
    assert done.exit_code == 0 and "do not trust; 2 presses" in " ".join(done.output.split())


def test_recorded_rig_file_loads_same_rig(finger: Path, tmp_path: Path) -> None:
    for more in ([], ["scene.gel.size=[20 mm, 20 mm, 4 mm]"]):
        loaded = load_rig("sim", overrides=["sensors.lower.model=finger", *more])
        (tmp_path / "recorded.yaml").write_text(loaded.text, encoding="utf-8")
        assert load_rig(tmp_path / "recorded.yaml").config == loaded.config


def test_press_with_bundle_uses_its_image_and_gel(finger: Path, tmp_path: Path) -> None:
    small = ("--preset", "learn", "--radius", "4 mm", "--depth", "0.4 mm")
    done = tacsim("press", "sphere", *small, "--sensor", "finger", "--out", tmp_path / "pressed")
    assert done.exit_code == 0, done.output
    assert "gel 16 x 12 mm in whole elements of 2 mm" in done.output
    picture = np.asarray(Image.open(tmp_path / "pressed" / "rgb.png")).astype(int)
    untouched = np.asarray(Image.open(finger / "reference.png")).astype(int)
    assert picture.shape == untouched.shape == (190, 240, 3)
    assert np.abs(picture - untouched)[:10].max() <= 6 and np.abs(picture - untouched)[85:105].max() > 15


def test_bundle_works_in_rig_and_environment(finger: Path) -> None:
    from robot.open import make_env, open_rig
    from tacsim.config import load_rig as load

    overrides = ["sensors.lower.model=finger", *TINY[1::2]]
    with open_rig(load("sim", overrides=overrides)) as rig:
        observation = rig.reset(0)
        assert rig.spec.sensors["lower"].image_shape == (190, 240)
        touch = observation.tactile["lower"]
        assert touch.valid.sum() == 62 * 48 and (touch.image[~touch.valid.repeat(2, 0).repeat(2, 1)] == 128).all()
    env = make_env("squeeze", overrides=overrides, features=None)
    first, _ = env.reset(seed=0)
    np.testing.assert_array_equal(first["valid_lower"], touch.valid)
    env.close()


TURN, SHIFT = np.radians(3.0), (0.3e-3, -0.2e-3)  # of the dots, against the picture's axes and its middle


def crooked() -> Markers:
    """A lattice of dots that is neither straight nor in the middle, as printed ones are."""
    x, y = np.meshgrid((np.arange(7) - 3) * 1.9e-3, (np.arange(5) - 2) * 1.9e-3)
    places = np.stack([x * np.cos(TURN) - y * np.sin(TURN), x * np.sin(TURN) + y * np.cos(TURN)], axis=-1) + SHIFT
    return Markers(rows=5, columns=7, pitch=1.9e-3, radius=0.22e-3, places=places.tolist())


@pytest.fixture(scope="module")
def dotted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return calibrate(tmp_path_factory.mktemp("dotted"), hidden(crooked()), "--markers", presses=3)


@pytest.mark.slow
def test_bundle_dots_are_at_printed_positions(dotted: Path) -> None:
    markers = load_sensor(dotted).markers
    assert markers is not None and markers.in_background and markers.places is not None
    assert np.abs(np.array(markers.places) - np.array(crooked().places)).max() < 0.1 * PITCH
    untouched = np.asarray(Image.open(dotted / "reference.png"))
    np.testing.assert_array_equal(Renderer(load_sensor(dotted), GEL)(dent(0.0, 0.0, 0.0)), untouched)


def test_bundle_dots_move_with_gel(dotted: Path) -> None:
    """As the hidden sensor's do: the flow found in the twin's pictures is that of the surface to a tenth of a pixel
    (root mean square), and no dot stays behind."""
    render, normalise = finds(dotted)
    markers, sensor = load_sensor(dotted).markers, Renderer(hidden(crooked()), GEL)
    assert markers is not None
    for number, slide in enumerate([(0.2e-3, -0.1e-3), (0.4e-3, -0.25e-3), (0.55e-3, -0.4e-3)], start=1):
        surface = dent(0.35e-3, 0.4e-3, -0.3e-3, slide)
        seen = normalise(TactileFrame(render(surface), time=0.1, index=number), now=0.1)
        true = surface_map(surface, GRID, markers)
        assert seen.flow is not None and true.flow is not None and seen.height is not None
        assert normalise.visible_marker_share == 1.0 and np.abs(true.flow).max() > 0.8 * max(slide)
        assert np.sqrt(((seen.flow - true.flow) ** 2).mean()) < 0.1 * PITCH
        assert seen.height.max() == pytest.approx(true.height.max(), rel=0.1)
        assert np.abs(render(surface).astype(float) - sensor(surface)).mean() < 1.5  # a dot is 80 grey levels dark


@pytest.mark.slow
def test_bundle_skin_moves_with_gel(tmp_path: Path) -> None:
    """Grain that presses have dragged along is found to be skin, and the twin's is dragged as the sensor's own."""
    light = np.array([110.0, 105.0, 100.0]) + np.random.default_rng(1).normal(0, 5, (190, 240, 1))
    Image.fromarray(np.rint(light).astype(np.uint8)).save(tmp_path / "gel.png")
    grainy = hidden().model_copy(update={"lighting": Lighting(background=str(tmp_path / "gel.png")), "skin": 1.0})
    bundle = calibrate(tmp_path, grainy, slide=0.4e-3)
    model = load_sensor(bundle)
    assert 0.5 < model.skin <= 1.0
    surface = dent(0.4e-3, 0.3e-3, -0.2e-3, (0.3e-3, -0.25e-3))
    real, still = Renderer(grainy, GEL)(surface), model.model_copy(update={"skin": 0.0})
    off, left = (
        np.abs(Renderer(each, GEL)(surface).astype(float) - real)[60:130, 80:160].mean() for each in (model, still)
    )
    assert off < 0.6 * left


def test_oblique_camera_simulation_delivers_native_image(finger: Path, tmp_path: Path) -> None:
    """Through a view: what the normaliser finds in the camera's own picture is what it finds in the metric one."""
    calibration, untouched = read_bundle(finger)
    corners = ((35.0, 25.0), (295.0, 18.0), (285.0, 222.0), (28.0, 228.0))
    view = view_of_corners(corners, calibration.gel_size, (240, 320)).model_copy(update={"pixel_pitch": PITCH})
    write_bundle(tmp_path, calibration.model_copy(update={"view": view}), untouched)
    model = read_sensor_model(tmp_path)
    assert model.image_shape == (240, 320) and model.view == view
    straight, askew = finds(finger), finds(tmp_path)
    surface = dent(0.5e-3, 2e-3, -1e-3)
    picture = askew[0](surface)
    assert picture.shape == (240, 320, 3) and not picture[:10].any()  # black beside the gel
    metric, native = (
        normalise(TactileFrame(render(surface), time=0.1, index=1), now=0.1) for render, normalise in (straight, askew)
    )
    assert metric.height is not None and native.height is not None
    both = metric.valid & native.valid
    assert both.sum() > 0.95 * metric.valid.sum()
    assert np.abs(metric.height - native.height)[both].max() < 0.03 * 0.5e-3
    by_model = normaliser_for_simulation(model, GEL, GRID)
    by_model.take_reference(TactileFrame(askew[0](dent(0.0, 0.0, 0.0)), time=0.0, index=0))
    seen = by_model(TactileFrame(picture, time=0.1, index=1, surface=surface_map(surface, GRID, None)), now=0.1)
    assert np.abs(seen.image.astype(int) - metric.image).mean() < 1.0


def test_mock_camera_with_calibration_shows_simulated_image(finger: Path) -> None:
    """One line more than the real camera's entry: the same driver finds heights in the twin's pictures."""
    upper = ["model=null", "calibration=finger", "width=240", "height=190"]
    loaded = load_rig("mock", overrides=[f"sensors.upper.{each}" for each in upper])
    assert loaded.config.scene is not None and loaded.config.scene.gel.size[:2] == pytest.approx((16e-3, 12e-3))
    assert _sensor_models(loaded.config)["upper"] == read_sensor_model(finger)
    camera = loaded.config.sensors["upper"]
    assert isinstance(camera, CameraSensorConfig)
    assert normaliser_for_camera(camera, loaded.config.scene.gel.size[:2], GRID).finds_height
    direct = camera.model_copy(update={"model": read_sensor_model(finger), "calibration": None})
    assert normaliser_for_camera(direct, loaded.config.scene.gel.size[:2], GRID).finds_height  # by the inverted light
