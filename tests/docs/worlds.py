"""What the documentation's commands find in their folder: mocks, simulated recordings, files."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import yaml

import thermocald as tc
from tests.commands import succeed as run
from tests.docs.blocks import ROOT, blocks
from tests.photogrammetry import network_cases
from tests.photogrammetry.printed_sheets import photograph, put_up
from tests.pictures import TAKEN, save_photograph, write_markers
from thermocald.output.testfield.sheets import TRIM, paper_size
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.physics.model_file import write_model
from thermocald.physics.testfields import corner_field, demonstration_field, demonstration_model
from thermocald.store.recording.testfield_file import read_testfield, write_testfield


@cache
def recordings(shelf: Path) -> tuple[Path, Path]:
    """M1 and M2 of a Raspberry Pi camera with a lag, heated differently."""
    paths = []
    for series, seed, until, power in (("M1", 1, 600.0, 9.0), ("M2", 2, 800.0, 6.5)):
        tc.simulate(
            "rpi-v2.1-heating", effects={"thermal_lag": {"tau": 70.0}}, own_effects=False,
            lamp=[(0.0, 0.0), (80.0, power), (until, 0.0)], seed=seed, series=series,
            out=shelf / series,
        )  # fmt: skip
        paths.append(shelf / series)
    return paths[0], paths[1]


@cache
def model(shelf: Path) -> Path:
    """A thermal model of that camera."""
    path = shelf / "camera.thermal.yaml"
    run("fit", *recordings(shelf), "-o", path, "--effect", "thermal_lag")
    return path


def put_recordings(shelf: Path, folder: Path, *names: str) -> None:
    """The two series in turn under some names, in place of what is there."""
    for name, source in zip(names, recordings(shelf) * 2, strict=False):
        shutil.rmtree(folder / name, ignore_errors=True)
        shutil.copytree(source, folder / name)


def recordings_of(*names: str) -> World:
    return lambda shelf, folder: put_recordings(shelf, folder, *names)


def put_measured(shelf: Path, folder: Path) -> None:
    """Points, images and a temperature log of the field, at M2's times."""
    log = recordings(shelf)[1] / "epochs.csv"
    for name in ("weather.csv", "log.csv", "epochs.csv"):
        shutil.copy(log, folder / name)
    times = [line.split(",")[1] for line in log.read_text().splitlines()[1:]]
    rows = [f"{t},{800 + i},{600 + i}" for i, t in enumerate(times[:20])]
    (folder / "points.csv").write_text("time,x,y\n" + "\n".join(rows) + "\n")
    grey = np.tile(np.linspace(20, 220, 3280).astype(np.uint8), (2464, 1))
    cv2.imwrite(str(folder / "hot.png"), grey)
    (folder / "images.csv").write_text(f"time,image\n{times[60]},hot.png\n")


def put_heat(folder: Path, camera: str) -> None:
    """The camera file and the programme that the page on the simulation shows."""
    shown = [b.text for b in blocks(ROOT / "docs/explanation/simulation.md")]
    (text,) = [t for t in shown if t.startswith("format: thermocald-camera/1")]
    (folder / camera).write_text(text)
    (text,) = [t for t in shown if t.startswith("format: thermocald-programme/1")]
    for name in ("warm-up.yaml", "lamp.yaml"):
        (folder / name).write_text(text)


def put_config(folder: Path, name: str, store: str = "thermocald.db") -> None:
    """A configuration in place of the page's: its names, and a rendered camera that is quick."""
    small = demonstration_model(demonstration_field("markers"))
    write_model(folder / "small.thermal.yaml", replace(small, sensor=Sensor(820, 616, 0.00448)))
    mock = {
        "name": name, "driver": "mock", "period_s": 0.25, "thermometers": ["housing"],
        "latency_s": 0.02, "principal_distance_mm": 3.04,
        "options": {"testfield": "markers", "model": "./small.thermal.yaml", "seed": 1},
    }  # fmt: skip
    housing = {"name": "housing", "driver": "mock", "period_s": 0.25, "conversion_s": 0.01}
    document = {
        "store": {"path": store, "durable": False},
        "frames": {"keep": "none"},
        "cameras": [mock],
        "thermometers": [housing],
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(document))


def config_of(*names: str) -> World:
    return lambda _, folder: put_config(folder, *names)


def put_photographs(_: Path, folder: Path) -> None:
    """Eight photographs of the corner that was printed into `field/`."""
    page = paper_size("A3", landscape=True)
    sheets = put_up(folder / "field" / "testfield.pdf", page, TRIM)
    middle = read_testfield(folder / "field" / "testfield.csv").points.mean(axis=0)
    camera = CameraModel(Sensor(1640, 1232, 0.00224), InteriorOrientation(3.05, 0.02, -0.01, -2e-3))
    (folder / "photos").mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    for i in range(8):  # stations that see all three sheets, every second one turned by 90°
        direction = np.ones(3) + rng.uniform(-0.45, 0.45, 3)
        where = middle + 680.0 * direction / np.linalg.norm(direction)
        station = network_cases.looking_at(where, middle, (i % 4) * np.pi / 2)
        frame = photograph(sheets, camera, station, seed=i, finer=2)
        cv2.imwrite(str(folder / "photos" / f"{i}.jpg"), frame, [cv2.IMWRITE_JPEG_QUALITY, 95])


def photographs_with_times(_: Path, folder: Path) -> None:
    """A few small photographs with EXIF times and a logger's file, and a field."""
    (folder / "photos").mkdir()
    rows = []
    for i in range(4):
        tags = {TAKEN: f"2026:06:14 12:00:{10 * i:02d}"}
        save_photograph(folder / "photos" / f"{i}.jpg", tags)
        rows.append(f"14.06.2026 12:00:{10 * i:02d};{20 + i},5")
    (folder / "logger.csv").write_text("Zeit;Temperatur °C\n" + "\n".join(rows) + "\n", "latin-1")
    write_testfield(folder / "surveyed.csv", corner_field("circles", 4, 150.0))


def how_to_calibrate(_: Path, folder: Path) -> None:
    """Three photographs of the markers' corner, rendered."""
    (folder / "photos").mkdir()
    write_markers(folder / "photos")
    (folder / "photos/field.csv").rename(folder / "testfield.csv")


def how_to_export(shelf: Path, folder: Path) -> None:
    """A recording, and a store that it was calibrated into."""
    put_recordings(shelf, folder, "M1")
    run("replay", folder / "M1", "--store", folder / "thermocald.db")


def how_to_thermal_model(shelf: Path, folder: Path) -> None:
    put_recordings(shelf, folder, "M1", "M2", "M3")
    shutil.copy(model(shelf), folder / "what-discover-wrote.yaml")
    put_measured(shelf, folder)
    put_heat(folder, "camera.yaml")


def how_to_study(shelf: Path, folder: Path) -> None:
    put_recordings(shelf, folder, "rpi-heating-M1", "rpi-heating-M2")
    for k, preset in enumerate(("nexus5-cold", "nexus5-cold", "nexus5-warm", "nexus5-warm"), 1):
        tc.simulate(preset, seed=k, series=f"M{k}", out=folder / f"nexus-M{k}")


def simulation(shelf: Path, folder: Path) -> None:
    put_heat(folder, "camera.yaml")
    shown = blocks(ROOT / "docs/explanation/simulation.md")
    (text,) = [b.text for b in shown if b.text.startswith("format: thermocald-model/1")]
    (folder / "camera.thermal.yaml").write_text(text)
    shutil.copy(recordings(shelf)[0] / "testfield.csv", folder)


def store(_: Path, folder: Path) -> None:
    """A store with a short measured series of a small field."""
    field = corner_field("circles", 4, 150.0)
    tc.simulate("rpi-v2.1-heating", seed=1, testfield=field, epochs=12, out=folder / "short")
    run("replay", folder / "short", "--store", folder / "thermocald.db")


World = Callable[[Path, Path], None]
PHONE, RPI = "docs/tutorial/phone.md", "docs/tutorial/raspberry-pi.md"
WORLDS: dict[str, tuple[World, ...]] = {
    "docs/explanation/discovery.md": (recordings_of("M1", "M2"),),
    "docs/how-to/notebook.md": (recordings_of("M1", "M2"),),
    "docs/explanation/simulation.md": (simulation,),
    "docs/how-to/calibrate.md": (how_to_calibrate,),
    "docs/how-to/daemon.md": (config_of("demo"), recordings_of("M1")),
    "docs/how-to/dashboard.md": (store,),
    "docs/how-to/export.md": (how_to_export,),
    "docs/how-to/make-a-recording.md": (photographs_with_times,),
    "docs/how-to/session.md": (config_of("phone-1"),),
    "docs/how-to/study.md": (how_to_study,),
    "docs/how-to/thermal-model.md": (how_to_thermal_model,),
    "docs/reference/store.md": (store,),
    PHONE: (config_of("phone-1", "phone.db"), lambda _, f: put_heat(f, "phone.yaml"), put_measured),
    RPI: (config_of("rpi", "rpi.db"), put_measured),
    "docs/tutorial/river.md": (
        lambda _, f: shutil.copytree(ROOT / "examples/river", f, dirs_exist_ok=True),
    ),
}
"""By page: what is put into its folder."""

SESSION = "thermocald session start --camera"
AFTER: dict[tuple[str, str], World] = {
    ("docs/how-to/testfield.md", "thermocald testfield check field/testfield.csv"): put_photographs,
    (RPI, "mkdir -p photos"): put_photographs,
    # half a minute of a rendered camera is no way up and down: the analysis gets whole series
    (RPI, f"{SESSION} rpi --series M2 --start cold --epochs 150"): recordings_of(
        "rpi-M1", "rpi-M2"
    ),
    (PHONE, f"{SESSION} phone-1 --series M2 --start warm --epochs 150"): recordings_of(
        "phone-1-M1", "phone-1-M2"
    ),
    (PHONE, f"{SESSION} phone-1 --series M3 --start cold --epochs 150"): recordings_of(
        "phone-1-M1", "phone-1-M3"
    ),
}
"""By page and command: what happens meanwhile that no command does, such as taking photographs."""
