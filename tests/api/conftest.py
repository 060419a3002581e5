"""A user's folder: two recordings, a store, a model, photographs and a logger's file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import thermocald as tc
from tests.commands import finish
from tests.golden.workshop import photographs


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    """Make the folder; tests write beside it."""
    folder = tmp_path_factory.mktemp("world")
    for k in (1, 2):
        tc.simulate("rpi-v2.1-heating", seed=k, series=f"M{k}", out=folder / f"M{k}")
    tc.simulate("rpi-v2.1-heating", seed=3, epochs=24, out=folder / "short")
    finish("replay", "short", "--store", "thermocald.db", folder=folder)
    M1 = tc.open(folder / "M1")
    camera = tc.fit(M1, tc.open(folder / "M2"))
    camera.save(folder / "camera.yaml")
    for name, temperature in (("cold", 26.0), ("warm", 45.0)):
        camera.at(temperature).write(folder / f"{name}.json")
    first = M1.frame_time[3]
    rows = f"{first},a.png,1000,900\n{first + 60},b.png,1500,1200\n"
    (folder / "points.csv").write_text(f"time,image,x,y\n{rows}")
    photographs(folder)
    (folder / "log.csv").rename(folder / "logger.csv")
    board = Path(__file__).resolve().parents[3] / "shared" / "data" / "chessboard"
    if board.is_dir():
        (folder / "board").mkdir()
        for name in ("f000", "f060", "f090", "f120", "f150", "f180", "f240", "f330"):
            (folder / "board" / f"{name}.jpg").symlink_to(board / f"{name}.jpg")
    finish("testfield", "import", "--chessboard", "9x6", "--square", 25, "-o", "board.csv",
                folder=folder)  # fmt: skip
    return folder


@pytest.fixture
def inside(world, monkeypatch):
    """Use the folder as working directory."""
    monkeypatch.chdir(world)
    return world


@pytest.fixture(scope="session")
def M1(world):
    return tc.open(world / "M1")


@pytest.fixture(scope="session")
def M2(world):
    return tc.open(world / "M2")


@pytest.fixture(scope="session")
def short(world):
    """The series of 24 epochs that thermocald.db holds too."""
    return tc.open(world / "short")


@pytest.fixture(scope="session")
def epochs(M1):
    return M1.calibrate()


@pytest.fixture(scope="session")
def camera(world):
    return tc.load_camera(world / "camera.yaml")


os.environ.setdefault("MPLBACKEND", "agg")
