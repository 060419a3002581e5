"""What the daemon calibrates live is what `replay` finds: real cameras and crooked fields.

As users run it: `run --recording R --fast`, `export` of the store; `replay R`, `export R`.
"""

from __future__ import annotations

import contextlib
import csv
import shutil
import sqlite3
import time
from pathlib import Path

import numpy as np
import pytest

from tests.commands import call
from tests.daemon.forking import Forker
from tests.main_paths import crooked

REAL = ["aviary-cam0", "aviary-cam1", "aviary-cam2", "aviary-cam6"]
MAIN = ("c", "x0", "y0")


def rows(path: Path) -> list[dict[str, str]]:
    """The rows of an exported table."""
    with path.open() as table:
        return list(csv.DictReader(table))


def good(table: list[dict[str, str]]) -> list[dict[str, str]]:
    return [r for r in table if r["status"] == "ok"]


def column(table: list[dict[str, str]], name: str) -> np.ndarray:
    return np.array([float(r[name]) for r in table])


def exported(source: Path, out: Path, *more: str) -> list[dict[str, str]]:
    """The table that `export` writes of a recording or a store."""
    assert call("export", source, *more, "-o", out).returncode == 0
    return rows(out)


def live_and_replayed(forker: Forker, recording: Path, folder: Path):
    """Both tables of a recording, and what the daemon said on the way."""
    own = folder / recording.name
    if own != recording:
        shutil.copytree(recording, own)
    store = folder / "live.db"
    said = played(forker, own, store)
    return exported(store, folder / "live.csv", "--extra"), exported(own, folder / "r.csv"), said


def agree(live: list[dict[str, str]], replayed: list[dict[str, str]]) -> None:
    """The table of the issue: as many epochs, as many rejected, the same sigma0, the same end."""
    pairs = list(zip(live, replayed, strict=True))
    without = {a["epoch"]: a["status"] for a, b in pairs if b["status"] == "ok" != a["status"]}
    assert not without
    a, b = good(live), good(replayed)
    # each row is that of `replay` of the epochs so far: the first ones rest on few
    rejected, expected = column(a, "n_rejected").sum(), column(b, "n_rejected").sum()
    seen = column(b, "n_observations").sum()
    assert rejected <= 1.3 * expected + 10 + 0.002 * seen, (rejected, expected)
    ratio = np.median(column(a, "sigma0")) / np.median(column(b, "sigma0"))
    assert 0.93 <= ratio <= 1.07, f"sigma0 {ratio:.3f} of replay's"
    assert column(a, "sigma0").max() < 3 * np.median(column(a, "sigma0"))
    for name in MAIN:  # the series' result, which stands next to the epoch's own
        difference = float(a[-1][f"series_{name}"]) - float(b[-1][name])
        assert abs(difference) <= 0.2 * float(b[-1][f"sd_{name}"]), f"last epoch's {name}"


@pytest.mark.slow
@pytest.mark.parametrize("camera", REAL)
def test_real_cameras(shared, forker, tmp_path, camera):
    """Fixed cameras in whose 50 s nothing happens: the scatter is what the sds say."""
    live, replayed, said = live_and_replayed(forker, shared / "data" / camera, tmp_path)
    agree(live, replayed)
    assert len(good(live)) == len(good(replayed)) >= 100
    assert "was moved" not in said
    for name in MAIN:
        values, sds = column(good(live), name), column(good(live), f"sd_{name}")
        each = (values - values.mean()) / sds
        ratio = each.std(ddof=1)
        # the aim is 0.9 to 1.1; eight of cam1's targets wander, which its first rows could not know
        most = 1.4 if camera == "aviary-cam1" else 1.25
        assert ratio <= most, f"{name}: {ratio:.2f} sd"
        # the first nine rest on the stated noise, which is more than there is
        assert each[9:].std(ddof=1) >= 0.75, f"{name}: {each[9:].std(ddof=1):.2f} sd"
    # as somebody would see it who looks at the table: cam1 loses half of its boards on the way
    spread = column(good(live), "c").std() / np.median(column(good(live), "sd_c"))
    assert 0.6 < spread < 1.5, f"c scatters {spread:.2f} of the usual sd"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "epochs"),
    [("badly_surveyed", 40), *(pytest.param(k, 70, marks=pytest.mark.slow) for k in crooked.KINDS)],
)
def test_crooked_fields(forker, tmp_path, kind, epochs):
    """Errors about their mean are what the sds say, for the live rows as for replay's."""
    truth = crooked.write(tmp_path / kind, kind, seed=1, epochs=epochs)
    live, replayed, said = live_and_replayed(forker, tmp_path / kind, tmp_path)
    agree(live, replayed)
    assert len(good(live)) == epochs
    assert kind == "knocked" or "was moved" not in said
    for name in MAIN:
        error = column(live, name) - truth[name]
        ratio = (error - error.mean()).std() / np.median(column(live, f"sd_{name}"))
        assert 0.6 <= ratio <= 1.4, f"errors of {name} are {ratio:.2f} of their sd"


@pytest.mark.slow
def test_frames_of_crooked_planes(forker, tmp_path):
    """Rendered frames of a field whose planes are bent, surveyed to 2 µm."""
    recording, truth = tmp_path / "frames", crooked.write_frames(tmp_path / "frames", 14, seed=3)
    live, replayed, said = live_and_replayed(forker, recording, tmp_path)
    agree(live, replayed)
    assert len(good(live)) == 14
    assert "was moved" not in said
    error = column(live, "c") - truth["c"]
    assert abs(error - error.mean()).max() < 5 * np.median(column(live, "sd_c"))


@pytest.mark.slow
@pytest.mark.parametrize("camera", REAL)
def test_a_steady_temperature(shared, forker, tmp_path, camera):
    """With a thermometer nothing hides what the mounts do, and they sway: no knock, no slip."""
    shutil.copytree(shared / "data" / camera, own := tmp_path / camera)
    heads = rows(own / "epochs.csv")
    with (own / "epochs.csv").open("w", newline="") as table:
        writer = csv.DictWriter(table, heads[0])
        writer.writeheader()
        for k, row in enumerate(heads):
            reading = f"{25.0 + 0.0625 * (k % 3 == 0):.4f}"
            writer.writerow(row | {"temperature": reading, "temperature_time": row["frame_time"]})
    live, replayed, said = live_and_replayed(forker, own, tmp_path)
    agree(live, replayed)
    # cam2 twice moves by 0.2 px for two epochs
    assert said.count("was moved") + said.count("slipped") <= 2 * (camera == "aviary-cam2")


def part_of(
    recording: Path, part: Path, first: int, every: int = 1, drawn: tuple[int, int] | None = None
) -> Path:
    """A recording of every so many targets of another one, or of so many that a seed draws, from
    one of its epochs on.
    """
    shutil.copytree(recording, part)
    heads = [r for r in rows(part / "epochs.csv") if int(r["epoch"]) >= first]
    table, epochs = rows(part / "observations.csv"), {r["epoch"] for r in heads}
    names = sorted({r["target"] for r in table})
    kept = set(names[::every])
    if drawn is not None:
        kept = set(np.random.default_rng(drawn[0]).choice(names, drawn[1], replace=False).tolist())
    for name, content in (
        ("epochs.csv", heads),
        ("observations.csv", [r for r in table if r["epoch"] in epochs and r["target"] in kept]),
    ):
        with (part / name).open("w", newline="") as out:
            writer = csv.DictWriter(out, content[0])
            writer.writeheader()
            writer.writerows(content)
    return part


def test_a_part_of_a_real_camera(shared, forker, tmp_path):
    """Every other target and the last 30 epochs: no recording is one that was seen before."""
    part = part_of(shared / "data" / "aviary-cam0", tmp_path / "part", 72, every=2)
    live, replayed, _ = live_and_replayed(forker, part, tmp_path)
    agree(live, replayed)


@pytest.mark.slow
def test_epochs_too_weak_by_themselves(shared, forker, tmp_path):
    """14 targets leave y0 of an epoch unknown by 80 px; together the epochs carry it."""
    part = part_of(shared / "data" / "aviary-cam1", tmp_path / "part", 62, every=5)
    checked = call("check", part)
    assert "none of 3 epochs can be calibrated by itself" in checked.stdout
    live, replayed, _ = live_and_replayed(forker, part, tmp_path)
    assert len(good(replayed)) == 40
    assert len(good(live)) >= 38


def test_few_targets_of_a_wall(shared, tmp_path):
    """Whole steps of Gauss-Newton lead away from what 14 targets show: `replay` had no epoch of
    any of these parts.

    Of 264 parts of the four walls, of 10 to 19 targets, 222 had a result, and 244 have, with errors
    of at most 2.5 of the level's sds; those that the result says to be doubtful had up to 3. In
    geometry so weak rounding decides which: of four parts two have to have one.
    """
    means = []
    for seed in (4, 14, 22, 26):
        part = tmp_path / str(seed)
        part_of(shared / "data" / "aviary-cam2", part, 0, drawn=(seed, 14))
        if call("export", part, "-o", tmp_path / "part.csv").returncode == 0:
            found = good(rows(tmp_path / "part.csv"))
            means += [column(found, "c").mean()] if len(found) > 60 else []
    assert len(means) >= 2
    assert np.abs(np.array(means) - 12.68).max() < 0.3  # of all targets: 12.68


@pytest.mark.slow
def test_names_of_targets_that_are_exchanged(shared, forker, tmp_path):
    """Live and replay leave both out, as if nobody had seen them; replay had no epoch at all."""
    real = part_of(shared / "data" / "aviary-cam2", tmp_path / "part", 61)
    told = {"19.3": "107.0", "107.0": "19.3"}
    replays = []
    for name in ("exchanged", "without"):
        shutil.copytree(real, out := tmp_path / name)
        seen = rows(real / "observations.csv")
        if name == "without":
            seen = [row for row in seen if row["target"] not in told]
        with (out / "observations.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, seen[0])
            writer.writeheader()
            for row in seen:
                writer.writerow(row | {"target": told.get(row["target"], row["target"])})
        replays.append(exported(out, tmp_path / f"{name}.csv"))
    assert len(good(replays[0])) == len(good(replays[1])) == 41
    for name in MAIN:
        (a, b), sds = (column(r, name) for r in replays), [column(r, f"sd_{name}") for r in replays]
        assert np.abs(a - b).max() < 0.05 * sds[1].min()
        np.testing.assert_allclose(*sds, rtol=2e-3)
    played(forker, tmp_path / "exchanged", tmp_path / "live.db")
    agree(exported(tmp_path / "live.db", tmp_path / "live.csv", "--extra"), replays[0])


def played(forker: Forker, recording: Path, store: Path, kill_at: int = 0) -> str:
    """Play a recording into a store; kill the program as soon as it holds so many epochs.

    Returns what it said where it was not killed.
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
    """How many epochs a store holds that another process writes."""
    try:
        with contextlib.closing(sqlite3.connect(f"file:{store}?mode=ro", uri=True)) as database:
            return int(database.execute("SELECT count(*) FROM epoch").fetchone()[0])
    except sqlite3.OperationalError:
        return 0  # not yet there


def restarted(forker: Forker, recording: Path, folder: Path, kill_at: int) -> np.ndarray:
    """By how many standard deviations (epochs, 6) the epochs after a kill are others than those
    without: c, x0, y0 of each epoch by itself, and in its series.
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
    return np.array(
        [
            [
                (float(killed[t][f"{of}{n}"]) - float(whole[t][f"{of}{n}"]))
                / np.hypot(float(whole[t][f"sd_{of}{n}"]), float(whole[t].get(level + n) or 0.0))
                for of, level in (("", ""), ("series_", "level_sd_"))
                for n in MAIN
            ]
            for t in rest
            if whole[t]["status"] == "ok"
        ]
    )


@pytest.mark.slow
def test_killed_in_the_middle_the_rest_is_the_same(forker, tmp_path):
    """The program goes on with the epochs of its store as if it had never been away."""
    crooked.write(tmp_path / "trembling", "trembling", seed=2, epochs=28)
    apart = restarted(forker, tmp_path / "trembling", tmp_path, 15)
    assert np.abs(apart).max() <= 0.1


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["aviary-cam0", "aviary-cam2"])
def test_a_real_camera_killed_in_the_middle(shared, forker, tmp_path, camera):
    part = part_of(shared / "data" / camera, tmp_path / "part", 62)
    apart = restarted(forker, part, tmp_path, 20)
    assert np.abs(apart).max() <= 0.1


@pytest.fixture(scope="module")
def beginning(forker, tmp_path_factory):
    """The first epochs of the shipped configuration, one a second."""
    folder = tmp_path_factory.mktemp("shipped")
    text = (Path(__file__).parents[2] / "config.yaml").read_text()
    (folder / "config.yaml").write_text(text.replace("period_s: 10", "period_s: 1"))
    done = forker.start(folder, "run", "--config", "config.yaml", "--epochs", "5")
    assert done.wait(120) == 0, done.printed()
    return exported(folder / "thermocald.db", folder / "rows.csv")


def test_the_shipped_configuration_begins_well(beginning):
    """From the first epoch on sigma0 is near 1, nothing is rejected, no epoch is lost."""
    assert [r["status"] for r in beginning] == ["ok"] * 5
    assert all(0.8 < float(r["sigma0"]) < 1.25 for r in beginning)
    assert all(int(r["n_rejected"]) < 4 for r in beginning)
    sds = column(beginning, "sd_x0")
    assert sds.max() < 2 * sds.min()
