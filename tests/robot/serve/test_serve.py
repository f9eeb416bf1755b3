"""The live page of a rig over its real wire: who may do what, stops, teleoperation, references, recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from numpy.typing import NDArray
from websockets import ConnectionClosed
from websockets.sync.client import ClientConnection

from robot.fixtures import mock_host
from robot.mock import FaultClient
from tacsim.record.reader import read_episode
from tests.robot.serve.served import HEARTBEAT, REAL_TIME, Page, Served
from tests.robot.waiting import PATIENCE, until

pytestmark = pytest.mark.slow  # each has a server and mocks of its own
MOVING, STANDING = 2e-3, 1e-4  # of a joint [rad/s]
LIMIT = 2e-3  # of the workspace of the upper arm along x [m]
UPWARDS = [0.0, 0.0, -1.0, 0.0, 0.0, 0.0]  # of the upper arm, whose sensor looks down
POSTS = ("/start", "/drive", "/end", "/mode", "/reference", "/recover", "/answer", "/keep", "/discard")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The mock rig in real time, without a body: its arms are moved by hand."""
    box = f"arms.upper.limits.workspace={{lower: [{-LIMIT}, -0.04, -0.04], upper: [{LIMIT}, 0.04, 0.06]}}"
    with Served(tmp_path_factory.mktemp("served"), "mock", *REAL_TIME, "--set", box) as running:
        yield running


@pytest.fixture
def page(served: Served) -> Iterator[Page]:
    with Page(served) as found:
        found.until_rest()
        yield found
        served.ask("POST", "/stop", token="")
        found.until_rest()
        if found.view["pending"]:
            served.post("/discard")


def drive(served: Served, page: Page) -> None:
    """Begins a motion by hand from where the arms are, and waits for a view that shows the arms."""
    if "none" in page.view["lamps"].values():
        assert served.post("/reference") == (200, {})
        page.until(lambda view: view["phase"] == "watching" and "none" not in view["lamps"].values())
    status, answer = served.post("/drive")
    assert status == 200, answer
    # The first views have words only: the arms come with the first observation.
    assert page.until(lambda view: view["phase"] == "running" and "arms" in view)["mode"] == "teleoperation"


def start_by_hand(served: Served, page: Page, **options: object) -> None:
    status, answer = served.post("/start", mode="teleoperation", **options)
    assert status == 200, answer
    page.until(lambda view: view["phase"] == "running" and view["step"] is not None and view["step"]["index"] > 0)
    assert page.view["mode"] == "teleoperation"


def read_to_the_end(stream: ClientConnection) -> None:
    while True:
        stream.recv(timeout=10)


@pytest.fixture
def upper() -> Iterator[FaultClient]:
    """The controller of the upper arm, asked directly."""
    with closing(FaultClient(mock_host(12))) as found:
        yield found


def joint_speed(arm: FaultClient) -> float:
    """Of its fastest joint [rad/s]."""
    return float(np.abs(arm.state().joint_speeds).max())


@pytest.mark.slow
def test_page_is_served_and_shows_pictures(served: Served, page: Page) -> None:
    status, text = served.ask("GET", "/", token="")
    assert status == 200 and "STOP" in text and "/page/live.js" in text
    for name in ("live.js", "style.css"):
        assert served.ask("GET", f"/page/{name}", token="")[0] == 200
    page.until(lambda view: len(page.pictures) >= 2)
    assert page.pictures["upper/picture"].startswith(b"\xff\xd8") and page.view["rig"] == "mock"


@pytest.mark.promise(16)
@pytest.mark.parametrize("path", POSTS)
def test_commands_need_the_token_and_the_own_page(served: Served, page: Page, path: str) -> None:
    before = page.view["phase"]
    status, answer = served.ask("POST", path, {}, token="")
    assert status == 403 and answer["error"].startswith("the token is missing or wrong")
    assert served.ask("POST", path, {}, token=served.token[:-1] + "x")[0] == 403
    assert served.ask("POST", path, {}, Origin="http://evil.example") == (
        403,
        {"error": "a page of another site asked"},
    )
    assert served.ask("POST", path, {}, Origin="null")[0] == 403
    status, answer = served.ask("POST", path, {}, Host="rebound.example")
    assert status == 403 and answer["error"].startswith("this server is not 'rebound.example'")
    assert served.ask("GET", path)[0] == 405
    assert page.view["phase"] == before == "watching"


def test_foreign_names_and_pages_see_nothing(served: Served) -> None:
    assert served.ask("GET", "/", token="", Host="rebound.example")[0] == 403
    for origin in ("http://evil.example", "null"):
        with pytest.raises(Exception, match="403"), served.live(origin):
            pass


def test_a_page_without_token_looks_and_keeps_no_motion_alive(served: Served, page: Page) -> None:
    with served.live() as stream:
        assert isinstance(stream.recv(timeout=10), bytes)
        stream.send('{"token": "wrong", "arm": "upper", "jog": [1, 0, 0, 0, 0, 0]}')
        stream.send("[]")
        with pytest.raises(ConnectionClosed):
            read_to_the_end(stream)
    assert served.ask("GET", "/", token="")[0] == 200


@pytest.mark.promise(16)
@pytest.mark.slow
def test_motion_stops_when_the_page_is_lost(served: Served, page: Page, upper: FaultClient) -> None:
    with Page(served) as other:
        other.until_rest()
        page.fall_silent()  # its stream stays
        drive(served, other)
        other.jog = ("upper", UPWARDS)
        until(lambda: joint_speed(upper) > MOVING, "motion", why=lambda: str(page.view))
    page.until(lambda view: view["phase"] == "watching" and f"silent for {HEARTBEAT:g} s" in view["words"])
    until(lambda: joint_speed(upper) < STANDING, "rest")
    # Without a sign of life nothing starts to stay.
    assert served.post("/drive")[0] == 200
    page.until(lambda view: view["phase"] == "watching" and f"silent for {HEARTBEAT:g} s" in view["words"])


@pytest.mark.promise(16)
def test_a_stop_right_after_a_start_prevents_its_motion(served: Served, page: Page, upper: FaultClient) -> None:
    for _ in range(5):
        until(lambda: served.post("/start")[0] == 200, "start", pause=0.05)  # the last one has ended
        assert served.ask("POST", "/stop", token="")[0] == 200
    page.until(lambda view: view["phase"] == "watching" and "STOP was pressed" in view["words"])
    until(lambda: joint_speed(upper) < STANDING, "rest")
    place = upper.state().joints
    time.sleep(1.0)
    assert np.abs(np.subtract(upper.state().joints, place)).max() < 1e-5  # [rad]: it settles by a micrometre


def test_a_jog_that_is_not_repeated_ends(served: Served, page: Page, upper: FaultClient) -> None:
    drive(served, page)
    page.jog = ("upper", UPWARDS)
    until(lambda: joint_speed(upper) > MOVING, "motion", why=lambda: str(page.view))
    page.jog = None
    until(lambda: joint_speed(upper) < STANDING, "rest")
    assert page.view["phase"] == "running"
    assert served.post("/end")[0] == 200
    assert page.until_rest()["words"] == "the motion by hand has ended"


def position_at_rest(page: Page) -> NDArray[np.float64]:
    """Of the upper arm (3,) [m], once it stays where it is: it may still approach."""
    page.until(lambda view: bool(view.get("arms")))
    while True:
        before = np.array(page.view["arms"]["upper"]["position"])
        time.sleep(0.5)
        if np.abs(page.view["arms"]["upper"]["position"] - before).max() < 1e-6:
            return before


@pytest.mark.slow
def test_teleoperation_moves_along_the_axes_of_the_sensor_within_limits(
    served: Served, page: Page, upper: FaultClient
) -> None:
    drive(served, page)
    before = position_at_rest(page)
    page.jog = ("upper", [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    page.until(lambda view: abs(view["arms"]["upper"]["position"][0] - before[0]) > 1e-3)
    moved = np.array(page.view["arms"]["upper"]["position"]) - before
    assert np.abs(moved[1:]).max() < 1e-4
    page.jog = ("upper", [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    page.until(lambda view: abs(view["arms"]["upper"]["position"][0]) > LIMIT - 1e-4)
    time.sleep(1.0)
    assert np.abs(page.view["arms"]["upper"]["position"][0]) < LIMIT + 1e-4
    assert page.view["phase"] == "running"


@pytest.mark.slow
def test_an_episode_is_paused_stepped_and_taken_over_by_hand(served: Served, page: Page) -> None:
    status, answer = served.post("/start", mode="paused", steps=3)
    assert status == 200, answer
    assert served.post("/drive")[0] == served.post("/start")[0] == served.post("/reference")[0] == 409
    page.until(lambda view: view["phase"] == "running" and view["step"] is not None and view["step"]["index"] >= 4)
    assert page.view["mode"] == "paused"  # more steps than the policy has: those that hold do not count
    assert served.post("/mode", mode="teleoperation")[0] == 200
    page.until(lambda view: view["mode"] == "teleoperation")
    assert served.post("/mode", mode="step")[0] == 200
    page.until(lambda view: view["mode"] == "paused")
    assert served.post("/mode", mode="policy")[0] == 200
    assert page.until_rest()["words"] == "the episode has ended"


@pytest.mark.slow
def test_a_recording_is_kept_with_a_note_or_discarded(served: Served, page: Page) -> None:
    for keeps in (True, False):
        start_by_hand(served, page, record=True, seed=3)
        page.until(lambda view: view["step"] is not None and view["step"]["index"] >= 2)
        served.ask("POST", "/stop", token="")
        view = page.until(lambda view: view["phase"] == "watching" and view["pending"] is not None)
        assert "STOP was pressed" in view["words"]
        folder = served.folder / "episodes" / view["pending"]
        assert served.post("/start")[0] == 409  # before it is kept or discarded
        page.until(lambda view: view["report"] == view["pending"], 5 * PATIENCE)  # another process writes it
        status, text = served.ask("GET", "/report/report.html", token="")
        assert status == 200 and "<html" in text
        assert served.ask("GET", "/report/..%2Fepisode.mcap", token="")[0] == 404
        if keeps:
            assert served.post("/keep", note="a good one") == (200, {"result": str(folder)})
            assert (folder / "note.txt").read_text() == "a good one\n"
            assert len(read_episode(folder / "episode.mcap").steps) >= 3
        else:
            assert served.post("/discard")[0] == 200 and not folder.exists()
        assert served.post("/keep")[0] == 409


@pytest.mark.slow
def test_a_reference_is_taken_of_a_free_gel_only(served: Served, page: Page) -> None:
    start_by_hand(served, page)  # its reset approaches until the gels touch
    page.until(lambda view: view["sensors"]["upper"].get("signal", 0.0) > 0.01)
    assert served.post("/end")[0] == 200
    page.until_rest()
    status, answer = served.post("/reference")
    assert status == 409 and "is touched (contact signal 0.0" in answer["error"]
    assert page.view["lamps"]["upper"] == "fresh"  # the old one stays
    drive(served, page)
    page.jog = ("upper", UPWARDS)
    page.until(lambda view: view["sensors"]["upper"]["signal"] < 1e-3)
    page.jog = ("lower", UPWARDS)  # away from the body, along its own axis
    page.until(lambda view: view["sensors"]["lower"]["signal"] < 1e-3)
    page.jog = None
    assert served.post("/end")[0] == 200
    page.until_rest()
    assert served.post("/reference") == (200, {})
    assert served.post("/reference") == (200, {})  # at once: the answer comes when the rig is at rest again
    page.until(lambda view: view["words"] == "references taken")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("/start", {"mode": "fly"}, 422),
        ("/start", {"steps": 0}, 422),
        ("/start", {"speed": 9}, 422),
        ("/mode", {"mode": "paused"}, 409),
        ("/answer", {"yes": True}, 409),
        ("/keep", {"note": "x" * 20_000}, 422),
        ("/keep", {"note": "x" * 100_000}, 413),
    ],
)
def test_wrong_requests_are_refused_in_words(served: Served, page: Page, path: str, body: object, status: int) -> None:
    found, answer = served.ask("POST", path, body)
    assert found == status and answer["error"]
