"""`tacsim serve`: a live page of a rig."""

from __future__ import annotations

import os
import secrets
import socket
import sys
from pathlib import Path
from typing import Annotated

import typer

from robot.cli.options import Overrides, require_packages
from robot.cli.output import busy, notes, results
from robot.cli.terminal import Interrupt

TOKEN = "TACSIM_TOKEN"  # environment variable
MIN_TOKEN = 16  # characters of a token that the user gives
LOOPBACK = ("127.0.0.1", "::1", "localhost")
ANY_ADDRESS = ("0.0.0.0", "::")


def serve(
    rig: Annotated[str, typer.Argument(help="A rig, or the path of its file.")] = "mock",
    *,
    task: Annotated[str | None, typer.Option(help="As in tacsim run.", show_default="the rig's own")] = None,
    policy: Annotated[
        str | None, typer.Option(help="As in tacsim run.", show_default="scripted, or grip without a task")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one.")] = 8765,
    bind: Annotated[
        str, typer.Option(metavar="ADDRESS", help=f"Beyond this machine only with a token in {TOKEN}.")
    ] = "127.0.0.1",
    host: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Another name of this machine in the page's address.")
    ] = None,
    set_: Overrides = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Recorded episodes: DIR/000, 001, ...")] = Path(
        "runs/served"
    ),
) -> None:
    """Serve a live page of a rig: look, STOP, start a policy, move by hand, take references, record.

    Anyone who can open the page can look and stop. What starts a motion needs the token in the address that is printed.
    Motion stops when the page is closed or silent for a second. Needs the extra 'web'.

    Example: tacsim serve mock --task squeeze
    """
    require_packages("tacsim serve", "web", "starlette", "uvicorn", "websockets")
    token = _token(bind)
    with busy("loading"):
        from robot.deploy.policy import require_policy_name
        from robot.open import load_with_task
        from robot.serve.app import make_server
        from robot.serve.guard import Guard
        from robot.serve.session import Session

    if policy is not None:
        require_policy_name(policy)
    sys.path.append(str(Path.cwd()))  # --policy mine:act finds mine.py here
    loaded = load_with_task(rig, task, set_ or [])
    for words in loaded.notes:
        notes.print(words)
    own = loaded.config.task
    name = policy if policy is not None else ("grip" if own is None else "scripted")
    listening = _listen(bind, port)
    port = listening.getsockname()[1]
    guard = Guard({_with_port(each, port) for each in _names(bind, host or [])}, token)
    session = Session(loaded, name, out, on_failure=lambda: setattr(server, "should_exit", True))
    server = make_server(session, guard)
    with Interrupt(server.end) as interrupt, session:
        shown = (host or ["127.0.0.1"])[0] if bind in ANY_ADDRESS else bind
        results.print(f"http://{_with_port(shown, port)}/#token={token}")
        if bind in ANY_ADDRESS and not host:
            notes.print("Other machines are refused: give the name or address by which they open the page, --host NAME")
        notes.print("Ctrl-C stops the arms and ends the server.")
        if not interrupt():  # from here on a signal ends the server in order
            server.run(sockets=[listening])
        if words := session.recordings.report_state:
            notes.print(f"{words}; Ctrl-C again ends without it, the recording is complete")
    if session.failure is not None:
        raise session.failure
    raise typer.Exit(interrupt.exit_code)


def _names(bind: str, more: list[str]) -> set[str]:
    """Names of this machine that a page's address may have."""
    return {*LOOPBACK, *more} | ({bind} - set(ANY_ADDRESS))


def _with_port(name: str, port: int) -> str:
    return f"[{name}]:{port}" if ":" in name else f"{name}:{port}"


def _token(bind: str) -> str:
    """The operator's token: that of the environment, else a new one. Raises typer.BadParameter."""
    token = os.environ.get(TOKEN, "")
    if token and (len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable() or " " in token):
        raise typer.BadParameter(f"{TOKEN} must have at least {MIN_TOKEN} printable characters without spaces")
    if not token and bind not in LOOPBACK:
        words = f"{bind} can be reached from other machines: set {TOKEN} to a secret of {MIN_TOKEN} characters or more"
        raise typer.BadParameter(words, param_hint="--bind")
    return token or secrets.token_urlsafe(24)


def _listen(bind: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    found = socket.socket(family, socket.SOCK_STREAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        found.bind((bind, port))
        found.listen(64)  # a browser that is quicker than the server waits
    except OSError as failure:
        found.close()
        words = f"{bind}:{port} cannot be listened on ({failure.strerror}); choose another --port"
        raise typer.BadParameter(words, param_hint="--port") from None
    return found
