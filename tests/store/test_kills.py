"""300 kills with all that can be beside a writer: what was reported as stored is stored.

All processes are forked from one with all imports done: two minutes instead of an hour.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.conftest import make_recording
from tests.daemon.forking import Forked, Forker
from thermocald.errors import StoreError
from thermocald.store.database.store import Store

pytestmark = pytest.mark.slow

KILLS = 300
_TAKEOVER_S = 0.2  # for a second daemon after the first was killed, as it would write on for ever
# As a daemon stores epochs: through its guard; prints after each what it reported as stored.
DAEMON = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    import numpy as np
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.series import EpochResult

    guard = StoreGuard(Path(sys.argv[2]), durable=False)
    (series,) = guard.store.all_series()
    number = (guard.store.last_epoch(series) or 0) + 1
    while True:
        seen = Observations(np.arange(12), np.full((12, 2), float(number)), np.ones((12, 2)))
        result = EpochResult("ok", "", np.full(16, float(number)), np.eye(16))
        guard.store.append(series, Epoch(number, 10.0 * number, np.nan, observations=seen), result)
        print(number, flush=True)
        number += 1
    """
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return make_recording(tmp_path_factory.mktemp("kills") / "small", 6)


@pytest.fixture(scope="module")
def other_device(tmp_path_factory):
    """Return a folder on another device than that of the tests, or skip."""
    for place in ("/dev/shm", "/var/tmp", str(Path.home())):
        folder = Path(place)
        if folder.is_dir() and folder.stat().st_dev != tmp_path_factory.getbasetemp().stat().st_dev:
            made = folder / f"thermocald-kills-{os.getpid()}"
            made.mkdir()
            yield made
            shutil.rmtree(made)
            return
    pytest.skip("there is one device only")


def beside(forker: Forker, kind: str, store: Path, recording: Path, k: int) -> list[Forked]:
    """Create the files beside the writer and start processes that try to write too."""

    def writes(*arguments: object, script: str = "") -> Forked:
        folder = store.parent / f"beside-{k}-{len(list(store.parent.glob(f'beside-{k}-*')))}"
        folder.mkdir()
        return forker.start(folder, *map(str, arguments), script=script)

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
        return [writes("daemon", store, script=DAEMON)]
    if kind == "replay":
        return [writes("replay", recording, "--store", store)]
    if kind == "run":
        return [writes("run", "--recording", recording, "--store", store, "--fast")]
    if kind == "readers":
        return [writes("check", store), writes("backup", store, other)]
    return []


KINDS = ["alone", "hard link", "soft link", "copies", "second daemon", "replay", "run", "readers"]


def kill_one(forker: Forker, store: Path, start, rng) -> int:
    """Start the writer, then `start`; kill it and return the last epoch that it reported."""
    folder = store.parent / f"writer-{len(list(store.parent.glob('writer-*')))}"
    folder.mkdir()
    writer = forker.start(folder, "daemon", str(store), script=DAEMON)

    def reported() -> list[str]:
        # the last line may be cut off
        return (folder / "log.txt").read_text().split("\n")[:-1]

    def until(count: int) -> None:
        deadline = time.monotonic() + 60.0
        while len(reported()) < count:
            assert writer.poll() is None, "the writer ended:\n" + (folder / "log.txt").read_text()
            assert time.monotonic() < deadline, reported()
            time.sleep(0.001)

    until(1)
    others = start()
    until(1 + int(rng.integers(1, 30)))
    time.sleep(float(rng.uniform(0, 0.02)))
    writer.kill()
    writer.wait()
    for other in others:
        if rng.random() < 0.5:
            other.kill()
        # a second daemon takes over after the first was killed, as intended
        try:
            other.wait(_TAKEOVER_S)
        except subprocess.TimeoutExpired:
            other.kill()
            other.wait()
    return int(reported()[-1])


@pytest.mark.parametrize("kind", KINDS)
def test_what_was_reported_is_kept(forker, store_path, head, field, recording, kind):
    _kill_often(forker, store_path, head, field, recording, kind)


def test_links_over_devices(forker, other_device, tmp_path, head, field, recording):
    """The store is on one device, its name on another, and the writer only knows the name."""
    real = other_device / "real.db"
    name = tmp_path / "named.db"
    name.symlink_to(real)
    with pytest.raises(OSError, match="cross-device"):
        os.link(other_device, tmp_path / "hard")
    _kill_often(forker, name, head, field, recording, "replay")
    assert real.is_file()
    assert name.is_symlink()


def _kill_often(forker, store_path, head, field, recording, kind) -> None:
    times = -(-KILLS // (len(KINDS) + 1))
    with Store.open(store_path, "append", durable=False) as store:
        store.create_series(head, field)
    rng = np.random.default_rng(len(kind))
    reported, before = 0, 0
    for k in range(times):
        said = kill_one(
            forker, store_path, lambda k=k: beside(forker, kind, store_path, recording, k), rng
        )
        for name in store_path.parent.glob("other-*.db"):
            name.unlink()  # a daemon writes on beside a hard link; nothing else would
        reported += said - before
        with Store.open(store_path) as store:
            assert store.examine().damaged == ()
            series = next(s for s in store.all_series() if s.name == head.series)
            numbers = [s.epoch.number for s in store.epochs(series)]
            assert numbers == list(range(1, len(numbers) + 1))
            assert len(numbers) >= said, f"{said - len(numbers)} reported epochs are missing"
            if kind != "second daemon":
                assert len(numbers) <= said + 1
            # the others were refused, or wrote after the kill into another series
            assert len(store.all_series()) <= 2
            values = store.series_columns(series, ["c"])["c"].tolist()
            assert values == [float(number) for number in numbers]
        before = len(numbers)
    assert reported > times


def test_a_name_that_lacks_the_wal_is_not_read_as_whole(forker, store_path, head, field):
    """After a kill, a hard link shows the store without the -wal of the other name."""
    with Store.open(store_path, "append", durable=False) as store:
        store.create_series(head, field)
    rng = np.random.default_rng(1)
    said = kill_one(forker, store_path, list, rng)
    other = store_path.with_name("other.db")
    os.link(store_path, other)
    with pytest.raises(StoreError, match="another of its names"):
        Store.open(other)
    with Store.open(store_path) as store:
        assert store.last_epoch(next(iter(store.all_series()))) >= said
