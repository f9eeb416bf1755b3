"""The heartbeat of the live page as it is shipped: on a clock of the test, so that a busy machine changes nothing."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from robot.serve import session as sessions
from robot.serve.app import make_app
from robot.serve.episode import StartOptions
from robot.serve.guard import Guard
from robot.serve.session import Session
from tacsim.config import load_rig
from tests.robot.waiting import until

PROMISED, CHECKED_EVERY = 1.0, 0.1  # docs/serve.md: motion stops when the page is silent for so long [s]


class Clock:
    """The clock of the session and of the server's event loop [s]."""

    now = 1000.0


class SkippingSelector(selectors.DefaultSelector):
    """Lets the clock jump to the next event of the loop instead of waiting for it."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock

    def select(self, timeout: float | None = None) -> Any:
        self._clock.now += timeout or 0.0
        return super().select(0.0)


class SkippingLoop(asyncio.SelectorEventLoop):
    def __init__(self, clock: Clock) -> None:
        super().__init__(SkippingSelector(clock))
        self._clock = clock

    def time(self) -> float:
        return self._clock.now


class Rig(SimpleNamespace):
    """Without sensors and arms."""

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *exception: object) -> None:
        pass


class EndlessEpisodes:
    """Episodes that go on until they must stop."""

    def __init__(self, loaded: object, policy: str) -> None:
        self.require_fit = None

    def run(self, rig: Rig, options: StartOptions, watcher: Any, folder: Path | None) -> tuple[str, bool]:
        until(watcher.must_stop)
        return "", False


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def session(clock: Clock, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Session]:
    rig = Rig(
        arms={}, sensors={}, frames={}, references={}, spec=SimpleNamespace(period=1e-3), now=lambda: 0.0,
        stop=lambda: None,
    )  # fmt: skip
    monkeypatch.setattr(sessions, "time", SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(sessions, "open_rig", lambda *given, **options: rig)
    monkeypatch.setattr(sessions, "Episodes", EndlessEpisodes)
    monkeypatch.setattr(sessions, "colour_heights", lambda heights: None)
    with Session(load_rig("sim"), "scripted", tmp_path) as running:
        until(lambda: shown(running)["phase"] == "watching", why=lambda: str(running.failure))
        yield running


def shown(session: Session) -> Any:
    return session.wait_for_view(-1, 0.0)[1].state


def run_server(session: Session, clock: Clock, page: Any) -> Any:
    """Runs the coroutine that `page` returns while the server checks the heartbeat."""
    app = make_app(session, Guard(["127.0.0.1:1"], "token"))

    async def serve() -> Any:
        async with app.router.lifespan_context(app):
            return await page()

    with asyncio.Runner(loop_factory=lambda: SkippingLoop(clock)) as runner:
        return runner.run(serve())


@pytest.mark.promise(16)
def test_motion_stops_when_the_page_is_silent_for_a_second(session: Session, clock: Clock) -> None:
    async def live_then_die() -> float:
        session.start(StartOptions())
        for _ in range(40):
            await asyncio.sleep(0.9 * PROMISED)
            assert shown(session)["words"] == "starting"  # a page that signs life is never stopped
            session.note_heartbeat()
        silent = clock.now
        while not shown(session)["words"].startswith("stopped: the page was silent for 1 s"):
            await asyncio.sleep(0.01)
            assert clock.now < silent + 10 * PROMISED
        return clock.now - silent

    lasted = run_server(session, clock, live_then_die)
    assert PROMISED <= lasted <= PROMISED + CHECKED_EVERY + 0.02
    until(lambda: shown(session)["phase"] == "watching")


@pytest.mark.promise(16)
def test_a_start_is_a_sign_of_life(session: Session, clock: Clock) -> None:
    """Else a motion that is started after a long time without a page would be stopped at once."""

    async def start_late() -> None:
        await asyncio.sleep(100.0)
        session.start(StartOptions())
        await asyncio.sleep(0.9 * PROMISED)
        assert shown(session)["words"] == "starting"

    run_server(session, clock, start_late)


def test_without_motion_silence_stops_nothing(session: Session, clock: Clock) -> None:
    async def be_silent() -> None:
        await asyncio.sleep(100.0)

    before = shown(session)["words"]
    run_server(session, clock, be_silent)
    assert shown(session)["words"] == before
