"""The daemon's live results equal those of `replay`, for real cameras and crooked fields.

With the user's commands: `run --recording R --fast` and `export` of the store; `export R`.
"""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import time
from pathlib import Path

import numpy as np
import pytest

from tests.commands import call
from tests.daemon.forking import Forker
from tests.main_paths import crooked
from tests.recordings import read_rows as rows
from tests.recordings import write_rows

REAL = ["aviary-cam0", "aviary-cam1", "aviary-cam2", "aviary-cam6"]
MAIN = ("c", "x0", "y0")


def good(table: list[dict[str, str]]) -> list[dict[str, str]]:
    return [r for r in table if r["status"] == "ok"]


def column(table: list[dict[str, str]], name: str) -> np.ndarray:
    return np.array([float(r[name]) for r in table])


def exported(source: Path, out: Path, *more: str) -> list[dict[str, str]]:
    """Export a recording or a store; return its table."""
    assert call("export", source, *more, "-o", out).returncode == 0
    return rows(out)


def live_and_replayed(forker: Forker, recording: Path, folder: Path):
    """Return a recording's live and replayed tables, which agree, and what the daemon printed.

    Epochs, rejections, sigma0 and the last result of the series are compared.
    """
    own = folder / recording.name
    if own != recording:
        shutil.copytree(recording, own)
    text = played(forker, own, folder / "live.db")
    live = exported(folder / "live.db", folder / "live.csv", "--extra")
    replayed = exported(own, folder / "r.csv")
    pairs = list(zip(live, replayed, strict=True))
    assert not {a["epoch"]: a["status"] for a, b in pairs if b["status"] == "ok" != a["status"]}
    a, b = good(live), good(replayed)
    # a live row has only the epochs so far, so the first rows have few
    rejected, expected = column(a, "n_rejected").sum(), column(b, "n_rejected").sum()
    seen = column(b, "n_observations").sum()
    assert rejected <= 1.3 * expected + 10 + 0.002 * seen, (rejected, expected)
    ratio = np.median(column(a, "sigma0")) / np.median(column(b, "sigma0"))
    assert 0.93 <= ratio <= 1.07, f"sigma0 {ratio:.3f} of replay's"
    assert column(a, "sigma0").max() < 3 * np.median(column(a, "sigma0"))
    for name in MAIN:  # the result of the series, not of the epoch
        difference = float(a[-1][f"series_{name}"]) - float(b[-1][name])
        assert abs(difference) <= 0.2 * float(b[-1][f"sd_{name}"]), f"last epoch's {name}"
    return live, replayed, text


@pytest.mark.slow
@pytest.mark.parametrize("camera", REAL)
def test_real_cameras(shared, forker, tmp_path, camera):
    """Fixed cameras, stable for 50 s, scatter as their sds state."""
    live, replayed, text = live_and_replayed(forker, shared / "data" / camera, tmp_path)
    assert len(good(live)) == len(good(replayed)) >= 100
    assert "was moved" not in text
    for name in MAIN:
        values, sds = column(good(live), name), column(good(live), f"sd_{name}")
        each = (values - values.mean()) / sds
        ratio = each.std(ddof=1)
        # the aim is 0.9 to 1.1; eight of cam1's targets wander, which its first rows do not show
        most = 1.4 if camera == "aviary-cam1" else 1.25
        assert ratio <= most, f"{name}: {ratio:.2f} sd"
        # the first nine have the stated noise, which is too large
        assert each[9:].std(ddof=1) >= 0.75, f"{name}: {each[9:].std(ddof=1):.2f} sd"
    # over the whole table; cam1 loses half of its boards
    spread = column(good(live), "c").std() / np.median(column(good(live), "sd_c"))
    assert 0.6 < spread < 1.5, f"c scatters {spread:.2f} of the usual sd"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "epochs"), [("badly_surveyed", 40), *((kind, 70) for kind in crooked.KINDS)]
)
def test_crooked_fields(forker, tmp_path, kind, epochs):
    """Errors of live rows about their mean agree with their sds."""
    truth = crooked.write(tmp_path / kind, kind, seed=1, epochs=epochs)
    live, _, text = live_and_replayed(forker, tmp_path / kind, tmp_path)
    assert len(good(live)) == epochs
    assert kind == "knocked" or "was moved" not in text
    for name in MAIN:
        error = column(live, name) - truth[name]
        ratio = (error - error.mean()).std() / np.median(column(live, f"sd_{name}"))
        assert 0.6 <= ratio <= 1.4, f"errors of {name} are {ratio:.2f} of their sd"


@pytest.mark.slow
def test_frames_of_crooked_planes(forker, tmp_path):
    """Rendered frames of a field with bent planes, surveyed to 2 µm."""
    truth = crooked.write_frames(tmp_path / "frames", 14, seed=3)
    live, _, text = live_and_replayed(forker, tmp_path / "frames", tmp_path)
    assert len(good(live)) == 14
    assert "was moved" not in text
    error = column(live, "c") - truth["c"]
    assert abs(error - error.mean()).max() < 5 * np.median(column(live, "sd_c"))


@pytest.mark.slow
@pytest.mark.parametrize("camera", REAL)
def test_a_steady_temperature(shared, forker, tmp_path, camera):
    """With a constant temperature, the sway of the mounts gives no knock and no slip."""
    shutil.copytree(shared / "data" / camera, own := tmp_path / camera)
    heads = rows(own / "epochs.csv")
    for k, row in enumerate(heads):
        row["temperature"] = f"{25.0 + 0.0625 * (k % 3 == 0):.4f}"
        row["temperature_time"] = row["frame_time"]
    write_rows(own / "epochs.csv", heads)
    _, _, text = live_and_replayed(forker, own, tmp_path)
    # cam2 twice moves by 0.2 px for two epochs
    assert text.count("was moved") + text.count("slipped") <= 2 * (camera == "aviary-cam2")


def part_of(
    recording: Path, part: Path, first: int, every: int = 1, drawn: tuple[int, int] | None = None
) -> Path:
    """Copy a recording from epoch `first` on, with every `every`-th target.

    drawn: (seed, number) of randomly drawn targets instead.
    """
    shutil.copytree(recording, part)
    heads = [r for r in rows(part / "epochs.csv") if int(r["epoch"]) >= first]
    table, epochs = rows(part / "observations.csv"), {r["epoch"] for r in heads}
    kept = sorted({r["target"] for r in table})[::every]
    if drawn is not None:
        kept = np.random.default_rng(drawn[0]).choice(kept, drawn[1], replace=False).tolist()
    write_rows(part / "epochs.csv", heads)
    table = [r for r in table if r["epoch"] in epochs and r["target"] in kept]
    write_rows(part / "observations.csv", table)
    return part


def test_a_part_of_a_real_camera(shared, forker, tmp_path):
    """Every other target and the last 30 epochs, a recording used in no other test."""
    part = part_of(shared / "data" / "aviary-cam0", tmp_path / "part", 72, every=2)
    live_and_replayed(forker, part, tmp_path)


@pytest.mark.slow
def test_epochs_too_weak_for_single_calibration(shared, forker, tmp_path):
    """y0 of a single epoch has an sd of 80 px; together, the epochs determine it."""
    part = part_of(shared / "data" / "aviary-cam1", tmp_path / "part", 62, every=5)
    checked = call("check", part)
    assert "none of 3 epochs can be calibrated by itself" in checked.stdout
    played(forker, part, tmp_path / "live.db")
    assert len(good(exported(part, tmp_path / "replayed.csv"))) == 40
    assert len(good(exported(tmp_path / "live.db", tmp_path / "live.csv"))) >= 38


def test_few_targets_of_a_wall(shared, tmp_path):
    """Full Gauss-Newton steps diverge with 14 targets; `replay` once had no result for any part.

    Of 264 parts of the four walls with 10 to 19 targets, 222 had a result before and 244 now, with
    errors up to 2.5 sds of the level, doubtful results up to 3. In such weak geometry rounding
    decides which; one of two parts must have one.
    """
    means = []
    for seed in (4, 22):
        part = tmp_path / str(seed)
        part_of(shared / "data" / "aviary-cam2", part, 52, drawn=(seed, 14))
        if call("export", part, "-o", tmp_path / "part.csv").returncode == 0:
            found = good(rows(tmp_path / "part.csv"))
            means += [column(found, "c").mean()] if len(found) > 30 else []
    assert means
    assert np.abs(np.array(means) - 12.68).max() < 0.3  # 12.68 from all targets


@pytest.mark.slow
def test_exchanged_names_of_targets(shared, forker, tmp_path):
    """Live and replay leave both targets out; replay once had no result."""
    real = part_of(shared / "data" / "aviary-cam2", tmp_path / "part", 61)
    exchange = {"19.3": "107.0", "107.0": "19.3"}
    replays = []
    seen = rows(real / "observations.csv")
    for name, kept in (
        ("exchanged", [r | {"target": exchange.get(r["target"], r["target"])} for r in seen]),
        ("without", [r for r in seen if r["target"] not in exchange]),
    ):
        shutil.copytree(real, tmp_path / name)
        write_rows(tmp_path / name / "observations.csv", kept)
        replays.append(exported(tmp_path / name, tmp_path / f"{name}.csv"))
    assert len(good(replays[0])) == len(good(replays[1])) == 41
    for name in MAIN:
        (a, b), sds = (column(r, name) for r in replays), [column(r, f"sd_{name}") for r in replays]
        assert np.abs(a - b).max() < 0.05 * sds[1].min()
        np.testing.assert_allclose(*sds, rtol=2e-3)
    live_and_replayed(forker, tmp_path / "exchanged", tmp_path)


def played(forker: Forker, recording: Path, store: Path, kill_at: int = 0) -> str:
    """Play a recording into a store; return what the program prints.

    kill_at: kill it once the store has this many epochs, and return "".
    """
    words = ("run", "--recording", str(recording), "--fast", "--store", str(store))
    process = forker.start(recording.parent, *words, log=f"{store.stem}-{recording.name}.txt")
    try:
        while kill_at and process.poll() is None and stored(store) < kill_at:
            time.sleep(0.02)
        if kill_at:
            assert process.poll() is None, "it ended before it was killed"
            return ""
        assert process.wait(600) == 0, process.printed()
        assert "Traceback" not in process.printed()
        return process.printed()
    finally:
        process.kill()
        process.wait()


def stored(store: Path) -> int:
    """Return the number of epochs in a store that another process writes."""
    try:
        with contextlib.closing(sqlite3.connect(f"file:{store}?mode=ro", uri=True)) as database:
            return int(database.execute("SELECT count(*) FROM epoch").fetchone()[0])
    except sqlite3.OperationalError:
        return 0  # not yet there


def restarted(forker: Forker, recording: Path, folder: Path, kill_at: int) -> np.ndarray:
    """Return the differences (epochs, 6) in sds of the epochs after a kill from an unbroken run.

    The columns are c, x0, y0 of each epoch, and of the series.
    """
    tables = []
    for name, kill in (("whole", 0), ("killed", kill_at)):
        store = folder / f"{name}.db"
        played(forker, recording, store, kill)
        if kill:
            first = int(rows(recording / "epochs.csv")[stored(store)]["epoch"])
            played(forker, part_of(recording, folder / "rest", first), store)
        table = exported(store, folder / f"{name}.csv", "--extra")
        tables.append({r["frame_time"]: r for r in table})
    whole, killed = tables
    assert list(whole) == list(killed)
    rest = list(whole)[kill_at:]
    assert [whole[t]["status"] for t in rest] == [killed[t]["status"] for t in rest]
    assert len(rest) > 10
    pairs = [(killed[t], whole[t]) for t in rest if whole[t]["status"] == "ok"]
    return np.array([
        [(float(a[f"{of}{n}"]) - float(b[f"{of}{n}"]))
         / np.hypot(float(b[f"sd_{of}{n}"]), float(b.get(level + n) or 0.0)) for a, b in pairs]
        for of, level in (("", ""), ("series_", "level_sd_")) for n in MAIN
    ]).T  # fmt: skip


@pytest.mark.slow
def test_epochs_after_a_kill_are_the_same(forker, tmp_path):
    """A restarted program continues with the epochs in its store."""
    crooked.write(tmp_path / "trembling", "trembling", seed=2, epochs=28)
    apart = restarted(forker, tmp_path / "trembling", tmp_path, 15)
    assert np.abs(apart).max() <= 0.1


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["aviary-cam0", "aviary-cam2"])
def test_a_real_camera_killed_in_the_middle(shared, forker, tmp_path, camera):
    part = part_of(shared / "data" / camera, tmp_path / "part", 62)
    apart = restarted(forker, part, tmp_path, 20)
    assert np.abs(apart).max() <= 0.1


def test_the_first_epochs_of_the_shipped_configuration(forker, tmp_path):
    """From the first epoch on, sigma0 is near 1, few targets are rejected, no epoch is lost."""
    text = (Path(__file__).parents[2] / "config.yaml").read_text()
    (tmp_path / "config.yaml").write_text(text.replace("period_s: 10", "period_s: 1"))
    done = forker.start(tmp_path, "run", "--config", "config.yaml", "--epochs", "3")
    assert done.wait(120) == 0, done.printed()
    beginning = exported(tmp_path / "thermocald.db", tmp_path / "rows.csv")
    assert [r["status"] for r in beginning] == ["ok"] * 3
    assert all(0.8 < float(r["sigma0"]) < 1.25 for r in beginning)
    assert all(int(r["n_rejected"]) < 4 for r in beginning)
    sds = column(beginning, "sd_x0")
    assert sds.max() < 2 * sds.min()
