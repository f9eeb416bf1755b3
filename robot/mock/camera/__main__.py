"""The process of a mock camera: `python -m robot.mock.camera`. It serves pictures until its standard input ends."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from typing import Any

from robot.common.process import Arrays, Message, Parent
from robot.mock.camera.camera import check_options
from robot.mock.camera.stream import FrameSource, Listener


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the process. Its first message is its port, or why it cannot serve."""
    parser = argparse.ArgumentParser(prog="python -m robot.mock.camera", description="MJPEG camera without a camera")
    parser.add_argument("--host", default="127.0.0.2")
    parser.add_argument("--port", type=int, default=0, help="0: any free one")
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=240)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--quality", type=int, default=95, help="of JPEG, 50 to 100")
    parser.add_argument("--stamped", action="store_true", help="strip with number and clock below each picture")
    parser.add_argument("--allow-network", action="store_true", help="serve to other machines, too")
    given = parser.parse_args(arguments)
    size = given.width, given.height, given.fps, given.quality
    parent = Parent()
    try:
        check_options(given.host, given.port, *size, allow_network=given.allow_network)
        source = FrameSource(*size, given.stamped)
        listener = Listener(given.host, given.port, source)
    except (OSError, ValueError) as error:
        parent.send({"error": f"cannot serve at {given.host}:{given.port}: {error}"})
        return 2
    threading.Thread(target=source.run, name="exposure", daemon=True).start()
    parent.send({"port": listener.port})
    parent.serve(lambda request, arrays: _answer(request, arrays, source, listener))
    source.close()
    listener.refuse()
    listener.disconnect()
    return 0


def _answer(request: dict[str, Any], arrays: Arrays, source: FrameSource, listener: Listener) -> Message:
    command, value = request["do"], request.get("value")
    result: object = None
    if command == "push":
        result = source.push(arrays["picture"])
    elif command == "disconnect":
        result = listener.disconnect()
    elif command == "state":
        result = {**source.state(), "clients": listener.clients()}
    else:
        if command == "refuse":
            listener.refuse() if value else listener.listen()
        source.set_fault(command, value)
    return {"result": result}, {}


if __name__ == "__main__":
    sys.exit(main())
