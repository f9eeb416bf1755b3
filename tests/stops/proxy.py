"""A network that fails, between a driver and a controller: `python proxy.py HOST ROBOT`, a process of its own.

It listens on HOST at the controller's ports and forwards to ROBOT. Lines of JSON on standard input break it:
{"do": "cut", "ports": [30004], "reset": true, "back": 0.1} closes connections to these ports, with RST or FIN, and
refuses new ones for so many seconds; {"do": "hold", "ports": [...], "ways": ["pc", "robot"], "back": 1.0} forwards
nothing to the PC, to the robot or to both for so long, and then all that was kept (a cable that is plugged in again).
"back": null is never. It answers each line with the monotonic time at which it was done.
"""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import sys
import time
from dataclasses import dataclass, field

PORTS = (29999, 30001, 30002, 30003, 30004)
RESET = struct.pack("ii", 1, 0)  # SO_LINGER of 0 s: close() sends RST
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@dataclass
class Port:
    """One port of the controller."""

    refused: bool = False
    links: list[asyncio.StreamWriter] = field(default_factory=list)  # both ends of each connection
    open_ways: dict[str, asyncio.Event] = field(default_factory=dict)  # "pc", "robot"


class Proxy:
    def __init__(self, host: str, robot: str) -> None:
        self.host, self.robot = host, robot
        self.ports = {number: Port() for number in PORTS}
        self.servers: dict[int, asyncio.Server] = {}
        self.later: set[asyncio.Task[None]] = set()

    async def serve(self) -> None:
        for number, port in self.ports.items():
            port.open_ways = {"pc": asyncio.Event(), "robot": asyncio.Event()}
            for way in port.open_ways.values():
                way.set()
            await self._listen(number)
        lines = asyncio.StreamReader()
        await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
        print("ready", flush=True)
        while line := await lines.readline():
            wish = json.loads(line)
            for number in wish["ports"]:
                await (self._cut if wish["do"] == "cut" else self._hold)(number, wish)
            print(time.monotonic(), flush=True)

    async def _listen(self, number: int) -> None:
        async def accepted(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            try:
                there = await asyncio.open_connection(self.robot, number)
            except OSError:
                writer.transport.abort()
                return
            port = self.ports[number]
            port.links += [writer, there[1]]
            for each in (writer, there[1]):
                each.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            await asyncio.gather(
                self._forward(reader, there[1], port.open_ways["robot"]),
                self._forward(there[0], writer, port.open_ways["pc"]),
            )

        self.servers[number] = await asyncio.start_server(accepted, self.host, number)

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, way: asyncio.Event) -> None:
        try:
            while data := await reader.read(1 << 16):
                await way.wait()
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            await way.wait()
            writer.close()

    async def _cut(self, number: int, wish: dict[str, object]) -> None:
        port = self.ports[number]
        if wish["back"] != 0:
            self.servers.pop(number).close()
        for link in port.links:
            if link.is_closing():
                continue
            if wish["reset"]:
                link.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
                link.transport.abort()
            else:
                link.close()
        port.links.clear()
        if wish["back"]:
            self._soon(float(wish["back"]), self._listen(number))  # type: ignore[arg-type]

    async def _hold(self, number: int, wish: dict[str, object]) -> None:
        ways = [self.ports[number].open_ways[name] for name in wish["ways"]]  # type: ignore[attr-defined]
        for way in ways:
            way.clear()

        async def open_again() -> None:
            for way in ways:
                way.set()

        if wish["back"] is not None:
            self._soon(float(wish["back"]), open_again())  # type: ignore[arg-type]

    def _soon(self, seconds: float, then: object) -> None:
        async def work() -> None:
            await asyncio.sleep(seconds)
            await then  # type: ignore[misc]

        self.later.add(asyncio.create_task(work()))


if __name__ == "__main__":
    asyncio.run(Proxy(*sys.argv[1:]).serve())
