"""Starts daemons by fork after all imports: 200 starts in the time of ten.

As a program it reads one JSON document per line: {"arguments", "folder", "environment", "script",
"log"} forks a child that runs the command or the script, if given, and prints its process id;
{"ended": id} prints the exit status of a child that has ended.
"""

from __future__ import annotations

import atexit
import faulthandler
import json
import os
import select
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn


class Forker:
    """This file as a program, and the daemons that it starts."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stdout.readline() == "ready\n"

    def start(
        self, folder: Path, *arguments: str, script: str = "", log: str = "log.txt",
        **environment: str,
    ) -> Forked:  # fmt: skip
        """Start `thermocald ARGUMENTS`, or a script, in a folder with its log."""
        (folder / log).touch()  # a reader need not wait for the child
        asked = {"arguments": arguments, "folder": str(folder), "environment": environment,
                 "script": script, "log": log}  # fmt: skip
        return Forked(self, self.ask(asked), folder / log)

    def ask(self, document: dict[str, object]) -> int:
        self._process.stdin.write(json.dumps(document) + "\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait(10)
        self._process.stdout.close()


class Forked:
    """A daemon started by fork; used as a `subprocess.Popen`."""

    def __init__(self, forker: Forker, pid: int, log: Path) -> None:
        self.pid, self._log = pid, log
        self.returncode: int | None = None
        self._forker = forker
        self._handle = os.pidfd_open(pid)

    def poll(self) -> int | None:
        return self._ended(0.0)

    def wait(self, timeout_s: float | None = None) -> int:
        status = self._ended(timeout_s)
        if status is None:
            raise subprocess.TimeoutExpired("thermocald", timeout_s)
        return status

    def _ended(self, timeout_s: float | None) -> int | None:
        if self.returncode is None and select.select([self._handle], [], [], timeout_s)[0]:
            os.close(self._handle)
            self.returncode = self._forker.ask({"ended": self.pid})
        return self.returncode

    def said(self, timeout_s: float | None = 120.0) -> str:
        """Wait for the process to end, and return its output."""
        self.wait(timeout_s)
        return self.printed()

    def printed(self) -> str:
        """Return its output so far."""
        return self._log.read_text()

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _work(script: str) -> NoReturn:
    """Run a script or the command line, and exit without unloading the modules."""
    status = 0
    try:
        exec(script or "import thermocald.cli; thermocald.cli.main()", {})
    except SystemExit as ended:
        if isinstance(ended.code, str):  # is said, as the interpreter's own end does
            print(ended.code, file=sys.stderr)
        status = 1 if isinstance(ended.code, str) else int(ended.code or 0)
    except BaseException:
        traceback.print_exc()
        status = 1
    threading._shutdown()  # waits for threads as the interpreter's own end does
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        if not stream.closed:
            stream.flush()
    os._exit(status)


def main() -> None:
    import thermocald_drivers.jsonl
    import thermocald_drivers.mock
    import thermocald_drivers.replay  # noqa: F401

    import thermocald.analysis.online.observer
    import thermocald.analysis.online.running_series
    import thermocald.cli.run
    import thermocald.daemon.service  # noqa: F401

    print("ready", flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        if "ended" in asked:
            status = os.waitstatus_to_exitcode(os.waitpid(asked["ended"], 0)[1])
            print(status, flush=True)
            continue
        pid = os.fork()
        if pid == 0:
            os.chdir(asked["folder"])
            os.environ.update(asked["environment"])
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            sys.argv = ["thermocald", *asked["arguments"]]
            log = os.open(asked["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.dup2(log, 1)
            os.dup2(log, 2)
            faulthandler.enable()  # a crash leaves its stack in the log
            _work(asked["script"])
        print(pid, flush=True)


if __name__ == "__main__":
    main()
