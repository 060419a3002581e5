"""Test field, frames and configuration of the guest's daemon."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tests.hil.frames import heating, subject
from thermocald.store.recording.testfield_file import write_testfield

SIZE = (640, 480)
PERIOD_S = 2.0
HOME = "/var/lib/thermocald"
STORE = f"{HOME}/store"  # a disk of its own
CAMERA = "/dev/video41"
VIVID = "/dev/v4l/by-path/platform-vivid.0-video-index0"


def configuration(serial_port: str) -> dict[str, Any]:
    """Return a configuration: a calibrated and a recorded camera, two thermometers, two outputs."""
    width, height = SIZE
    _, model = subject(width, height)
    line = r"T=(?P<temperature>[-+]?\d+\.\d+)"
    return {
        "store": {"path": f"{STORE}/thermocald.db"},
        "frames": {"keep": "all", "folder": f"{HOME}/frames", "min_free_gb": 0.0},
        "calibration": {"exterior": "per_epoch", "free": ["c", "x0", "y0", "A1"],
                        "fixed": {"A2": 0.0005, "B1": 1e-4, "B2": -2e-4}},
        "cameras": [
            {
                "name": "river", "driver": "v4l2", "device": CAMERA, "width": width,
                "height": height, "pixel_format": "GREY", "timeout_s": 5.0, "period_s": PERIOD_S,
                "sensor": {"width_px": width, "height_px": height,
                           "pixel_pitch_mm": model.sensor.pixel_pitch},
                "principal_distance_mm": 3.04,
                "testfield": "/etc/thermocald/testfield.csv",
                "thermometers": ["lens", "line"],
            },
            {
                "name": "yard", "driver": "v4l2", "device": VIVID, "width": 640, "height": 360,
                "pixel_format": "GREY", "timeout_s": 2.0, "period_s": 2 * PERIOD_S,
                "thermometers": ["lens"],
            },
        ],
        "thermometers": [
            {"name": "lens", "driver": "hwmon", "chip": "tmp75", "period_s": 1.0},
            {"name": "line", "driver": "serial", "port": serial_port, "pattern": line,
             "command": "T?\r\n", "timeout_s": 2.0, "period_s": PERIOD_S},
        ],
        "outputs": [
            {"name": "log", "driver": "jsonl", "path": f"{HOME}/results.jsonl"},
            {"name": "home", "driver": "mqtt", "host": "127.0.0.1"},
        ],
    }  # fmt: skip


def prepare(folder: Path, serial_port: str, epochs: int) -> None:
    """Write frames, temperatures, test field and configuration into a folder shared with the guest.

    The test field contains every third of the field's markers: 64 corners.
    """
    images, temperatures = heating(*SIZE, epochs)
    np.save(folder / "frames.npy", images)
    np.save(folder / "temperatures.npy", temperatures)
    field = subject(*SIZE)[0]
    # an epoch with all 192 corners takes the emulated processor three periods
    third = field.subset(np.flatnonzero(field.groups % 3 == 0))
    write_testfield(folder / "testfield.csv", third)
    text = yaml.safe_dump(configuration(serial_port), sort_keys=False)
    (folder / "config.yaml").write_text(text)
