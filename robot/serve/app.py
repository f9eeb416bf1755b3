"""The web server of the live page: its requests, and the stream of pictures. No GET changes anything."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from robot.serve.episode import StartOptions
from robot.serve.errors import Refused
from robot.serve.guard import STOP_PATH, Guard, GuardedApp
from robot.serve.operated_policy import Mode
from robot.serve.session import HEARTBEAT, Session

PAGE = Path(__file__).resolve().parent / "page"
REPORT_FILES = ("report.html", "report.png", "summary.json")
MIN_INTERVAL = 0.05  # between two views of one page [s]
MAX_BODY = 64 * 2**10  # of a request [bytes]
MAX_PAGES = 16  # at once; each needs a thread of the server's 40
STOPPED = "STOP was pressed"


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid")


class StartBody(_Body):
    mode: Mode = "policy"
    steps: int | None = Field(default=None, ge=1, le=10**6)
    seed: int = Field(default=0, ge=0, lt=2**31)
    record: bool = False


class ModeBody(_Body):
    mode: Mode


class AnswerBody(_Body):
    yes: bool


class NoteBody(_Body):
    note: str = Field(default="", max_length=10_000)


class JogBody(_Body):
    arm: str
    jog: tuple[float, float, float, float, float, float]


def make_app(session: Session, guard: Guard) -> Starlette:
    """The application; `session` is open as long as the server runs."""
    posts: dict[str, tuple[Callable[[Any], Any], type[_Body]]] = {
        "/start": (lambda body: session.start(StartOptions(**body.model_dump())), StartBody),
        "/drive": (lambda body: session.drive(), _Body),
        "/end": (lambda body: session.end(), _Body),
        "/mode": (lambda body: session.set_mode(body.mode), ModeBody),
        "/reference": (lambda body: session.take_references(), _Body),
        "/recover": (lambda body: session.recover(), _Body),
        "/answer": (lambda body: session.answer(body.yes), AnswerBody),
        "/keep": (lambda body: session.recordings.keep(body.note), NoteBody),
        "/discard": (lambda body: session.recordings.discard(), _Body),
    }

    async def page(request: Request) -> Response:
        return FileResponse(PAGE / "index.html")

    async def stop(request: Request) -> Response:
        # Needs no token, whatever the origin: a stop is never refused. In the server's own thread: it waits for nothing
        session.stop(STOPPED)
        return JSONResponse({})

    async def report(request: Request) -> Response:
        folder, name = session.recordings.report, request.path_params["name"]
        if folder is None or name not in REPORT_FILES or not (folder / name).is_file():
            return PlainTextResponse("no report", 404)
        # Its scripts run without the rights of this page.
        policy = "sandbox allow-scripts allow-downloads"
        return FileResponse(folder / name, headers={"Content-Security-Policy": policy})

    return Starlette(
        routes=[
            Route("/", page),
            Route(STOP_PATH, stop, methods=["POST"]),
            *(Route(path, _command(guard, *each), methods=["POST"]) for path, each in posts.items()),
            Route("/report/{name}", report),
            WebSocketRoute("/live", _Live(session, guard).serve),
            Mount("/page", StaticFiles(directory=PAGE)),
        ],
        middleware=[Middleware(GuardedApp, guard=guard)],
        lifespan=partial(_watch_heartbeat, session),
    )


class Server(uvicorn.Server):
    """Serves an application. Signals are handled by the command, which calls `end`."""

    def __init__(self, config: uvicorn.Config, session: Session) -> None:
        super().__init__(config)
        self._session = session

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield  # uvicorn would end the process by the signal, before the rig is closed

    def end(self) -> None:
        """Stops the arms, then ends the server. May be called in a signal handler."""
        # In a thread: the signal may have interrupted this one while it held a lock of the session.
        threading.Thread(target=self._session.stop, args=("the server ends",)).start()
        self.should_exit = True


def make_server(session: Session, guard: Guard) -> Server:
    """A server of the application."""
    config = uvicorn.Config(
        make_app(session, guard),
        log_level="warning",
        ws="websockets-sansio",
        ws_max_size=MAX_BODY,
        timeout_graceful_shutdown=2,  # for its connections [s]
    )
    return Server(config, session)


def _command(guard: Guard, call: Callable[[Any], Any], body: type[_Body]) -> Callable[[Request], Awaitable[Response]]:
    """A request of the operator: needs the token; its JSON body is checked, then `call` gets it in another thread."""

    async def serve(request: Request) -> Response:
        if refusal := guard.refuse_token(request.headers.get("authorization", "").removeprefix("Bearer ")):
            return JSONResponse({"error": refusal}, 403)
        data = b""
        async for chunk in request.stream():
            data += chunk
            if len(data) > MAX_BODY:
                return JSONResponse({"error": f"the request has more than {MAX_BODY} bytes"}, 413)
        try:
            result = await run_in_threadpool(call, body.model_validate_json(data or b"{}"))
        except ValidationError as failure:
            problem = failure.errors()[0]
            return JSONResponse({"error": f"{'.'.join(map(str, problem['loc']))}: {problem['msg']}"}, 422)
        except Refused as failure:
            return JSONResponse({"error": str(failure)}, 409)
        except OSError as failure:  # of keeping or discarding a recording
            return JSONResponse({"error": f"{failure.filename}: {failure.strerror}"}, 500)
        return JSONResponse({} if result is None else {"result": str(result)})

    return serve


class _Live:
    """The stream of one page: views to it; signs of life, jogs and stops from it."""

    def __init__(self, session: Session, guard: Guard) -> None:
        self._session, self._guard, self._pages = session, guard, 0

    async def serve(self, socket: WebSocket) -> None:
        if self._pages >= MAX_PAGES:
            await socket.close(1013, f"{MAX_PAGES} pages are open; close one")
            return
        self._pages += 1
        sender: asyncio.Task[None] | None = None
        try:
            await socket.accept()
            sender = asyncio.create_task(self._send_views(socket))
            while True:
                self._take(json.loads(await socket.receive_text()))
        except (WebSocketDisconnect, OSError):
            pass
        except (ValueError, KeyError, TypeError, AttributeError):  # not a message of our page
            with suppress(RuntimeError):  # it has left
                await socket.close(1007, "not a message of this page")
        finally:
            self._pages -= 1
            if sender is not None:
                sender.cancel()

    def _take(self, message: dict[str, Any]) -> None:
        if message.get("stop"):  # needs no token
            self._session.stop(STOPPED)
        if self._guard.refuse_token(str(message.get("token", ""))) is not None:
            return
        self._session.note_heartbeat()
        if "jog" in message:
            body = JogBody(arm=message["arm"], jog=message["jog"])
            with suppress(Refused):  # the page shows the mode that it is in
                self._session.jog(body.arm, np.array(body.jog, np.float64))

    async def _send_views(self, socket: WebSocket) -> None:
        """Sends each new view, at most one an interval; the newest where they come faster."""
        number = -1
        with suppress(WebSocketDisconnect, RuntimeError, OSError):  # it has left
            while True:
                number, view = await run_in_threadpool(self._session.wait_for_view, number, 0.5)
                await socket.send_bytes(view.encode())
                await asyncio.sleep(MIN_INTERVAL)


@asynccontextmanager
async def _watch_heartbeat(session: Session, app: Starlette) -> AsyncIterator[None]:
    async def watch() -> None:
        while True:
            session.check_heartbeat()
            await asyncio.sleep(HEARTBEAT / 10)

    watcher = asyncio.create_task(watch())
    try:
        yield
    finally:
        watcher.cancel()
