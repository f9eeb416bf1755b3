"""The simulator presses what frames show: the whole way, on a made-up sensor whose truth is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from calibration.bundle import write_bundle
from calibration.compare.compare import compare_frames
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet
from calibration.light.dent import Circle, dent_slope, find_contact_circle
from robot.studies import matched_press
from robot.studies.matched_press import ELEMENT, _next_depth, _PressedGel, match_presses
from tacsim.config import load_scene
from tacsim.interface import Image, Pose
from tacsim.models.scene import Scene
from tacsim.models.sensor import CameraNoise, CanonicalGrid, SensorGeometry, SensorModel
from tacsim.optics.spline import displacement_and_jacobian
from tacsim.physics.failure.health import LaunchSpan, SimulationDiverged
from tacsim.physics.world import make_world
from tests.calibration.presses import DarkSensor, HiddenSensor
from tests.calibration.sources import calibrated, save
from tests.robot.cli.invoked import tacsim

SCENE = ("indenter.geometry.radius=2.5 mm", "gel.size=[12 mm, 12 mm, 8 mm]", "element_size=0.5 mm")
DEPTHS, PLACES = (0.5e-3, 0.65e-3), ((90, 110), (170, 80))


@pytest.fixture
def frames() -> FrameSet:
    """Two presses by Hertz, and one frame without contact."""
    sensor = HiddenSensor(3)
    made = [sensor.press(depth, *place) for depth, place in zip(DEPTHS, PLACES, strict=True)]
    frames = [Frame(f"press_{k}.png", press.image) for k, press in enumerate(made)]
    return FrameSet("real", sensor.empty(), "made up", (*frames, Frame("still.png", sensor.empty())))


@pytest.mark.slow
def test_a_scene_against_frames(frames: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save(frames, Path("real"))
    calibration, reference = calibrated(HiddenSensor(3))
    Path("bundle").mkdir()
    write_bundle(Path("bundle"), calibration, reference)
    words = ["compare", "press", "real", "--calibration-b", "bundle", "--out", "out"]
    for setting in SCENE:
        words += ["--set", setting]
    result = tacsim(*words)
    assert result.exit_code == 0, result.output
    assert "still.png: not pressed: no ball's contact is seen" in " ".join(result.output.split())
    config = json.loads(Path("out/compare.json").read_text())
    overall = config["overall"]
    assert overall["contact_ncc"]["mean"] > 0.95
    assert overall["contact_mae"]["mean"] < 0.35 * overall["contact_mae"]["null"]
    assert overall["gradient_angle"]["mean"] < 4
    assert overall["surface_centroid"]["mean"] < 0.15e-3
    assert [pair["a"] for pair in config["pairs"]] == ["press_0.png", "press_1.png", "still.png"]
    assert config["pairs"][2]["flags"] == ["simulated: no contact", "real: no contact"]


@pytest.mark.slow
def test_presses_under_a_light_that_tells_no_direction_are_found_by_their_darkness(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A dent's slopes explain nothing there: its depth makes it dark."""
    monkeypatch.chdir(tmp_path)
    sensor = DarkSensor(3, 0.4)
    press = Frame("press.png", sensor.press(DEPTHS[1], *PLACES[0]).image)
    real = FrameSet("real", sensor.empty(), "made up", (press, Frame("still.png", sensor.empty())))
    save(real, Path("real"))
    calibration, reference = calibrated(sensor)
    Path("bundle").mkdir()
    write_bundle(Path("bundle"), calibration, reference)
    words = [word for setting in SCENE for word in ("--set", setting)]
    result = tacsim("compare", "press", "real", "--calibration-b", "bundle", "--out", "out", *words)
    assert result.exit_code == 0, result.output
    said = " ".join(result.output.split())
    assert "still.png: not pressed: no ball's contact is seen" in said and " press.png: not pressed" not in said
    overall = json.loads(Path("out/compare.json").read_text())["overall"]
    assert overall["contact_ncc"]["mean"] > 0.95
    assert overall["contact_mae"]["mean"] < 0.35 * overall["contact_mae"]["null"]
    assert overall["surface_centroid"]["mean"] < 0.15e-3


@pytest.mark.slow
def test_ball_and_gel_are_those_of_the_bundle_unless_given(frames: FrameSet, tmp_path: Path, monkeypatch) -> None:
    """The calibration knows the ball of its presses, and how much gel its pictures show: 20.8 x 16 mm. A smaller gel
    would carry the motion of its border on to the picture's. The thickness nobody knows."""
    asked: list[Scene] = []

    def stop(real: FrameSet, scene: Scene, *more: object) -> None:
        asked.append(scene)
        raise BadFrames("enough")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(matched_press, "match_presses", stop)
    save(frames, Path("real"))
    calibration, reference = calibrated(HiddenSensor(3))
    Path("bundle").mkdir()
    write_bundle(Path("bundle"), calibration, reference)
    ball = calibration.provenance.ball_radius
    for number, (settings, size, radius, element) in enumerate(
        [
            ((), (20.75e-3, 16e-3, 4e-3), ball, ELEMENT),
            (("preset=standard",), (21e-3, 16e-3, 4e-3), ball, 0.5e-3),
            (("element_size=1 mm",), (21e-3, 16e-3, 4e-3), ball, 1e-3),
            (("indenter.geometry.radius=3 mm",), (20.75e-3, 16e-3, 4e-3), 3e-3, ELEMENT),
            (("gel.size=[12 mm, 12 mm, 8 mm]",), (12e-3, 12e-3, 8e-3), ball, ELEMENT),
            (("gel.size=[12 mm, 12 mm, 0.4 mm]",), (12e-3, 12e-3, 0.4e-3), ball, 0.2e-3),
        ]
    ):
        words = [word for setting in settings for word in ("--set", setting)]
        result = tacsim("compare", "press", "real", "--calibration-b", "bundle", "--out", f"out{number}", *words)
        assert "enough" in result.output
        assert asked[-1].gel.size == pytest.approx(size)
        assert asked[-1].indenter.geometry.radius == pytest.approx(radius)
        assert asked[-1].effective_element_size == pytest.approx(element)
        assert f"a ball of {radius * 1e3:.4g} mm radius" in result.output and "gel" in result.output


@pytest.mark.parametrize(("element", "near"), [(ELEMENT, True), (0.5e-3, False)])
def test_elements_are_fine_enough_for_the_skirt(element: float, near: bool) -> None:
    """A light is calibrated on the elastic layer's skirt, so a simulated press must have it, too: elements of half a
    millimetre round the rim, and put a tenth of its slope beside the contact."""
    ball, depth, size = 2.5e-3, 0.4e-3, (10e-3, 10e-3, 5e-3)
    settings = [SCENE[0], f"gel.size={[f'{1e3 * side} mm' for side in size]}", f"element_size={element} m"]
    world = make_world(load_scene("press", settings))
    pose = world.pose("indenter")
    world.move({"indenter": Pose(np.array([*pose.position[:2], ball - depth]), pose.quaternion)})
    at = np.linspace(0.02e-3, 4e-3, 400)
    radii = np.linspace(0.1e-3, 3e-3, 300)
    profiles = []  # of the surface where it has moved to, in directions between those of the mesh
    for angle in np.arange(24) * np.pi / 12 + 0.07:
        along = np.array([np.cos(angle), np.sin(angle)])
        moved, _ = displacement_and_jacobian(world.surface("lower"), at[:, None] * along)
        profiles.append(np.interp(radii, at + moved[:, :2] @ along, moved[:, 2]))
    slope = np.gradient(np.mean(profiles, axis=0), radii)
    contact = minimize_scalar(
        lambda a: ((slope - dent_slope(radii, a, ball, size[2])) ** 2).sum(), bounds=(0.6e-3, 1.6e-3), method="bounded"
    ).x
    off = slope - dent_slope(radii, contact, ball, size[2])
    skirt = (radii > 1.2 * contact) & (radii < 1.6 * contact)
    rim = contact / np.sqrt(ball**2 - contact**2)
    assert (np.abs(off[skirt]).max() < 0.05 * rim) == near


def test_what_cannot_be_pressed_is_refused(frames: FrameSet) -> None:
    scene = load_scene("press", list(SCENE))
    sensor = SensorModel(geometry=SensorGeometry(width=260, height=200, pixel_pitch=0.08e-3))
    box = load_scene("press", ["indenter.geometry={shape: box, size: [5 mm, 5 mm, 5 mm]}"])
    with pytest.raises(BadFrames, match="'press' presses no ball"):
        match_presses(frames, box, sensor, CanonicalGrid())
    smaller = SensorModel(geometry=SensorGeometry(width=200, height=200, pixel_pitch=0.08e-3))
    with pytest.raises(BadFrames, match="real is 260 x 200 px, the calibration is of 200 x 200"):
        match_presses(frames, scene, smaller, CanonicalGrid())
    still = replace(frames, frames=(Frame("still.png", np.array(frames.reference)),))
    with pytest.raises(BadFrames, match="no frame shows a ball's contact"):
        match_presses(still, scene, sensor, CanonicalGrid())


def scene_of(thickness: str) -> Scene:
    return load_scene("press", [*SCENE[:1], f"gel.size=[12 mm, 12 mm, {thickness}]", "element_size=0.5 mm"])


def sensor_of() -> SensorModel:
    return SensorModel(geometry=SensorGeometry(width=260, height=200, pixel_pitch=0.08e-3))


def test_a_press_that_diverges_is_reported_and_the_others_go_on(
    frames: FrameSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press_to(self: _PressedGel, depth: float) -> bool:
        if depth > 0.58e-3:
            raise SimulationDiverged("a gel node moves at 0.535 of the wave speed", LaunchSpan("in a test"))
        return original(self, depth)

    original = _PressedGel._press_to
    monkeypatch.setattr(_PressedGel, "_press_to", press_to)
    made, notes = match_presses(frames, scene_of("8 mm"), sensor_of(), CanonicalGrid())
    assert [frame.name for frame in made.frames] == ["press_0.png", "still.png"]
    assert any("press_1.png: not pressed: " in words and "wave speed" in words for words in notes)
    result = compare_frames(replace(made, notes=tuple(notes)), frames)
    assert [pair.b.name for pair in result.pairs] == ["press_0.png", "still.png"]
    assert any("press_1.png: not pressed" in words for words in result.notes)


def test_both_contacts_are_in_one_place_however_light_pulls_a_circle(
    frames: FrameSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    pull = np.array([2.0, -3.0])  # [px]

    def pulled(image: Image, reference: Image, ball: float) -> Circle:
        circle = find_contact_circle(image, reference, ball)
        return replace(circle, x=circle.x + pull[0], y=circle.y + pull[1])

    monkeypatch.setattr(matched_press, "find_contact_circle", pulled)
    sensor, grid = sensor_of(), CanonicalGrid()
    made, _ = match_presses(frames, scene_of("8 mm"), sensor, grid)
    for frame, place in zip(made.frames[:2], PLACES, strict=True):
        assert frame.surface is not None
        dent = np.where(frame.surface.height > 0.1e-3, frame.surface.height, 0.0)
        rows, columns = np.indices(dent.shape)
        middle = np.array([(dent * columns).sum(), (dent * rows).sum()]) / dent.sum()
        cells = middle - [(grid.columns - 1) / 2, (grid.rows - 1) / 2]
        at = cells * grid.pitch / sensor.geometry.pixel_pitch + sensor.geometry.principal
        assert at == pytest.approx(place, abs=0.5)


def test_a_contact_that_the_gel_is_too_thin_for_is_refused_beforehand(frames: FrameSet) -> None:
    """The cap of a ball of 2.5 mm with a rim of 1.94 mm is 0.92 mm high, and elements of a gel of 1 mm are crushed at
    0.75 mm; a contact of 1.12 mm is possible there."""
    sensor = HiddenSensor(3)
    deep = Frame("deep.png", sensor.press(1.5e-3, 130, 100).image)
    both = replace(frames, frames=(deep, frames.frames[0]))
    made, notes = match_presses(both, scene_of("1 mm"), sensor_of(), CanonicalGrid())
    assert [frame.name for frame in made.frames] == ["press_0.png"]
    assert any(
        words.startswith("deep.png: not pressed: a contact of 1.") and "can be pressed 0.70 mm" in words
        for words in notes
    )


def test_the_next_depth_follows_the_two_nearest_presses() -> None:
    """A contact that grows as the square root of depth is met at once; one that hardly grows is not overshot."""
    assert _next_depth([(10.0, 1e-3)], 11.0) == pytest.approx(1.21e-3)
    assert _next_depth([(10.0, 1e-3), (11.0, 1.3e-3)], 10.5) == pytest.approx(1e-3 + 0.3e-3 * 10.25 / 21)
    assert _next_depth([(40.0, 2e-3), (40.01, 2.2e-3)], 44.0) == pytest.approx(1.3 * 2.2e-3)
    assert _next_depth([(40.0, 2e-3), (39.9, 2.2e-3)], 44.0) == pytest.approx(1.21 * 2e-3)


@pytest.mark.slow
def test_a_bundle_with_noise_makes_presses_with_noise_and_the_same_again(frames: FrameSet) -> None:
    noise = CameraNoise(deviation=(2.0, 1.5, 1.0))
    quiet = sensor_of()
    grainy = quiet.model_copy(update={"noise": noise})
    noisy, again, clean = (
        match_presses(frames, scene_of("8 mm"), sensor, CanonicalGrid())[0] for sensor in (grainy, grainy, quiet)
    )
    added = [noisy.reference.astype(float) - clean.reference]
    added += [one.image.astype(float) - two.image for one, two in zip(noisy.frames, clean.frames, strict=True)]
    for grain in added:
        assert grain.std(axis=(0, 1)) == pytest.approx((2.0, 1.5, 1.0), rel=0.05)
    assert not np.array_equal(added[0], added[1])
    assert all(np.array_equal(one.image, other.image) for one, other in zip(noisy.frames, again.frames, strict=True))
