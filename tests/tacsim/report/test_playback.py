"""The player of an episode's page: what it holds, how large it is, and that it can run without a network."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tacsim.interface import SurfaceMap, TactileFrame
from tacsim.record.episode import Episode
from tacsim.report.playback import GRID, MAX_MOMENTS, is_same_picture, moments_of, playback_data
from tacsim.report.report import write_report
from tacsim.report.series import Series
from tests.tacsim.report.squeezed import GELS, squeezed, without_body

MAX_PAGE = 3_000_000  # [bytes]


def page_of(episode: Episode, folder: Path, **options: Any) -> str:
    return write_report(episode, folder, gels=GELS, **options)["report.html"].read_text()


def data_of(episode: Episode) -> dict[str, Any]:
    """What the page's script reads."""
    series = Series.from_episode(episode)
    found = playback_data(episode, series, lambda sensor, frame: frame.surface, GELS, moments_of(episode))
    return json.loads(json.dumps(found))  # type: ignore[no-any-return]


def data_in(page: str) -> dict[str, Any]:
    (text,) = re.findall(r'<script type="application/json" id="episode">(.*?)</script>', page, re.DOTALL)
    found: dict[str, Any] = json.loads(text)
    return found


def unpack(data: dict[str, Any], moment: int) -> NDArray[np.float64]:
    """(n, 3) particles [mm], as the script decodes them."""
    raw = np.frombuffer(base64.b64decode(data["moments"][moment]["body"]), np.uint8).reshape(-1, 3)
    return np.array(data["space"]["lower"]) + raw / 255 * data["space"]["size"]


def test_player_holds_body_of_each_moment() -> None:
    episode = squeezed()
    data = data_of(episode)
    assert [moment["step"] for moment in data["moments"]] == [0, 1, 2, 3, 4]
    for k, step in enumerate(episode.steps):
        assert step.body is not None
        np.testing.assert_allclose(unpack(data, k), 1e3 * step.body, atol=0.5 * data["space"]["size"] / 255 + 1e-4)


def test_player_draws_gels_at_their_poses_with_their_dents() -> None:
    data = data_of(squeezed())
    gel = data["moments"][-1]["gels"]["upper"]
    np.testing.assert_allclose(gel["pose"], [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 5]], atol=1e-6)
    height = np.frombuffer(base64.b64decode(gel["height"]), "<i2").reshape(GRID, GRID)
    assert height[GRID // 2, GRID // 2] == 500  # [um]
    assert height[0, 0] == 0
    assert data["gels"]["upper"] == [20, 20, 4]


def test_particles_inside_are_not_drawn_in_space() -> None:
    episode = squeezed(points=16)
    data = data_of(episode)
    points = unpack(data, 0)
    visible = np.array(data["visible"])
    inside = (np.abs(points[:, :2]) < 1.5).all(axis=1) & (np.abs(points[:, 2] - 5) < 1.5)
    at_border = (np.abs(points[:, :2]) > 4.5).any(axis=1) | (np.abs(points[:, 2] - 5) > 4.5)
    assert not (visible[inside] & 1).any()
    assert (visible[at_border] & 1).all()
    assert (visible[inside & (points[:, 1] > 0) & (points[:, 1] < 1)] & 2).all()  # next to the section
    assert not (visible[points[:, 1] < -0.1] & 2).any()  # in front of it


def test_pictures_at_rest_are_stored_once() -> None:
    episode = squeezed(steps=20, noise=2.0)
    episode.steps = [episode.steps[0] if k < 10 else step for k, step in enumerate(episode.steps)]
    lower, upper = (episode.steps[0].frames[name].image for name in GELS)
    assert not np.array_equal(lower, upper)
    assert is_same_picture(lower, upper)  # they differ by noise only
    data = data_of(episode)
    shown = [moment["pictures"]["lower"] for moment in data["moments"]]
    assert len(set(shown[:10])) == 1
    assert len(set(shown)) > 5  # those under pressure are all there
    assert len(data["files"]) == len({number for moment in data["moments"] for number in moment["pictures"].values()})


def test_a_small_contact_is_another_picture() -> None:
    rest = np.full((120, 160, 3), 100, np.uint8)
    touched = rest.copy()
    touched[50:56, 50:56] += 10
    assert is_same_picture(rest, rest.copy())
    assert not is_same_picture(rest, touched)
    assert not is_same_picture(rest, rest[:60])


def test_pictures_of_the_player_are_those_of_the_sensor() -> None:
    episode = squeezed()
    data = data_of(episode)
    last = data["moments"][-1]["pictures"]
    picture = np.asarray(Image.open(BytesIO(base64.b64decode(data["files"][last["upper"]]))))
    assert picture.shape == (48, 64, 3)
    assert picture[15, 15, 0] > 170 and abs(int(picture[40, 40, 0]) - 100) < 10
    assert list(last) == ["upper", "upper height", "lower", "lower height"]


def test_curves_have_a_value_for_each_step_and_null_for_none() -> None:
    data = data_of(squeezed())
    curves = {curve["title"]: curve for curve in data["curves"]}
    assert curves["force |Fz|"]["lines"] == {"upper": [0, 1, 2, 3, 4], "lower": [0, 1, 2, 3, 4]}
    assert curves["reward"]["lines"][""] == [-1, -0.75, -0.5, -0.25, 0]
    assert curves["depth"]["unit"] == "mm" and curves["depth"]["lines"]["upper"][-1] == pytest.approx(0.5)


@pytest.mark.parametrize("steps", [40, 130])
@pytest.mark.slow
def test_page_of_a_long_episode_is_small(steps: int, tmp_path: Path) -> None:
    """With as many particles as a recording has, and pictures whose noise is hard to compress."""
    page = page_of(squeezed(steps, points=17, size=(240, 320), noise=6.0), tmp_path)
    assert len(page) < MAX_PAGE
    moments = [moment["step"] for moment in data_in(page)["moments"]]
    assert 20 <= len(moments) <= MAX_MOMENTS
    assert moments[0] == 0 and moments[-1] == steps


def test_page_runs_only_its_own_script_and_loads_nothing(tmp_path: Path) -> None:
    page = page_of(squeezed(), tmp_path)
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{allowed}'" in page
    assert not re.search(r"https?://|fetch\(|XMLHttpRequest|WebSocket|import\(", page)


def test_episode_without_body_has_pictures_and_curves() -> None:
    data = data_of(without_body(squeezed()))
    assert all(moment["body"] is None for moment in data["moments"])
    assert len(data["files"]) > 2 and data["curves"]


@pytest.mark.slow
def test_surfaces_are_found_once_and_in_order_of_time(tmp_path: Path) -> None:
    asked: dict[str, list[float]] = {name: [] for name in GELS}

    def find(sensor: str, frame: TactileFrame) -> SurfaceMap | None:
        asked[sensor].append(frame.time)
        return frame.surface

    page_of(squeezed(steps=30), tmp_path, find=find)
    for times in asked.values():
        assert times == sorted(set(times)) and len(times) == 31
