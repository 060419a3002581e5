"""Control groups, version 1 or 2, made by hand as systemd makes them for the units."""

from __future__ import annotations

import contextlib
from pathlib import Path

_ROOT = Path("/sys/fs/cgroup")


class Cgroup:
    """A group of processes with a memory limit, and groups within it with CPU weights.

    Together they take precedence over other processes. Raises OSError if none can be made:
    that needs root, and the controllers.
    """

    def __init__(self, name: str, memory_mb: int) -> None:
        own = {}
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            own.update(dict.fromkeys(controllers.split(","), path.lstrip("/")))
        self.version = 1 if "memory" in own else 2
        self._made: list[Path] = []
        self._visitors = 0
        try:
            if self.version == 1:
                self._memory = self._make(_ROOT / "memory" / own["memory"] / name)
                self._home = _ROOT / "cpu" / own["cpu"]
                self._cpu = self._make(self._home / name)
                (self._cpu / "cpu.shares").write_text("262144")
                limit = self._memory / "memory.limit_in_bytes"
            else:
                self._memory = self._cpu = self._make(_ROOT / own[""] / name)
                (self._memory / "cgroup.subtree_control").write_text("+memory +cpu")
                (self._cpu / "cpu.weight").write_text("10000")
                limit = self._memory / "memory.max"
            limit.write_text(str(memory_mb * 1024 * 1024))
        except BaseException:
            self.remove()
            raise

    def _make(self, path: Path) -> Path:
        path.mkdir()
        self._made.append(path)
        return path

    def add(self, pid: int, name: str, cpu_weight: int) -> None:
        """Put a process into a separate group within this one; cpu_weight: systemd's CPUWeight."""
        folder = self._make(self._cpu / name)
        if self.version == 1:
            (folder / "cpu.shares").write_text(str(round(10.24 * cpu_weight)))
            (self._memory / "cgroup.procs").write_text(str(pid))
        else:
            (folder / "cpu.weight").write_text(str(cpu_weight))
        (folder / "cgroup.procs").write_text(str(pid))

    def add_visitors(self, pid: int) -> None:
        """Add a process whose memory does not count beside the others (version 1)."""
        if self.version == 1:
            folder = self._make(self._cpu / "visitors")
            (folder / "cgroup.procs").write_text(str(pid))
            self._visitors = pid

    def peak_mb(self) -> float:
        """Return the peak memory, MB, including the cache of files."""
        name = "memory.max_usage_in_bytes" if self.version == 1 else "memory.peak"
        return int((self._memory / name).read_text()) / 1024**2

    def kills(self) -> int:
        """Return how many of its processes were killed for lack of memory."""
        name = "memory.oom_control" if self.version == 1 else "memory.events"
        lines = (self._memory / name).read_text().split("\n")
        return sum(int(line.split()[1]) for line in lines if line.startswith("oom_kill "))

    def remove(self) -> None:
        """Remove all groups after their processes have ended; visitors return to their own."""
        if self._visitors:
            (self._home / "cgroup.procs").write_text(str(self._visitors))
        while self._made:
            with contextlib.suppress(OSError):
                self._made.pop().rmdir()
