"""An output in its own thread: one that is slow or gone loses its oldest results, nothing else."""

from __future__ import annotations

import logging
import threading
from collections import deque
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.device_loop import Link

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from thermocald.acquisition.device_loop import LinkEvent
    from thermocald.hal import Clock, Output


log = logging.getLogger(__name__)

_QUEUE = 200


class OutputLoop:
    """Hands results to one output, in order."""

    def __init__(
        self, name: str, output: Output, clock: Clock, on_event: Callable[[LinkEvent], None]
    ) -> None:
        self.link = Link("output", name, output, clock, on_event=on_event)
        self.emitted = 0
        self.lost = 0
        self._output = output
        self._queue: deque[Mapping[str, Any]] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=f"output {name}", daemon=True)

    def start(self) -> None:
        """Start the thread; the output is opened in it."""
        self._thread.start()

    def put(self, result: Mapping[str, Any]) -> None:
        """Hand over a result; returns at once."""
        with self._changed:
            if len(self._queue) >= _QUEUE:
                self._queue.popleft()
                self.lost += 1
            self._queue.append(result)
            self._changed.notify_all()

    def stop(self, grace_s: float) -> bool:
        """Emit what waits, within the grace, and close."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join(grace_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        self.link.call(lambda: True)
        while True:
            with self._changed:
                while not self._queue and not self._stopping:
                    self._changed.wait(1.0)
                if not self._queue:
                    break
                result = self._queue[0]
            if self._emit(result):
                self.emitted += 1
            elif self._stopping or self.link.ended:
                self.lost += 1
            else:
                with self._changed:
                    self._changed.wait(0.5)  # what waits is emitted once the output is back
                continue
            with self._changed:
                if self._queue and self._queue[0] is result:
                    self._queue.popleft()
        self.link.close()

    def _emit(self, result: Mapping[str, Any]) -> bool:
        def action() -> bool:
            self._output.emit(result)
            return True

        return bool(self.link.call(action))
