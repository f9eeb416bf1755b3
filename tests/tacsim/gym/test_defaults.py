"""What an environment is without options: what one learns in, and it says how exact that is."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import tacsim.gym.env  # registers
from robot.open import make_env
from tacsim.config import config_root
from tacsim.gym.features import FeatureEncoder, default_features
from tacsim.gym.vector import TacsimVectorEnv
from tacsim.models.scene import PRESET_FORCE_ERROR
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.render import Renderer

ROOT = Path(__file__).parents[3]
FEW_PARTICLES = ("scene.gel.size=[8 mm, 8 mm, 4 mm]", "scene.body.geometry.size=[3 mm, 3 mm, 3 mm]", "task.goal=2 mm")
assert tacsim.gym.env


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Squeeze", "Reposition", "Knead", "Lengthen"])
def test_it_shows_a_few_numbers_of_order_one_and_how_exact_the_forces_are(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered: list[int] = []
    render = Renderer.__call__
    monkeypatch.setattr(Renderer, "__call__", lambda *given: (rendered.append(0), render(*given))[1])
    env = gymnasium.make(f"tacsim/{name}-v0").unwrapped
    seen, info = env.reset(seed=1)
    rendered.clear()  # those of the untouched gels
    largest = 0.0
    for _ in range(3):
        assert seen in env.observation_space
        assert set(seen) == {"maps", "touch", "goal"}
        assert {value.dtype for value in seen.values()} == {np.dtype(np.float32)}
        assert sum(value.size for value in seen.values()) < 600
        largest = max(largest, *(float(np.abs(value).max()) for value in seen.values()))
        assert (info["preset"], info["preset_error"]) == ("learn", "force +3 to +11 %")
        seen, _, _, _, info = env.step(env.action_space.sample())
        assert info["hold"] == 0  # motions flow: nothing is held until it rests
    assert 0.1 < largest < 10.0
    assert not rendered
    assert all(box.high.max() <= 100 for box in env.observation_space.values())
    env.close()


def test_make_vec_moves_them_together() -> None:
    envs = gymnasium.make_vec("tacsim/Squeeze-v0", 2)
    assert isinstance(envs, TacsimVectorEnv)
    seen, info = envs.reset(seed=1)
    assert {key: value.shape for key, value in seen.items()} == {
        "maps": (2, 2, 16, 16),
        "touch": (2, 25),
        "goal": (2, 1),
    }
    assert info["preset"].tolist() == ["learn", "learn"]
    envs.close()


def test_check_env_is_content_without_a_warning() -> None:
    env = gymnasium.make("tacsim/Squeeze-v0", overrides=FEW_PARTICLES).unwrapped
    env.spec = None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)
    env.close()


def test_options_give_back_pictures_rest_and_the_preset_of_the_file() -> None:
    env = make_env("squeeze", overrides=FEW_PARTICLES, learning=False, features=None)
    seen, info = env.reset(seed=1)
    assert {"tactile_upper", "height_upper", "wrench_upper", "pose_upper"} <= set(seen)
    assert (info["preset"], info["preset_error"]) == ("draft", "force +0 to +4 %")
    *_, info = env.step(np.array([1.0, -1.0], np.float32))
    assert info["hold"] > 0
    env.close()


def test_a_value_given_by_an_override_wins() -> None:
    env = make_env("squeeze", overrides=[*FEW_PARTICLES, "scene.preset=draft", "motion=settled"])
    _, info = env.reset(seed=1)
    assert info["preset"] == "draft"
    assert env.step(np.array([1.0, -1.0], np.float32))[4]["hold"] > 0
    env.close()


def test_a_rig_file_of_ones_own_is_taken_as_it_is_written(tmp_path: Path) -> None:
    text = (config_root() / "rigs" / "sim.yaml").read_text(encoding="utf-8")
    scene = "{extends: squeeze, particle_spacing: 0.7 mm, gel: {size: [8 mm, 8 mm, 4 mm], material: silicone}}"
    (tmp_path / "mine.yaml").write_text(text.replace("scene: null", f"scene: {scene}"), encoding="utf-8")
    env = make_env("squeeze", rig=tmp_path / "mine.yaml", overrides=FEW_PARTICLES[1:])
    assert env.scene is not None
    assert (env.scene.preset, env.scene.preset_error) == ("draft", "unknown")  # a resolution of its own
    env.close()


@pytest.mark.parametrize("rows", [8, 16, 17, 31, 64, 65, 128, 255])
@pytest.mark.parametrize("columns", [8, 16, 33, 64, 100, 127])
def test_the_map_fits_any_canonical_grid(rows: int, columns: int) -> None:
    grid = CanonicalGrid(rows=rows, columns=columns, pitch=0.25e-3, image_scale=1)
    chosen = default_features(grid, ("a", "b"), ("a",))
    FeatureEncoder(chosen, grid)
    assert max(chosen.grid.rows, chosen.grid.columns) <= 16
    assert "moved" in chosen.touch and "between" not in chosen.touch  # of one arm
    if max(rows, columns) < 4 * min(rows, columns):
        assert chosen.maps == ("height",)


def test_the_error_of_each_preset_is_that_of_the_physics_page() -> None:
    page = (ROOT / "docs" / "physics-body.md").read_text(encoding="utf-8")
    table = page.partition("| closed by | 1 mm | 2 mm | 3 mm |")[2].partition("\n\n")[0]
    for preset, (least, greatest) in PRESET_FORCE_ERROR.items():
        (row,) = re.findall(rf"^\| `?{preset}`? \|(.*)\|$", table, re.MULTILINE)
        errors = [float(cell.split(",")[1]) for cell in row.split("|")]  # substeps, force error [%], creep to come
        assert (100 * least, 100 * greatest) == pytest.approx((min(errors), max(errors)))
