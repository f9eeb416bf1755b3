"""The process of a mock camera: `python -m robot.mock.camera`. It serves images until its standard input ends."""

from __future__ import annotations

import sys
import threading
from typing import Any

from robot.common.process import Arrays, Message, Parent
from robot.mock.camera.stream import FrameSource, Listener


def main() -> int:
    """Entry point of the process. The first message that it gets describes the camera (robot.mock.camera.camera). The
    first message that it sends contains its port, or the reason why it cannot serve."""
    parent = Parent()
    request = parent.receive()
    try:
        source = FrameSource(**request["source"])
        listener = Listener(request["host"], request["port"], source)
    except OSError as error:
        parent.send({"error": f"cannot serve at {request['host']}:{request['port']}: {error}"})
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
