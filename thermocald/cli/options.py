"""Options that several commands share, and what their text stands for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermocald.errors import UsageError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.epoch.adjustment import DEFAULT_FREE, AdjustmentSettings

if TYPE_CHECKING:
    from thermocald.store.logger.clock import DeviceClock

__all__ = [
    "DEFAULT_FREE_TEXT",
    "ConfigOption",
    "ExteriorOption",
    "ExtrapolateOption",
    "FreeOption",
    "JobsOption",
    "JsonOption",
    "ModelOption",
    "PhotosArgument",
    "PixelPitchOption",
    "SeedOption",
    "StoreArgument",
    "TimezoneOption",
    "adjustment_settings",
    "device_clock",
    "free_names",
]

JsonOption = Annotated[
    str | None, typer.Option("--json", help="Write the result as JSON; - for standard output.")
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="The configuration [./config.yaml, /etc/thermocald/config.yaml]."
    ),
]
StoreArgument = Annotated[Path | None, typer.Argument(help="The store; may be in use by a daemon.")]
PhotosArgument = Annotated[
    list[Path], typer.Argument(metavar="PHOTO…", help="Photographs, or folders of them.")
]
PixelPitchOption = Annotated[
    float | None, typer.Option("--pixel-pitch", help="Size of a pixel in mm.", min=1e-5, max=1.0)
]
ModelOption = Annotated[Path, typer.Option("--model", help="The thermal model.")]
ExtrapolateOption = Annotated[
    bool, typer.Option("--extrapolate", help="Allow temperatures far outside the fit.")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Of all random numbers.")]
TimezoneOption = Annotated[
    str | None,
    typer.Option("--timezone", help="Of times without a zone: Europe/Berlin, UTC, +02:00."),
]
FreeOption = Annotated[
    str,
    typer.Option(
        "--free", help="Interior orientation to estimate, separated by commas; the rest is held."
    ),
]
JobsOption = Annotated[
    int,
    typer.Option(min=1, max=256, help="Processes; the results are the same to the bit."),
]
ExteriorOption = Annotated[
    str,
    typer.Option(
        "--exterior",
        help="per_epoch: every epoch has its own orientation; series: one for all epochs; mount: "
        "one and movements of the mount, whose size is estimated; auto: what the data show.",
    ),
]


def device_clock(timezone: str | None) -> DeviceClock:
    """The clock that `--timezone` describes; without it times without a zone are refused."""
    from thermocald.store.logger.clock import DeviceClock, time_zone

    return DeviceClock(None if timezone is None else time_zone(timezone), ambiguous="order")


def free_names(text: str) -> tuple[str, ...]:
    """Names of IOP from a comma-separated list; `none` frees nothing."""
    if text.strip().lower() in ("", "none"):
        return ()
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in IOP_NAMES:
            raise UsageError(f"--free: {name!r} is no IOP; there are {', '.join(IOP_NAMES)}, none")
    return tuple(name for name in IOP_NAMES if name in names)


def adjustment_settings(free: str) -> AdjustmentSettings:
    """The settings of an epoch's adjustment from `--free`."""
    return AdjustmentSettings(free=free_names(free))


DEFAULT_FREE_TEXT = ",".join(DEFAULT_FREE)
