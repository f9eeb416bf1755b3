"""The player of an episode's page and the page of a press, used in a browser. Skipped where there is no Chromium."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tacsim.record.episode import Episode
from tacsim.report.press_page import write_press_page
from tacsim.report.report import write_report
from tests.browser import NAMES, Browser, find_browser
from tests.tacsim.report.squeezed import GELS, squeezed, without_body

PROGRAM = find_browser()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(PROGRAM is None, reason=f"no browser: none of {', '.join(NAMES)} is installed"),
]
PICTURES = os.environ.get("TACSIM_TEST_PICTURES")  # a folder for pictures of the pages, to be looked at
MAX_PAGE = 3_000_000  # [bytes]
STEPS = 24
SIZES = [(1280, 800), (390, 844)]  # of a desk's screen and a phone's [px]
STEP = "document.getElementById('moment').textContent"
SCENE = "document.getElementById('scene').toDataURL()"
PICTURE = "document.querySelector('#pictures img').src"
PLAY = "document.getElementById('play').textContent"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("episode")
    return write_report(squeezed(STEPS, points=16, size=(120, 160)), folder, gels=GELS)["report.html"]


@pytest.fixture(params=SIZES, ids=["desk", "phone"])
def browser(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Browser]:
    assert PROGRAM is not None
    with Browser(PROGRAM, tmp_path / "profile", *request.param) as found:
        yield found


def open_alone(browser: Browser, page: Path) -> None:
    """Opens a page, which must need nothing but itself."""
    browser.open(page.as_uri())
    assert page.stat().st_size <= MAX_PAGE
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    browser.until("[...document.images].every((image) => image.complete)")
    stretch = "canvas.width * canvas.clientHeight / canvas.height / canvas.clientWidth"
    is_right = f"(canvas) => !canvas.clientWidth || Math.abs({stretch} - 1) < 0.02"
    browser.until(f"[...document.querySelectorAll('canvas')].every({is_right})", 10.0)


def require_quiet(browser: Browser, page: Path) -> None:
    """No error or warning in the console, and no request but for the page."""
    browser.run("new Promise((done) => requestAnimationFrame(() => setTimeout(done, 100)))")
    assert browser.messages == []
    assert browser.requests == [page.as_uri()]


def save(browser: Browser, folder: Path, name: str) -> None:
    width = browser.run("innerWidth")
    browser.picture(folder / f"{name}-{width}.png")
    if PICTURES:
        shutil.copy(folder / f"{name}-{width}.png", PICTURES)


def test_keys_slider_and_play_change_the_step(browser: Browser, page: Path, tmp_path: Path) -> None:
    open_alone(browser, page)
    assert browser.run(STEP) == f"step {STEPS}"  # it opens at the largest force
    strongest = browser.run(SCENE), browser.run(PICTURE)

    browser.press("Home")
    assert browser.run(STEP) == "step 0"
    assert browser.run(SCENE) != strongest[0] and browser.run(PICTURE) != strongest[1]
    for key, step in (("ArrowRight", 1), ("PageDown", 11), ("ArrowLeft", 10), ("End", STEPS), ("PageUp", STEPS - 10)):
        browser.press(key)
        assert browser.run(STEP) == f"step {step}"
    browser.press("End")
    assert (browser.run(SCENE), browser.run(PICTURE)) == strongest

    browser.click("#slider", share=0.5)
    assert browser.run(STEP) == f"step {STEPS // 2}"
    assert browser.run("document.getElementById('slider').value") == str(STEPS // 2)
    browser.click("#curves canvas", share=0.25)
    assert browser.run(STEP) == f"step {STEPS // 4}"

    browser.click("#play")
    assert browser.run(PLAY) == "Pause"
    browser.until(f"{STEP} !== 'step {STEPS // 4}'")
    browser.until(f"{STEP} === 'step {STEPS}'")
    browser.until(f"{STEP} === 'step 0'")  # it begins again
    browser.run("document.activeElement.blur()")
    browser.press(" ")
    assert browser.run(PLAY) == "Play"
    stopped = browser.run(STEP)
    browser.run("new Promise((done) => setTimeout(done, 300))")
    assert browser.run(STEP) == stopped
    require_quiet(browser, page)


def test_the_scene_is_drawn_turned_and_cut(browser: Browser, page: Path, tmp_path: Path) -> None:
    open_alone(browser, page)
    save(browser, tmp_path, "report")
    seen = [browser.run(SCENE)]
    assert count_colours(browser) > 100  # clay and gels are shaded
    browser.click("#scene", drag=(60.0, 20.0))
    seen.append(browser.run(SCENE))
    browser.click("#section")
    seen.append(browser.run(SCENE))
    assert len(set(seen)) == 3
    require_quiet(browser, page)


def count_colours(browser: Browser) -> int:
    """In the canvas of the scene."""
    pixels = "scene.getContext('2d').getImageData(0, 0, scene.width, scene.height).data"
    words = f"new Uint32Array({pixels}.buffer)"
    return int(
        browser.run(f"(() => {{ const scene = document.getElementById('scene'); return new Set({words}).size; }})()")
    )


def test_without_a_body_pictures_and_curves_play(browser: Browser, tmp_path: Path) -> None:
    page = write_report(without_body(squeezed(STEPS)), tmp_path / "flat")["report.html"]
    open_alone(browser, page)
    assert not browser.run("document.getElementById('scene').clientWidth")
    browser.press("Home")
    first = browser.run(PICTURE)
    browser.press("End")
    assert browser.run(STEP) == f"step {STEPS}" and browser.run(PICTURE) != first
    save(browser, tmp_path, "report-flat")
    require_quiet(browser, page)


def test_a_name_from_a_recording_runs_no_script(browser: Browser, tmp_path: Path) -> None:
    hostile = "</script><img src=x onerror=document.title='hacked'>"
    episode = squeezed(2)
    episode = Episode(replace(episode.meta, policy=hostile), episode.steps)
    page = write_report(episode, tmp_path / "hostile", gels=GELS)["report.html"]
    open_alone(browser, page)
    browser.press("Home")
    assert browser.run(STEP) == "step 0" and browser.run("document.title") != "hacked"
    assert hostile in browser.run("document.body.innerText")
    require_quiet(browser, page)


def test_the_surface_of_a_press_turns(browser: Browser, tmp_path: Path) -> None:
    for name in ("rgb.png", "side.png"):
        Image.new("RGB", (320, 240), (90, 120, 150)).save(tmp_path / name)
    rows, columns = np.mgrid[-1:1:48j, -1:1:64j]
    height = np.maximum(0.0, 0.5e-3 - 2e-3 * (rows**2 + columns**2)).astype(np.float32)
    config = {
        "pressing_side": "a ball", "pixel_pitch": 0.25e-3, "force": 1.0, "contact_radius": 1e-3, "deepest": 0.5e-3,
        "depth": 0.5e-3, "preset": "draft", "element_size": 0.5e-3, "settled": True, "slide": [0.0, 0.0], "twist": 0.0,
    }  # fmt: skip
    page = tmp_path / "press.html"
    write_press_page(page, tmp_path, height, config, [(0.0, 0.0), (0.25e-3, 0.4), (0.5e-3, 1.0)])
    open_alone(browser, page)
    save(browser, tmp_path, "press")
    drawn = "document.getElementById('surface').toDataURL()"
    before = browser.run(drawn)
    browser.click("#surface", drag=(60.0, 20.0))
    assert browser.run(drawn) != before
    require_quiet(browser, page)
