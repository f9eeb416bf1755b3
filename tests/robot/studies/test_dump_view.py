"""`tacsim debug`: table, picture and replay of a dump; and that `tacsim run` leaves one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from typer.testing import Result

from robot.studies import dump_view
from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Gel, Indenter, Scene, Settling, Sphere
from tacsim.physics.failure import health
from tacsim.physics.failure.dump import DumpError, dump_to_folder, read_dump
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.world import make_world
from tests.robot.cli.invoked import tacsim

SMALL = Gel(size=(6e-3, 6e-3, 4e-3))
CLAY = BodyMaterial(yield_stress=30e3)
SCENES = {
    "press": Scene(body=None, indenter=Indenter(geometry=Sphere(radius=3e-3)), gel=SMALL, settling=Settling(mach=0.1)),
    "hybrid": Scene(body=Body(geometry=Box(size=(2e-3,) * 3), material=CLAY), gel=SMALL),
    "seed": Scene(physics="seed", body=Body(geometry=Box(size=(2e-3,) * 3), material=CLAY), gel=SMALL),
}


def diverge(scene: Scene, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dump of a motion that breaks a limit, which is lowered where the scheme would not break it by itself."""
    world = make_world(scene)
    frame = "upper" if scene.indenter is None else "indenter"
    pose = world.pose(frame)
    monkeypatch.setattr(health, "MAX_SPEED", 0.005)
    with dump_to_folder(folder), pytest.raises(SimulationDiverged):
        world.move({frame: Pose(pose.position - [0, 0, 0.5e-3], pose.quaternion)})
    return folder / "00"


@pytest.mark.slow
@pytest.mark.parametrize("physics", SCENES)
def test_a_dump_is_shown_drawn_and_replayed(physics: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = diverge(SCENES[physics], tmp_path / "out", monkeypatch)
    result = tacsim("debug", place)
    assert result.exit_code == 1, result.output
    assert "of the wave speed (limit 0.005)" in result.stdout
    assert "diverges again, exactly as recorded, to the last bit" in result.stdout
    assert "before the motion" in result.stdout and "last good" in result.stdout and "failed" in result.stdout
    assert "volume ratio, " in result.stdout
    picture = imread(place / "debug.png")
    assert picture.shape[1] > 1000 and np.ptp(picture[..., :3].mean(axis=2)) > 0.5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]  # the replay wrote no dump
    monkeypatch.undo()
    mended = tacsim("debug", place / "dump.json")
    assert mended.exit_code == 0, mended.output
    assert "does not diverge: reached its targets at the first attempt" in mended.stdout
    assert tacsim("debug", place, "--no-replay").exit_code == 0


@pytest.mark.slow
@pytest.mark.parametrize("physics", SCENES)
def test_a_motion_at_constant_load_is_replayed_with_its_load(
    physics: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = make_world(SCENES[physics])
    loads = {world.sensors[-1]: 0.3}
    monkeypatch.setattr(health, "MAX_SPEED", 1e-4)
    with dump_to_folder(tmp_path), pytest.raises(SimulationDiverged):
        world.move({}, loads)
    dump = read_dump(tmp_path / "00")
    assert dump.info.loads == loads and dump.command.targets == {}
    failure, outcome = dump_view.replay(dump, dump_view.open_world(dump))
    assert failure is not None and outcome == "diverges again, exactly as recorded, to the last bit"


def test_the_table_tells_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dump = read_dump(diverge(SCENES["hybrid"], tmp_path, monkeypatch))
    dump.states["failed"]["velocity"][:3] = np.nan
    dump.states["failed"]["gel_displacement"][...] = 0.0
    gel = dump.states["failed"]["gel_displacement"][0, 2, 2]
    gel[4] = gel[3] - [0.0, 0.0, 1.5]  # the element is 1 mm high
    rows = dump_view.table(dump)
    corners = rows["volume ratio, element corners"]
    assert float(corners["failed"].split()[0]) == pytest.approx(-0.5, abs=1e-3)
    assert "9 not finite" in rows["velocity"]["failed"] and "not finite" not in rows["velocity"]["before"]
    assert float(rows["kernels: overlap"]["failed"]) >= 0
    dump_view.draw(dump, tmp_path / "debug.png")


def test_arrays_of_another_scene_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = diverge(SCENES["hybrid"], tmp_path, monkeypatch)
    info = json.loads((place / "dump.json").read_text())

    def changed(**scene: object) -> Result:
        (place / "dump.json").write_text(json.dumps({**info, "scene": {**info["scene"], **scene}}))
        return tacsim("debug", place)

    for scene in ({"element_size": 2e-3}, {"particle_spacing": 0.4e-3}):
        result = changed(**scene)
        assert result.exit_code == 2 and "is it of this scene?" in result.output
    (place / "dump.json").write_text(json.dumps(info))
    dump = read_dump(place)
    dump.states["before"]["poses"][0, 3:] = 0.0
    with pytest.raises(DumpError, match=r"does not fit .*'lower': Pose\.quaternion"):
        dump_view.open_world(dump)
    dump = read_dump(place)
    dump.states["before"]["rates"][:] = np.inf
    with pytest.raises(DumpError, match="'rates' is not finite"):
        dump_view.open_world(dump)


def test_a_run_that_diverges_leaves_a_dump_and_says_where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(health, "MAX_SPEED", 1e-4)
    tiny = ("--set", "scene.particle_spacing=1 mm", "--set", "scene.element_size=2 mm")
    result = tacsim("run", "sim", "--steps", 2, "--out", "first", *tiny)
    assert result.exit_code == 1
    assert "tacsim debug first/diverged/00" in result.output.replace("\n", "")
    assert (tmp_path / "first" / "diverged" / "00" / "state.npz").is_file()
    assert tacsim("debug", "first/diverged/00").exit_code == 1
    nowhere = tacsim("debug", "first")
    assert nowhere.exit_code == 2 and "is no dump: it has no dump.json" in nowhere.output


@pytest.mark.slow
def test_a_command_that_makes_no_sense_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = diverge(SCENES["press"], tmp_path, monkeypatch)
    info = json.loads((place / "dump.json").read_text())
    for change, said in (
        ({"targets": {"other": [0.0] * 6 + [1.0]}}, "cannot be repeated: no driven frame other"),
        ({"loads": {"other": 1.0}}, "cannot be repeated: no sensor 'other'"),
        ({"loads": {"lower": -1.0}}, "load of 'lower' is -1 N"),
        ({"duration": 1e308}, "duration is 1e+308 s"),
        ({"duration": 1e-3, "flow": True}, "exclude one another"),
    ):
        (place / "dump.json").write_text(json.dumps({**info, **change}))
        result = tacsim("debug", place)
        assert result.exit_code == 2 and said in " ".join(result.output.split()), result.output
