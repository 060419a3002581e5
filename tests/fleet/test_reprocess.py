"""Reprocessed archives: every engine gives the same bits, and a bad block affects only itself."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from tests.commands import document
from tests.fleet.dask_cluster import DaskCluster
from thermocald.cli.server import find_tasks
from thermocald.errors import DataError, UsageError
from thermocald.fleet.reprocess import calibrate_block, find_blocks, run_tasks
from thermocald.photogrammetry.camera.camera_model import DEFAULT_FREE

parquet = pytest.importorskip("pyarrow.parquet", reason="pip install thermocald[parquet]")


def files(out, pattern="*.parquet"):
    return {p.relative_to(out): p.read_bytes() for p in sorted(out.rglob(pattern))}


def blocks_of(archive, out, size=20):
    return find_blocks([archive], out, tuple(DEFAULT_FREE), size)


def test_processes_give_the_bits_of_one_and_what_fails_costs_itself(archive, tmp_path):
    """An interrupted run goes on."""
    one, many = tmp_path / "one", tmp_path / "many"
    blocks = blocks_of(archive, one)
    list(run_tasks(calibrate_block, blocks[1:2]))
    assert blocks_of(archive, one) == [blocks[0], *blocks[2:]]
    blocks = blocks_of(archive, many)
    gone = replace(blocks[1], recording=tmp_path / "gone", target=tmp_path / "gone.parquet")
    done = list(run_tasks(calibrate_block, [*blocks[:2], gone, *blocks[2:]], jobs=2))
    assert sorted(bool(o.error) for o in done) == [False, False, False, False, True]
    assert sum(o.calibrated for o in done) == 80
    assert files(one).items() <= files(many).items()
    table = parquet.read_table(many)
    assert table.num_rows == 80
    assert table.column("sd_x0").null_count == 0


def test_a_block_knows_the_frame_before_it(archive, tmp_path):
    """Epoch 21, the first of a block, has the image points of epoch 20 again."""
    shutil.copytree(archive / "M1", tmp_path / "M1")
    path = tmp_path / "M1" / "observations.csv"
    lines = path.read_text().splitlines(keepends=True)
    again = [line.replace("20,", "21,", 1) for line in lines if line.startswith("20,")]
    path.write_text("".join([line for line in lines if line[:3] != "21,"] + again))
    list(run_tasks(calibrate_block, blocks_of(tmp_path, tmp_path / "out")))
    status = parquet.read_table(tmp_path / "out").sort_by("epoch").column("status").to_pylist()
    assert [i + 1 for i, word in enumerate(status) if word != "ok"] == [21]
    assert status[20] == "repeated_frame"


def test_a_damaged_recording_costs_only_itself(archive, tmp_path):
    shutil.copytree(archive, tmp_path / "all")
    (tmp_path / "all/M2/recording.yaml").write_text("camera: [")
    done = run_tasks(calibrate_block, find_blocks([tmp_path / "all"], tmp_path / "out", ()))
    found = {(o.epochs, "M2/recording.yaml" in o.error) for o in done}
    assert found == {(0, True), (40, False)}


def test_a_folder_that_cannot_be_read_is_not_called_empty(archive, tmp_path, monkeypatch, caplog):
    with pytest.raises(DataError, match="gone: cannot be read: No such file or directory"):
        find_blocks([tmp_path / "gone"], tmp_path, ())
    scan = os.scandir

    def refuse(path):
        if str(path).endswith("M2"):
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", refuse)
    assert {block.recording.name for block in blocks_of(archive, tmp_path)} == {"M1"}
    assert "M2: cannot be read: Permission denied; recordings in it are left out" in caplog.text


def die(block):
    """Kill the process that works on a block, as a frame that crashes a decoder would."""
    if block.first == 0 and "M2" in str(block.recording):
        os.kill(os.getpid(), signal.SIGKILL)
    return calibrate_block(block)


@pytest.mark.slow
def test_a_block_that_kills_its_process_costs_itself(archive, tmp_path):
    done = list(run_tasks(die, blocks_of(archive, tmp_path), jobs=2))
    assert sorted(o.error for o in done) == ["", "", "", "its process died twice"]


def test_bad_usage_is_said(archive, tmp_path):
    with pytest.raises(UsageError, match="give `local` or"):
        list(run_tasks(calibrate_block, [], "fast"))
    with pytest.raises(UsageError, match="must be one of calibrate, discover, study"):
        find_tasks([archive], tmp_path, "dream")
    with pytest.raises(DataError, match="no recording or series is there"):
        find_tasks([tmp_path], tmp_path, "study")


@pytest.mark.slow
def test_series_are_analysed_one_by_one_and_done_ones_are_left(archive, tmp_path):
    run = ("reprocess", archive, "--out", tmp_path / "o", "--do", "study", "--sets", "500")
    assert document(*run) == {"format": "thermocald-reprocess/1", "series": 2, "failed": []}
    names = sorted(p.name for p in (tmp_path / "o").iterdir())
    assert names == ["rpi-v2.1-M1.json", "rpi-v2.1-M2.json"]
    (tmp_path / "o" / names[0]).unlink()
    assert document(*run)["series"] == 1


# --- a Dask cluster gives the same bits, whatever happens to its workers ---------------------

RUN_BLOCKS = (
    "import sys; from pathlib import Path;"
    "from thermocald.fleet.reprocess import calibrate_block, find_blocks, run_tasks;"
    "from thermocald.photogrammetry.camera.camera_model import DEFAULT_FREE;"
    "b = find_blocks([Path(sys.argv[1])], Path(sys.argv[2]), tuple(DEFAULT_FREE), 5);"
    "print([o.error for o in run_tasks(calibrate_block, b, sys.argv[3]) if o.error])"
)


@pytest.fixture
def dask(tmp_path):
    pytest.importorskip("distributed", reason="pip install thermocald[dask]")
    with DaskCluster(tmp_path, 2) as found:
        yield found


@pytest.mark.slow
def test_workers_that_are_killed_again_and_again_finish_with_equal_results(archive, tmp_path, dask):
    """One of two is killed, then the other after every few blocks and replaced, as on machines
    that are lent.
    """
    list(run_tasks(calibrate_block, blocks_of(archive, tmp_path / "one", 5)))
    out = tmp_path / "many"
    command = [sys.executable, "-c", RUN_BLOCKS, archive, out, dask.address]
    client = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    killed = done = 0
    deadline = time.monotonic() + 400
    while client.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.1)
        if (now := len(files(out))) < done + 4:
            continue
        done = now
        if killed:
            dask.replace_worker(1)
        else:
            dask.workers[0].kill()
        killed += 1
    errors, _ = client.communicate()
    assert errors.splitlines()[-1] == "[]"
    assert files(tmp_path / "one") == files(out)
    assert killed >= 2


@pytest.mark.slow
def test_every_series_is_analysed_as_it_is_here(archive, tmp_path, dask):
    """Monte-Carlo too: its random numbers do not depend on the engine."""

    def reprocess(out, *engine):
        command = [sys.executable, "-m", "thermocald", "reprocess", archive, "--do", "study",
                   "--sets", "500", "--out", tmp_path / out, *engine]  # fmt: skip
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
        return done.returncode, done.stderr

    assert reprocess("local")[0] == reprocess("cluster", "--engine", dask.address)[0] == 0
    here = files(tmp_path / "local", "*.json")
    assert {str(name) for name in here} == {"rpi-v2.1-M1.json", "rpi-v2.1-M2.json"}
    assert files(tmp_path / "cluster", "*.json") == here
    status, said = reprocess("none", "--engine", "tcp://127.0.0.1:9")
    assert status == 1
    assert "the scheduler cannot be reached" in said
    assert "Traceback" not in said
