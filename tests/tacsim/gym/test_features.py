"""Environments that show features: what a policy learns from."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tacsim.config import ConfigError
from tacsim.interface import IncompatibleRig
from tacsim.optics.render import Renderer
from tests.tacsim.gym.small import SMALL, assert_equal, make, make_native

FEATURES: dict[str, Any] = {"grid": {"rows": 4, "columns": 4, "pitch": "2 mm"}, "frames": 2}
MARKERS = [f"sensors.{name}.model.markers={{rows: 3, columns: 4}}" for name in ("lower", "upper")]


def test_check_env_is_content_without_a_warning() -> None:
    env = make(
        features={**FEATURES, "flow": True, "maps": ["height", "slope", "contact", "image", "picture"]},
        overrides=[*SMALL, *MARKERS],
    )
    env.spec = None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)
    shapes = {key: box.shape for key, box in env.observation_space.items()}
    assert shapes == {"maps": (2 * 2 * 10, 4, 4), "flow": (2 * 2 * 2, 3, 4), "touch": (2 * 43,), "goal": (1,)}
    env.close()


@pytest.mark.parametrize(("maps", "pictures"), [(["height", "contact"], 0), (["image"], 2)])
def test_no_picture_is_rendered_that_nobody_looks_at(
    monkeypatch: pytest.MonkeyPatch, maps: list[str], pictures: int
) -> None:
    env, rendered = make(features={**FEATURES, "maps": maps}), []
    env.reset(seed=1)
    render = Renderer.__call__
    monkeypatch.setattr(Renderer, "__call__", lambda *given: (rendered.append(0), render(*given))[1])
    env.step(env.action_space.sample())
    assert len(rendered) == pictures
    env.close()


def test_they_are_those_of_the_flat_observation_and_the_goal_of_the_episode() -> None:
    shown, flat = make(features=FEATURES), make()
    for variant, goal in ((0, 2e-3), (1, 4e-3)):
        seen, told = shown.reset(seed=1, options={"variant": variant})
        full, _ = flat.reset(seed=1, options={"variant": variant})
        assert seen["goal"].tolist() == pytest.approx([goal / 10e-3])
        assert told["is_success"] is False
        first = seen["maps"]
        assert first[0].tolist() == first[2].tolist()  # before the first there is none
        seen, full = (env.step(np.array([1.0, -1.0], np.float32))[0] for env in (shown, flat))
        assert seen["maps"][:2].tolist() == first[:2].tolist()  # the oldest comes first
        height = full["height_lower"].astype(float) * full["valid_lower"]
        cells = full["valid_lower"].reshape(4, 2, 4, 2).sum(axis=(1, 3))
        means = height.reshape(4, 2, 4, 2).sum(axis=(1, 3)) / np.maximum(cells, 1)
        assert seen["maps"][2] == pytest.approx(1e3 * means, abs=1e-6)


def test_what_is_remembered_is_the_mean_since_the_episode_began() -> None:
    env = make(features={"maps": [], "touch": ["depth", "wrench"], "remembered": ["wrench"]})
    for seed in (1, 2):
        shown = [env.reset(seed=seed, options={"variant": 0})[0]["touch"]]
        for push in (1.0, 0.5, 0.2):
            shown.append(env.step(np.array([push, -push], np.float32))[0]["touch"])
        told, means = np.array(shown)[:, 4:16], np.array(shown)[:, 16:]
        assert np.ptp(told, axis=0).max() > 1e-3  # forces change
        assert means == pytest.approx(np.cumsum(told, axis=0) / np.arange(1, 5)[:, None], abs=1e-6)
    env.close()


def test_a_batch_shows_what_each_alone_shows() -> None:
    pictured = {**FEATURES, "maps": ["height", "picture"], "remembered": ["depth", "between"]}
    batch, alone = make_native(2, features=pictured), make(features=pictured)
    seen, _ = batch.reset(seed=[3, 4])
    for index, seed in enumerate((3, 4)):
        assert_equal({key: value[index] for key, value in seen.items()}, alone.reset(seed=seed)[0])
    batch.close()


@pytest.mark.parametrize(
    ("wrong", "error", "words"),
    [
        ({"grid": {"pitch": "0.3 mm"}}, IncompatibleRig, "cannot be put together"),
        ({"flow": True, **FEATURES}, IncompatibleRig, "sensor 'lower' of this rig has no markers"),
        ({"sensors": ["finger"], **FEATURES}, IncompatibleRig, "finger"),
        ({"arms": ["left", "right"], **FEATURES}, IncompatibleRig, "left"),
        ({"speed": 1}, ConfigError, "features: speed"),
    ],
)
def test_what_the_rig_does_not_have_is_refused_before_anything_is_simulated(wrong: Any, error: Any, words: str) -> None:
    with pytest.raises(error, match=words):
        make(features=wrong)
