"""The live page in a browser, as wide as a desk's screen and as a phone's. Skipped where there is no Chromium."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.browser import NAMES, Browser, find_browser
from tests.robot.serve.served import REAL_TIME, Served
from tests.robot.waiting import PATIENCE

PROGRAM = find_browser()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(PROGRAM is None, reason=f"no browser: none of {', '.join(NAMES)} is installed"),
]
PICTURES = os.environ.get("TACSIM_TEST_PICTURES")  # a folder for pictures of the pages, to be looked at
SIZES = [(1280, 800), (390, 844)]  # of a desk's screen and a phone's [px]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with Served(tmp_path_factory.mktemp("served"), "mock", *REAL_TIME) as running:
        yield running


def click(browser: Browser, button: str) -> None:
    """Clicks a button as soon as it may be clicked."""
    browser.until(f"!document.getElementById('{button}').disabled")
    browser.run(f"document.getElementById('{button}').click()")


def press(browser: Browser, key: str, kind: str = "keydown") -> None:
    code = "'Space'" if key == " " else "''"
    event = f"new KeyboardEvent('{kind}', {{key: '{key}', code: {code}, bubbles: true}})"
    browser.run(f"document.body.dispatchEvent({event})")


def until_moved(browser: Browser, before: float) -> None:
    browser.until(f"Math.abs(state.arms.upper.position[0] - {before}) > 1e-4")


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_page_operates_the_rig(served: Served, tmp_path: Path, width: int, height: int) -> None:
    assert PROGRAM is not None
    with Browser(PROGRAM, tmp_path / "profile", width, height) as browser:
        browser.open(f"http://{served.host}/#token={served.token}")
        browser.until("document.querySelectorAll('#sensors img').length >= 2 && state.phase === 'watching'")
        assert browser.run("document.documentElement.scrollWidth <= innerWidth")
        assert "token" not in browser.run("location.href")
        click(browser, "reference")
        browser.until("state.words === 'references taken'")

        click(browser, "drive")
        browser.until("state.phase === 'running' && state.mode === 'teleoperation'")
        browser.run("document.getElementById('arm').value = 'upper'")
        before = browser.run("state.arms.upper.position[0]")
        press(browser, "ArrowRight")
        until_moved(browser, before)
        press(browser, "ArrowRight", "keyup")
        before = browser.run("state.arms.upper.position[0]")
        pad = "{axes: [-0.9, 0, 0, 0.1], buttons: [{pressed: false}, {pressed: false}]}"
        browser.run(f"window.pad = {pad}; navigator.getGamepads = () => [null, window.pad]; 0")
        until_moved(browser, before)
        browser.run("window.pad.buttons[1].pressed = true")
        browser.until("state.phase === 'watching' && state.words.includes('STOP was pressed')")
        browser.run("navigator.getGamepads = () => []; 0")

        save(browser, tmp_path, f"watching-{width}.png")
        assert browser.run("getComputedStyle(document.getElementById('stop')).display") != "none"
        assert browser.messages == []


@pytest.mark.slow
def test_a_policy_is_started_stopped_and_its_recording_kept(served: Served, tmp_path: Path) -> None:
    assert PROGRAM is not None
    with Browser(PROGRAM, tmp_path / "profile", 1280, 800) as browser:
        browser.open(f"http://{served.host}/#token={served.token}")
        browser.until("state.phase === 'watching'")
        click(browser, "start")
        browser.until("state.phase === 'running' && state.step && state.step.index >= 1")
        browser.until("document.querySelectorAll('[data-kind=height] img').length === 2")
        press(browser, " ")
        browser.until("state.phase === 'watching' && state.words.includes('STOP was pressed') && state.pending")
        browser.run("document.getElementById('note').value = 'a <b>note</b>'")
        click(browser, "keep")
        browser.until("!state.pending")
        browser.until("!document.getElementById('report').hidden", 5 * PATIENCE)
        assert (served.folder / "episodes/000/note.txt").read_text() == "a <b>note</b>\n"
        assert browser.messages == []


@pytest.mark.promise(16)
@pytest.mark.slow
def test_a_hostile_page_moves_nothing(served: Served, tmp_path: Path) -> None:
    """A page of another origin, in the browser of the operator; it even knows the token."""
    assert PROGRAM is not None
    (tmp_path / "evil.html").write_text("<!doctype html><title>evil</title>")
    handler = partial(QuietHandler, directory=str(tmp_path))
    with (
        ThreadingHTTPServer(("127.0.0.1", 0), handler) as evil,
        Browser(PROGRAM, tmp_path / "profile", 800, 600) as browser,
    ):
        threading.Thread(target=evil.serve_forever, daemon=True).start()
        browser.open(f"http://{served.host}/#token={served.token}")
        browser.until("state.phase === 'watching'")
        browser.open(f"http://localhost:{evil.server_port}/evil.html")
        for path in ("start", "drive", "reference"):
            for more in ("", f", headers: {{Authorization: 'Bearer {served.token}'}}"):
                request = (
                    f"fetch('http://{served.host}/{path}', {{method: 'POST', mode: 'no-cors', body: '{{}}'{more}}})"
                )
                browser.run(f"{request}.then(() => 'sent', () => 'failed')")
        seen = browser.run(
            f"new Promise((done) => {{ const socket = new WebSocket('ws://{served.host}/live'); "
            "socket.onopen = () => done('open'); socket.onerror = () => done('refused'); })"
        )
        assert seen == "refused"
        frame = f"const frame = document.createElement('iframe'); frame.src = 'http://{served.host}/'"
        browser.run(f"new Promise((done) => {{ {frame}; frame.onload = done; document.body.append(frame); }})")
        evil.shutdown()
        browser.open(f"http://{served.host}/")
        browser.until("state.phase === 'watching' && !state.mode")


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves a folder, and prints nothing."""

    def log_message(self, format: str, *arguments: object) -> None:
        pass


def save(browser: Browser, folder: Path, name: str) -> None:
    browser.picture(folder / name)
    if PICTURES:
        shutil.copy(folder / name, PICTURES)
