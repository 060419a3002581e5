"""Every command of the documentation runs, page by page, in a folder that was prepared for it.

What cannot run here stands in small tables with its reason.
"""

from __future__ import annotations

import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Self

import pytest

from tests.docs.blocks import PAGES, ROOT, Block, all_blocks, blocks, name
from tests.docs.worlds import AFTER, WORLDS
from tests.marks import mostly_slow
from thermocald.store.database.store import Store

NOT_RUN = {
    "sudo ": "changes the machine as root; .ci/deb, tests/hil, tests/daemon/test_systemd.py",
    "systemctl ": "needs the installed service; tests/hil boots it",
    "make ": "runs this test, or what .ci and other tests run",
    "docker ": "needs a container engine; tests/packaging/test_container.py",
    "pip install ": "needs a package index",
    "pipx install ": "needs a package index",
    "python3 -m venv ": "an environment; `make setup` makes one",
    ".venv/bin/pip install ": "needs a package index",
    "source .venv/bin/activate": "needs that environment",
    "adb ": "starts a server that outlives the test; tests/hil has a real one",
    "rpicam-still ": "needs a Raspberry Pi; photographs are rendered instead",
    "python -m tests.": "minutes or hours; test_score.py and test_real_corners.py score a part",
    "thermocald doctor": "its exit status is the machine's; tests/packaging/test_doctor.py",
}
"""Beginning of a command → why it is not run."""

ELSEWHERE = {
    "thermocald study --reference --report reference.html": (
        "tests/cli/test_study_command.py", 'document("study", "--reference")',
    ),
    "python -m benchmarks.audit": ("tests/test_audit.py", "from benchmarks.audit import"),
    "python -m benchmarks.object_space": (
        "tests/docs/test_object_space.py", "from benchmarks.object_space import",
    ),
}  # fmt: skip
"""Command → the test that runs it, and what stands there."""

SHORTENED = {
    "--epochs 150": ("--epochs 30", "25 minutes of a camera"),
    "thermocald demo --out demo": ("thermocald demo --out demo --epochs 12", "a minute"),
}
"""Part of a command → what is run instead, and what it would take."""


def epochs_in(name: str):
    """Whether so many epochs were kept in a store of the folder."""

    def kept(folder: Path, _: str) -> bool:
        with suppress(OSError, ValueError), Store.open(folder / name) as store:
            return any((store.last_epoch(s) or 0) >= 2 for s in store.all_series())
        return False

    return kept


def daemon_listens(folder: Path, _: str) -> bool:
    """Whether it keeps epochs and can be asked."""
    socket = folder / "thermocald.db.live" / "control.sock"
    return socket.exists() and epochs_in("thermocald.db")(folder, "")


UNTIL = {
    "thermocald run --config config.yaml": daemon_listens,
    "thermocald run --mock": epochs_in("thermocald-mock.db"),
    "thermocald top --config config.yaml": lambda _, output: "demo" in output,
    "thermocald dashboard --store thermocald.db": lambda _, output: "http://127.0.0.1" in output,
}
"""Commands that run until Ctrl-C: what must have come of them before they get it."""

STAYS = {"thermocald run --config config.yaml"}
"""Of these, what runs on while the rest of the page is done."""

SHOWN = {"docs/tutorial/raspberry-pi.md", "docs/tutorial/river.md"}
"""Pages whose `text` blocks are what the command before them says of this world."""

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
# `top` draws where it believes in a terminal, and one that can move its cursor
ENVIRONMENT = {
    **os.environ, "PATH": PATH, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1",
    "COLUMNS": "120", "FORCE_COLOR": "1", "TERM": "xterm",
}  # fmt: skip
PATIENCE_S = 240.0


@pytest.fixture(scope="session")
def shelf(tmp_path_factory) -> Path:
    """Where simulated recordings are made once."""
    return tmp_path_factory.mktemp("shelf")


class Page:
    """The commands of one page, one after the other, in one folder."""

    def __init__(self, page: str, shelf: Path, folder: Path) -> None:
        self.page, self.shelf, self.folder = page, shelf, folder
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.output = folder / "output-0"
        """Where the last command's output goes; one that stays goes on writing to its own."""

    def run(self, block: Block) -> None:
        if block.language == "python":
            (self.folder / "block.py").write_text(block.text)
            self.command("python block.py")
        elif block.language == "sql":
            with closing(sqlite3.connect(self.folder / "thermocald.db")) as database:
                assert database.execute(block.text).fetchall()
        elif block.language == "text" and self.page in SHOWN:
            self.compare(block)
        for command in block.commands() if block.language == "bash" else ():
            if not skipped(command):
                self.command(command)
            if (self.page, command) in AFTER:
                AFTER[self.page, command](self.shelf, self.folder)

    def command(self, command: str) -> None:
        shortened = command
        for part, (instead, _) in SHORTENED.items():
            shortened = shortened.replace(part, instead)
        self.output = self.folder / f"output-{int(self.output.name[7:]) + 1}"
        with self.output.open("w") as output:
            process = self.running[command] = subprocess.Popen(
                ["bash", "-euo", "pipefail", "-c", shortened], cwd=self.folder, env=ENVIRONMENT,
                stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip
        if command not in UNTIL:
            assert self.finish(command) == 0, f"{self.page}: {command}:\n{self.said()[-3000:]}"
            assert "Traceback" not in self.said()
            assert "Warning" not in self.said(), self.said()
            return
        deadline = time.monotonic() + PATIENCE_S
        while not UNTIL[command](self.folder, self.said()):
            assert process.poll() is None, f"{self.page}: {command} ended:\n{self.said()}"
            assert time.monotonic() < deadline, f"{self.page}: {command}:\n{self.said()}"
            time.sleep(0.2)
        if command not in STAYS:
            self.interrupt(command)

    def said(self) -> str:
        return self.output.read_text(errors="replace")

    def finish(self, command: str) -> int:
        status = self.running[command].wait(PATIENCE_S)
        del self.running[command]
        return status

    def interrupt(self, command: str) -> None:
        """Ctrl-C."""
        os.killpg(self.running[command].pid, signal.SIGINT)
        assert self.finish(command) in (0, 130), command

    def compare(self, block: Block) -> None:
        """Every line of the block was said, with numbers that agree to 3 %."""
        said = " ".join(self.said().split())
        for line in block.text.splitlines():
            shown = " ".join(line.split())
            pattern = f"({NUMBER.pattern})".join(map(re.escape, NUMBER.split(shown)))
            expected = [float(n) for n in NUMBER.findall(shown)]
            found = [[float(n) for n in m.groups()] for m in re.finditer(pattern, said)]
            assert found, f"{self.page}:{block.line}: not said: {shown}\n{said[-2000:]}"
            near = pytest.approx(expected, rel=0.03, abs=0.005)
            assert any(numbers == near for numbers in found), (shown, found)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.running.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def skipped(command: str) -> bool:
    return command.startswith(tuple(NOT_RUN)) or command in ELSEWHERE


def runnable(page: Path) -> bool:
    return any(
        b.language == "sql"
        or (b.language == "python" and b.page != "drivers/README.md")  # drivers/test_example.py
        or (b.language == "bash" and not all(map(skipped, b.commands())))
        for b in blocks(page)
    )


@pytest.mark.timeout(1500)  # a tutorial is several series and their analysis
@pytest.mark.parametrize(
    "page",
    mostly_slow([p for p in PAGES if runnable(p)], ROOT / "docs/reference/store.md"),
    ids=name,
)
def test_the_commands_of_a_page_run(page, shelf, tmp_path):
    for put in WORLDS.get(name(page), ()):
        put(shelf, tmp_path)
    with Page(name(page), shelf, tmp_path) as opened:
        for block in blocks(page):
            opened.run(block)
        for command in list(opened.running):
            opened.interrupt(command)


def test_what_is_not_run_here_exists_and_is_run_elsewhere():
    commands = {c for b in all_blocks("bash") for c in b.commands()}
    assert (set(ELSEWHERE) | set(UNTIL) | {command for _, command in AFTER}) - commands == set()
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    assert {c.split()[1] for c in commands if c.startswith("make ")} - targets == set()
    for file, text in ELSEWHERE.values():
        assert text in (ROOT / file).read_text()


def test_a_token_made_as_the_page_says_can_be_part_of_an_address(tmp_path):
    (block,) = [b for b in all_blocks("bash") if "/dev/urandom" in b.text]
    for _ in range(20):  # base64 has a + or / in nearly every second one
        subprocess.run(["bash", "-c", block.text], check=True, cwd=tmp_path)
        assert re.fullmatch(r"[\w-]{32}\n", (tmp_path / "token").read_text())


def test_installed_files_exist():
    """What the commands that need root refer to."""
    text = (ROOT / "docs/how-to/install.md").read_text()
    for file in re.findall(r"systemd/[\w.@-]+", text):
        assert (ROOT / file).exists(), file
    for unit in re.findall(r"systemctl (?:enable --now|status|edit|reload) ([\w. -]+)", text):
        for word in unit.split():
            stem = word.partition(".")[0]
            assert list((ROOT / "systemd").glob(f"{stem}*")), word
