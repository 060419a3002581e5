"""A real Dask cluster gives the same bits as one process, whatever happens to its workers."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from tests.fleet.dask_cluster import DaskCluster
from tests.fleet.test_reprocess import blocks_of, files
from thermocald.fleet.reprocess import calibrate_block, run_tasks

parquet = pytest.importorskip("pyarrow.parquet", reason="pip install thermocald[parquet]")
pytestmark = pytest.mark.slow

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
