"""Live numbers of a session: a line that is rewritten on a terminal, some lines otherwise."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Mapping
from typing import Any

from thermocald.cli.common import say
from thermocald.output.figures.numbers import with_sd

__all__ = ["Progress"]

_LINE_EVERY_S = 10.0


class Progress:
    """Told a few times a second how a camera is doing; total: epochs, done: of an earlier run."""

    def __init__(self, total: int, done: int = 0) -> None:
        self._total = total
        self._shown = done
        self._told = float("-inf")
        self._paused = False

    def show(self, last: Mapping[str, Any], paused: str = "") -> None:
        """last: the last epoch's row, as outputs get it; paused: why there are none, if so."""
        if paused and not self._paused:
            say(f"paused: {paused}")
        if self._paused and not paused:
            say("the camera is back")
        self._paused = bool(paused)
        if not last or last["epoch"] <= self._shown:
            return
        self._shown = last["epoch"]
        temperature = last.get("temperature")
        line = f"epoch {last['epoch']} of {self._total}: "
        line += "" if temperature is None else f"{temperature:.2f} °C, "
        if last["status"] == "ok":
            line += f"c {with_sd(last['c'], last['sd_c'], 'mm')}, sigma0 {last['sigma0']:.2f}"
            line += f", {last['online'].get('sentence', '')}"
        else:
            line += f"{last['status']}: {last['reason']}"
        now = time.monotonic()
        if sys.stderr.isatty():
            # a longer line would leave its beginning on the screen
            room = shutil.get_terminal_size().columns - 1
            sys.stderr.write(f"\r\x1b[K{line[:room]}")
            sys.stderr.flush()
        elif now - self._told >= _LINE_EVERY_S or self._shown == self._total:
            self._told = now
            say(line)
