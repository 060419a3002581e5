"""Kills with everything beside the writer that can stand there: what was reported is kept.

`THERMOCALD_KILLS=300` runs as many as were promised once; the slow suite runs some of each kind.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.conftest import ENVIRONMENT, make_recording
from thermocald.errors import StoreError
from thermocald.store.database.store import Store

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("THERMOCALD_KILLS", "36"))
# As a daemon keeps epochs: through its guard; says after each what it has reported as kept.
DAEMON = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    import numpy as np
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.series import EpochResult

    guard = StoreGuard(Path(sys.argv[1]), durable=False)
    (series,) = guard.store.all_series()
    number = (guard.store.last_epoch(series) or 0) + 1
    while True:
        seen = Observations(np.arange(12), np.full((12, 2), float(number)), np.ones((12, 2)))
        result = EpochResult("ok", "", np.full(16, float(number)), np.eye(16))
        guard.store.append(series, Epoch(number, 10.0 * number, np.nan, observations=seen), result)
        sys.stdout.write(f"{number}\\n")
        sys.stdout.flush()
        number += 1
    """
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return make_recording(tmp_path_factory.mktemp("kills") / "small", 6)


@pytest.fixture(scope="module")
def other_device(tmp_path_factory):
    """A folder on another device than that of the tests, or a reason to skip."""
    for place in ("/dev/shm", "/var/tmp", str(Path.home())):
        folder = Path(place)
        if folder.is_dir() and folder.stat().st_dev != tmp_path_factory.getbasetemp().stat().st_dev:
            made = folder / f"thermocald-kills-{os.getpid()}"
            made.mkdir()
            yield made
            shutil.rmtree(made)
            return
    pytest.skip("there is one device only")


def writes(*arguments) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "thermocald", *map(str, arguments)],
        env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def beside(kind: str, store: Path, recording: Path, k: int) -> list[subprocess.Popen]:
    """What stands beside the writer, and processes that try to write too."""
    other = store.with_name(f"other-{k}.db")
    link = store.with_name(f"link-{k}.db")
    if kind == "hard link":
        os.link(store, other)
        return [writes("replay", recording, "--store", other)]
    if kind == "soft link":
        link.symlink_to(store)
        return [writes("replay", recording, "--store", link)]
    if kind == "copies":
        for name in (store.name, f"{store.name}-wal", f"{store.name}-shm"):
            if (source := store.with_name(name)).exists():
                shutil.copy(source, other.with_name(name.replace(store.name, other.name)))
        return []
    if kind == "second daemon":
        return [subprocess.Popen([sys.executable, "-c", DAEMON, store], stdout=subprocess.DEVNULL,
                                 stderr=subprocess.DEVNULL)]  # fmt: skip
    if kind == "replay":
        return [writes("replay", recording, "--store", store)]
    if kind == "run":
        return [writes("run", "--recording", recording, "--store", store, "--fast")]
    if kind == "readers":
        return [writes("check", store), writes("backup", store, other)]
    return []


KINDS = ["alone", "hard link", "soft link", "copies", "second daemon", "replay", "run", "readers"]


def kill_one(store: Path, start, rng) -> int:
    """Start the writer, and what `start` begins once it writes; the last epoch it reported."""
    writer = subprocess.Popen([sys.executable, "-c", DAEMON, str(store)], stdout=subprocess.PIPE)
    said = [writer.stdout.readline()]
    others = start()
    said += [writer.stdout.readline() for _ in range(int(rng.integers(1, 60)))]
    time.sleep(float(rng.uniform(0, 0.02)))
    os.kill(writer.pid, signal.SIGKILL)
    said += writer.stdout.read().splitlines()
    writer.stdout.close()
    writer.wait()
    for other in others:
        if rng.random() < 0.5:
            other.kill()
        # a second daemon takes over where the first was killed: that is what it is for
        try:
            other.wait(timeout=5)
        except subprocess.TimeoutExpired:
            other.kill()
            other.wait()
    return int([line for line in said if line.strip()][-1])


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_reported_is_kept(store_path, head, field, recording, kind):
    _kill_often(store_path, head, field, recording, kind, max(KILLS // (len(KINDS) + 1), 3))


def test_links_over_devices(other_device, tmp_path, head, field, recording):
    """The store on one device, its name on another, and the writer knows the name alone."""
    real = other_device / "real.db"
    name = tmp_path / "named.db"
    name.symlink_to(real)
    with pytest.raises(OSError, match="cross-device"):
        os.link(other_device, tmp_path / "hard")
    _kill_often(name, head, field, recording, "replay", max(KILLS // (len(KINDS) + 1), 3))
    assert real.is_file()
    assert name.is_symlink()


def _kill_often(store_path, head, field, recording, kind, times) -> None:
    with Store.open(store_path, "append", durable=False) as store:
        store.create_series(head, field)
    rng = np.random.default_rng(len(kind))
    reported, before = 0, 0
    for k in range(times):
        said = kill_one(store_path, lambda k=k: beside(kind, store_path, recording, k), rng)
        for name in store_path.parent.glob("other-*.db"):
            name.unlink()  # a daemon writes on beside a hard link; nothing else would
        reported += said - before
        with Store.open(store_path) as store:
            store.check()
            series = next(s for s in store.all_series() if s.name == head.series)
            numbers = [s.epoch.number for s in store.epochs(series)]
            assert numbers == list(range(1, len(numbers) + 1))
            assert len(numbers) >= said, f"{said - len(numbers)} reported epochs are missing"
            if kind != "second daemon":
                assert len(numbers) <= said + 1
            # those beside it were refused, or wrote once it was dead: theirs is another series
            assert len(store.all_series()) <= 2
            values = store.series_columns(series, ["c"])["c"].tolist()
            assert values == [float(number) for number in numbers]
        before = len(numbers)
    assert reported > times


def test_a_name_that_lacks_the_wal_is_not_read_as_whole(store_path, head, field, recording):
    """While the writer is dead and its -wal waits: a hard link shows the store without it."""
    with Store.open(store_path, "append", durable=False) as store:
        store.create_series(head, field)
    rng = np.random.default_rng(1)
    said = kill_one(store_path, list, rng)
    other = store_path.with_name("other.db")
    os.link(store_path, other)
    with pytest.raises(StoreError, match="another of its names"):
        Store.open(other)
    with Store.open(store_path) as store:
        assert store.last_epoch(next(iter(store.all_series()))) >= said
