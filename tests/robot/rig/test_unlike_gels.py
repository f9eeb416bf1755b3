"""Two sensors of different kinds on one rig, each with a gel of its own: opened, run, recorded, replayed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robot.mock.cell.hertz import HertzCell
from robot.mock.cell.sim_server import SimServer
from robot.open import open_rig
from robot.rig.recorded import observe_episode
from robot.rig.replay_rig import recorded_rig
from robot.studies.dump_view import draw, open_world, table
from robot.studies.identify.simulation import coarser
from tacsim.config import load_rig, load_scene
from tacsim.interface import Action, Pose
from tacsim.models.sensor import SensorModel
from tacsim.physics.failure.dump import read_dump
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.world import make_world
from tests.robot.cli.invoked import tacsim

RIG = """
name: two-kinds
clock: sim
task: {kind: squeeze, goal: 3.6 mm, touch_force: 0.02 N, scene: {
  preset: learn, body: {geometry: {shape: box, size: [4 mm, 4 mm, 4 mm]}},
  gels: {upper: {size: [20 mm, 20 mm, 2 mm], element_size: 1 mm, material: {youngs_modulus: 0.3 MPa}}}}}
arms:
  lower: {driver: sim}
  upper: {driver: sim}
sensors:
  lower:
    driver: sim
    arm: lower
    model: {extends: gelsight-mini, gel_size: [20.3 mm, 15.2 mm], gel_thickness: null,
            geometry: {width: 80, height: 60, pixel_pitch: 0.3 mm}}
  upper:
    driver: sim
    arm: upper
    model: {extends: digit, gel_size: [18.8 mm, 25 mm], gel_thickness: null,
            geometry: {width: 60, height: 80, pixel_pitch: 0.35 mm}}
canonical: {rows: 32, columns: 32, pitch: 1 mm, image_scale: 1}
"""


@pytest.fixture
def rig_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "two.yaml").write_text(RIG, encoding="utf-8")
    return tmp_path / "two.yaml"


def extent(valid: np.ndarray) -> tuple[int, int]:
    """Columns and rows of the canonical grid, of 1 mm, that lie on the gel."""
    return int(valid.any(axis=0).sum()), int(valid.any(axis=1).sum())


@pytest.mark.slow
def test_rig_with_two_gel_types_runs_records_and_replays(rig_file: Path) -> None:
    done = tacsim("run", rig_file, "--steps", "3", "--out", rig_file.parent / "run")
    assert done.exit_code == 0, done.output
    (episode,) = (rig_file.parent / "run").glob("*.mcap")
    recorded = recorded_rig(episode)
    assert recorded is not None and recorded == load_rig(rig_file).config
    assert recorded.scene is not None
    assert recorded.scene.gel_of("lower").size == pytest.approx((20e-3, 16e-3, 4e-3))  # elements of 2 mm
    assert recorded.scene.gel_of("upper").size == pytest.approx((19e-3, 25e-3, 2e-3))
    with open_rig(rig_file) as rig:
        first = rig.reset(0)
        pressed, _ = rig.step(Action({"upper": moved(first.arms["upper"].pose, -0.2e-3)}))
    assert extent(pressed.tactile["lower"].valid) == (20, 16) and extent(pressed.tactile["upper"].valid) == (20, 26)
    forces = [float(pressed.arms[name].wrench[2]) for name in ("lower", "upper")]
    assert max(forces) < -0.02 and forces[0] == pytest.approx(forces[1], rel=0.05)
    steps = list(observe_episode(episode).steps())
    assert len(steps) == 4
    for name in ("lower", "upper"):
        np.testing.assert_array_equal(steps[0][1].tactile[name].image, first.tactile[name].image)
        np.testing.assert_array_equal(steps[0][1].tactile[name].valid, first.tactile[name].valid)
    again = tacsim(
        "run", "replay", "--steps", "2", "--out", rig_file.parent / "again", "--set", "arms={}", "--set",
        f"sensors={{upper: {{driver: replay, source: {episode}}}, lower: {{driver: replay, source: {episode}}}}}",
        "--set", "canonical={rows: 32, columns: 32, pitch: 1 mm, image_scale: 1}",
    )  # fmt: skip
    assert again.exit_code == 0, again.output


def moved(pose: Pose, z: float) -> Pose:
    return Pose(pose.position + [0.0, 0.0, z], pose.quaternion)


@pytest.mark.slow
def test_mock_cell_process_has_both_gels(rig_file: Path) -> None:
    config = load_rig(rig_file).config
    models: dict[str, SensorModel] = {name: sensor.model for name, sensor in config.sensors.items()}  # type: ignore[union-attr, misc]
    assert config.scene is not None
    with SimServer(config.scene, models, config.canonical) as server:
        frame = server.move({"upper": moved(server.initial["upper"], -0.4e-3)})
    assert {name: frame.images[name].shape[:2] for name in models} == {"lower": (60, 80), "upper": (80, 60)}
    ball = HertzCell(config.scene, models, config.canonical)
    ball.move({name: moved(pose, 0.4e-3 if name == "lower" else -0.4e-3) for name, pose in ball.poses().items()})
    soft, stiff = (-float(ball.wrench(name)[2]) for name in ("lower", "upper"))
    assert stiff / soft == pytest.approx(0.3 / 0.145, rel=1e-6)
    with pytest.raises(ValueError, match="its gel is 2 mm thick"):
        ball.move({"upper": moved(ball.poses()["upper"], -2e-3)})


@pytest.mark.slow
def test_dump_contains_both_gels(rig_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TACSIM_DUMPS", str(rig_file.parent / "dumps"))
    scene = load_rig(rig_file).config.scene
    assert scene is not None
    world = make_world(scene)
    broken = dict(world.snapshot())
    broken["gel_velocity_upper"] = np.full_like(broken["gel_velocity_upper"], np.nan)
    broken["gel_displacement_lower"] = np.full_like(broken["gel_displacement_lower"], 0.1)
    world.restore(broken)
    with pytest.raises(SimulationDiverged):
        world.move({})
    dump = read_dump(rig_file.parent / "dumps" / "00")
    found = table(dump)
    assert found["gel_velocity_upper"]["before"].startswith("none  (")
    assert found["gel_velocity_lower"]["before"] == "0 to 0"
    assert found["volume ratio, gel elements"]["before"] == "1 to 1"
    np.testing.assert_array_equal(
        open_world(dump).snapshot()["gel_displacement_lower"], broken["gel_displacement_lower"]
    )
    draw(dump, rig_file.parent / "dump.png")
    assert (rig_file.parent / "dump.png").stat().st_size > 10_000


def test_identification_coarsens_both_gel_meshes() -> None:
    gels = "gels={upper: {size: [20 mm, 20 mm, 2 mm], element_size: 0.25 mm}, lower: {material: {density: 900}}}"
    scene = coarser(load_scene("squeeze", [gels, "preset=standard"]))
    assert (scene.element_size_of("lower"), scene.element_size_of("upper")) == (1e-3, 0.5e-3)
    assert coarser(coarser(scene)).element_size_of("upper") == 1e-3  # two layers
