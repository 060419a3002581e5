"""Configurations of the daemon that nobody writes: a rendered camera, a recording as devices."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.config import parse_config
from thermocald.store.recording.head import read_head

if TYPE_CHECKING:
    from thermocald.config import Config


def mock_config() -> Config:
    """A camera and a thermometer without hardware."""
    return _config(
        {
            "store": {"path": "thermocald-mock.db"},
            "frames": {"keep": "none", "folder": "thermocald-mock-frames", "min_free_gb": 0.1},
            "cameras": [
                {
                    "name": "mock",
                    "driver": "mock",
                    "principal_distance_mm": 3.04,
                    "thermometers": ["housing"],
                    "options": {"seed": 1},
                }
            ],
            "thermometers": [{"name": "housing", "driver": "mock", "seed": 2}],
        }
    )


def demo_config(folder: Path, seed: int) -> Config:
    """A rendered camera and a thermometer, kept in `demo.db` of a folder."""
    config = mock_config().model_dump(mode="json", by_alias=True)
    config["store"] |= {"path": str(folder.absolute() / "demo.db"), "durable": False}
    config["frames"] |= {"folder": str(folder.absolute() / "frames")}
    config["cameras"][0] |= {
        "name": "demo", "thermometers": ["temperature"], "options": {"seed": seed}
    }  # fmt: skip
    config["thermometers"][0] |= {"name": "temperature", "options": {"seed": seed + 1}}
    return parse_config(config, Path("config.yaml"))


def recording_config(path: Path, *, loop: bool = False) -> Config:
    """A recording as camera and thermometer."""
    head = read_head(path)
    sensor = head.camera.sensor
    replay = {"driver": "replay", "recording": str(path.absolute()), "loop": loop}
    period = max(0.05, head.interval)
    return _config(
        {
            "store": {"path": f"{path.absolute().name}.db", "durable": False},
            "frames": {"keep": "none", "folder": f"{path.absolute().name}-frames"},
            "cameras": [
                {
                    "name": _name(head.camera.name),
                    "series": _name(head.series),
                    "period_s": period,
                    "sensor": {
                        "width_px": sensor.width,
                        "height_px": sensor.height,
                        "pixel_pitch_mm": sensor.pixel_pitch,
                    },
                    "principal_distance_mm": head.camera.principal_distance,
                    "testfield": str((path / "testfield.csv").absolute()),
                    "thermometers": ["recorded"] if head.channels else [],
                    **replay,
                }
            ],
            "thermometers": [{"name": "recorded", "period_s": period, **replay}],
        }
    )


def _config(document: dict[str, Any]) -> Config:
    return parse_config(document, Path("config.yaml"))


def _name(text: str) -> str:
    """Text as a configuration takes it for a name."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text).lstrip("_.-")[:64] or "camera"
