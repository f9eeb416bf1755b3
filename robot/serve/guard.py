"""Which requests the live page serves.

Anyone who can reach the page may look and stop. What starts motion or changes files needs the token, which the command
prints with the page's address. A request must name a host that the server was started for (a name of another site that
resolves to this machine is refused: DNS rebinding), and one of a browser must come from the server's own page.
"""

from __future__ import annotations

import hmac
from collections.abc import Collection

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

STOP_PATH = "/stop"
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
}


class Guard:
    """hosts: names with port that a request may be addressed to ("127.0.0.1:8765"). token: of the operator."""

    def __init__(self, hosts: Collection[str], token: str) -> None:
        self._hosts, self._token = frozenset(host.lower() for host in hosts), token

    def refuse_address(self, connection: HTTPConnection) -> str | None:
        """Why a request is refused for its Host or Origin; None if it is served."""
        host = connection.headers.get("host", "").lower()
        if host not in self._hosts:
            return f"this server is not '{host}'; start it with --host, or open the address that it printed"
        origin = connection.headers.get("origin")
        if origin is not None and origin.lower().partition("://")[2] not in self._hosts:
            return "a page of another site asked"
        return None

    def refuse_token(self, given: str) -> str | None:
        """Why a token is refused; None for the right one."""
        is_right = hmac.compare_digest(given.encode(), self._token.encode())
        return None if is_right else "the token is missing or wrong; open the address that the command printed"


class GuardedApp:
    """Applies a guard's `refuse_address` to all requests and WebSockets of `app` but STOP, and sets safe headers."""

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self._app, self._guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = None if scope["path"] == STOP_PATH else self._guard.refuse_address(HTTPConnection(scope))
        if refusal is None:
            await self._app(scope, receive, send_with_headers)
        elif scope["type"] == "http":
            await JSONResponse({"error": refusal}, 403)(scope, receive, send_with_headers)
        else:  # before it is accepted: the server answers 403
            await send({"type": "websocket.close", "code": 1008, "reason": refusal})
