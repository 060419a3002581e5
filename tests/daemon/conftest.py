"""The real daemon as a process, with small recordings and small disks for it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.daemon.forking import Forked, Forker
from tests.drivers.small_camera import write_small_camera
from tests.recordings import write_table
from tests.store.small import write_recording
from thermocald.config import parse_config
from thermocald.daemon.control import ask
from thermocald.daemon.service import Service
from thermocald.epoch import Epoch
from thermocald.files import read_json
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.physics.testfields import corner_field, demonstration_model
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head, read_head
from thermocald.store.recording.testfield_file import write_testfield

ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


OUTPUTS = [{"name": "log", "driver": "jsonl", "path": "./results.jsonl"}]


def play(folder: Path, cameras: list[dict], epochs: int = 0) -> Store:
    """Play recordings as fast as a daemon can, a series for each camera; return the store."""
    thermometers = {
        name: {"name": name, "driver": "replay", "recording": camera["recording"],
               "after": camera.get("after")}
        for camera in cameras for name in camera.get("thermometers", ())
    }  # fmt: skip
    document = {"cameras": cameras, "thermometers": [*thermometers.values()], "outputs": OUTPUTS,
                "frames": {"keep": "none"}, "store": {"durable": False}}  # fmt: skip
    config = parse_config(document, folder / "config.yaml")
    assert Service(config, fast=True, epochs=epochs, until_finished=True).run()
    return Store.open(config.store.path)


def results_of(folder: Path) -> list[dict]:
    """Return the results in `results.jsonl`."""
    path = folder / "results.jsonl"
    if not path.exists():
        return []
    lines = path.read_text().split("\n")[:-1]  # an incomplete line may follow the last line end
    return [json.loads(line) for line in lines]


def columns_of(path: Path, *names: str) -> dict[str, np.ndarray]:
    """Return columns of a store's only series."""
    with Store.open(path) as store:
        return store.series_columns(store.find_series(), list(names))


class Daemon:
    """A `thermocald run` in a folder."""

    def __init__(self, folder: Path, forker: Forker) -> None:
        self.folder = folder
        self.forker = forker
        self.store = folder / "thermocald.db"
        self.config = folder / "config.yaml"
        self.frames = folder / "frames"
        self.process: subprocess.Popen[bytes] | Forked | None = None
        self.commands: list[Forked] = []

    def configure(self, keep: str = "none", **sections) -> None:
        """Write a configuration that keeps no frames, or some; keep: which."""
        frames = {"keep": keep, "folder": str(self.frames), "min_free_gb": 0.0}
        frames |= sections.pop("frames", {})
        document = {"store": {"path": str(self.store)}, "frames": frames, **sections}
        self.config.write_text(yaml.safe_dump(document))

    def start(self, *options: str, **environment: str) -> None:
        arguments = ["run", "--config", str(self.config), *options]
        self.process = self.forker.start(self.folder, *arguments, **environment)

    def command(self, *arguments: str) -> Forked:
        """Start a `thermocald …` in the folder, which is killed after the test."""
        log = f"command-{len(self.commands)}.txt"
        self.commands.append(self.forker.start(self.folder, *arguments, log=log))
        return self.commands[-1]

    def run(self, *options: str, **sections) -> None:
        self.configure(**sections)
        self.start(*options)

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def stop(self) -> int:
        """Stop the daemon and return its exit status; its log must have no traceback."""
        self.signal(signal.SIGTERM)
        status = self.wait(60.0)
        assert "Traceback" not in self.log()
        return status

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def wait(self, timeout_s: float = 120.0) -> int:
        return self.process.wait(timeout_s)

    def log(self) -> str:
        path = self.folder / "log.txt"
        return path.read_text() if path.exists() else ""

    @property
    def live(self) -> Path:
        """The folder of its live state."""
        return self.store.with_name(f"{self.store.name}.live")

    def status(self) -> dict:
        """Return the daemon's status document, {} without one."""
        return read_json(self.live / "status.json")

    def ask(self, do: str, **values) -> dict | None:
        """Send a request to the control socket."""
        return ask(self.live, do, **values)

    def results(self) -> list[dict]:
        return results_of(self.folder)

    def until(self, condition, timeout_s: float = 120.0, alive: bool = True) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, f"timed out; log:\n{self.log()}"
            assert not alive or self.process.poll() is None, f"it ended; log:\n{self.log()}"
            time.sleep(0.05)

    def more(self, count: int) -> None:
        """Wait for a number of further results."""
        had = len(self.results())
        self.until(lambda: len(self.results()) >= had + count)

    def stored(self) -> tuple[list[int], list[str]]:
        """Return (numbers, statuses) of the only series; the store must be sound, without gaps."""
        with Store.open(self.store) as store:
            assert store.examine().damaged == ()
        columns = columns_of(self.store, "epoch", "status")
        numbers = columns["epoch"].astype(int).tolist()
        assert numbers == list(range(1, len(numbers) + 1))
        return numbers, columns["status"].tolist()

    def events(self) -> list[str]:
        with Store.open(self.store) as store:
            return [event.kind for event in store.events()]

    def close(self) -> None:
        for process in (self.process, *self.commands):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()


@pytest.fixture
def daemon(tmp_path: Path, forker: Forker):
    daemon = Daemon(tmp_path, forker)
    yield daemon
    daemon.close()


@pytest.fixture(scope="session")
def small_camera(tmp_path_factory) -> Path:
    return write_small_camera(tmp_path_factory.mktemp("model") / "small.thermal.yaml")


@pytest.fixture(scope="session")
def small_field(tmp_path_factory) -> Path:
    """A quarter of the demonstration's targets in the same place: a frame costs half."""
    path = tmp_path_factory.mktemp("field") / "small.csv"
    write_testfield(path, corner_field("markers", per_side=2, pitch_mm=300.0))
    return path


@pytest.fixture
def devices(small_camera, small_field):
    """Sections of a configuration with a fast rendered camera and a thermometer, with faults."""

    def make(period_s: float = 0.2, name: str = "one", camera=(), thermometer=(), **options):
        cameras = {
            "name": name, "driver": "mock", "period_s": period_s, "thermometers": ["housing"],
            "latency_s": 0.02, "faults": list(camera), **options,
            "options": {"testfield": str(small_field), "model": str(small_camera), "seed": 1},
            "principal_distance_mm": 3.04,
        }  # fmt: skip
        housing = {"name": "housing", "driver": "mock", "period_s": period_s,
                   "conversion_s": 0.01, "faults": list(thermometer)}  # fmt: skip
        return {"cameras": [cameras], "thermometers": [housing], "outputs": [*OUTPUTS]}

    return make


def changed_recording(path: Path, taken, epochs, field=None) -> Path:
    """Write a recording with the head of another one, but other epochs, and perhaps field."""
    head = Head(path.name, "M1", 10.0, taken.camera, taken.head.channels)
    write_recording(path, head, field or taken.testfield, epochs)
    return path


def warming(k: int) -> float:
    """Return the temperature of epoch k, 25 to 35 °C."""
    return 25.0 + 10.0 * (1 - np.exp(-k / 60.0))


def make_recording(
    path: Path, epochs: int, per_side: int = 3, interval: float = 0.05, temperature_of=warming
) -> Path:
    """Write observations of a camera that warms up: `per_side`² targets on each of three planes."""
    field = corner_field("plain", per_side=per_side, pitch_mm=660.0 / (per_side + 0.3))
    model = demonstration_model(field)
    iop, eop = model.interior.as_array(), model.exterior.as_array()
    rng = np.random.default_rng(3)

    def generate():
        for k in range(epochs):
            temperature = temperature_of(k)
            now = iop.copy()
            now[:3] += np.array([2.0e-4, -4.5e-4, -3.0e-4]) * (temperature - 25.0)
            points = project(model.sensor, now, eop, field.points)
            points += rng.normal(0, 0.04, points.shape)
            seen = Observations(np.arange(len(field)), points, np.full(points.shape, 0.04))
            time_s = 1.7e9 + interval * k
            reading = {"temperature": round(temperature * 16) / 16}
            yield Epoch(k + 1, time_s, time_s + 0.001, reading, observations=seen)

    channels = {"temperature": Channel(0.0625)}
    head = Head("small", "M1", interval, CameraSpec("rpi", model.sensor, 3.04), channels)
    write_recording(path, head, field, generate())
    return path


def make_photographs(path: Path, recording: Path, frames: list[bytes]) -> Path:
    """Write a recording of JPEGs with the camera and test field of another recording."""
    (path / "frames").mkdir(parents=True)
    for name in ("recording.yaml", "testfield.csv"):
        shutil.copy(recording / name, path / name)
    rows = []
    for k, data in enumerate(frames, 1):
        (path / f"frames/{k:04d}.jpg").write_bytes(data)
        rows.append((k, 1.7e9 + 10 * k, 1.7e9 + 10 * k, 25.0, f"frames/{k:04d}.jpg"))
    columns = ("epoch", "frame_time", "temperature_time", "temperature", "frame")
    write_table(path / "epochs.csv", columns, rows)
    return path


@pytest.fixture(scope="session")
def recording(tmp_path_factory) -> Path:
    """A recording of 200 epochs of 27 targets, one every 50 ms."""
    return make_recording(tmp_path_factory.mktemp("recording") / "small", 200)


def replayed_camera(path: Path, **more: object) -> dict[str, object]:
    """Return the configuration entry of a camera that replays a recording."""
    sensor = read_head(path).camera.sensor
    return {
        "driver": "replay", "recording": str(path), "testfield": str(path / "testfield.csv"),
        "principal_distance_mm": 3.04,
        "sensor": {"width_px": sensor.width, "height_px": sensor.height,
                   "pixel_pitch_mm": sensor.pixel_pitch},
        **more,
    }  # fmt: skip


@pytest.fixture
def replayed():
    """Sections of a configuration that replays a recording."""

    def make(path: Path, period_s: float = 0.05, loop: bool = True):
        rhythm = {"loop": loop, "period_s": period_s}
        camera = replayed_camera(path, name="rpi", thermometers=["recorded"], **rhythm)
        recorded = {"name": "recorded", "driver": "replay", "recording": str(path), **rhythm}
        return {"cameras": [camera], "thermometers": [recorded], "outputs": [*OUTPUTS]}

    return make


@pytest.fixture
def measured(recording, replayed):
    """Devices that deliver observations, without images, ten times a second."""
    return replayed(recording, 0.1)


@pytest.fixture(scope="session")
def preloaded(tmp_path_factory):
    """A forker of daemons with all C files beside this one preloaded; a variable activates each."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler for the libraries that simulate the system")
    folder, built = tmp_path_factory.mktemp("preloaded"), []
    for source in sorted(Path(__file__).parent.glob("*.c")):
        built.append(str(folder / f"{source.stem}.so"))
        command = [compiler, "-shared", "-fPIC", "-O1", "-o", built[-1], source, "-ldl"]
        subprocess.run(command, check=True)
    forker = Forker({**ENVIRONMENT, "LD_PRELOAD": ":".join(built)})
    yield forker
    forker.close()
