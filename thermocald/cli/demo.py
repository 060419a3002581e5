"""`thermocald demo`: the main job without hardware, from a warming camera to a named effect.

The daemon's own pipeline on a camera that is rendered: frames of a corner field, a thermometer,
25 minutes of heating and cooling on a virtual clock. What was put in is shown with what was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from thermocald.atomic_file import make_folder
from thermocald.cli.common import progress, say, write_json
from thermocald.cli.options import JsonOption, SeedOption
from thermocald.errors import DataError

if TYPE_CHECKING:
    from thermocald.analysis.series.table import SeriesTable
    from thermocald.arrays import Array

__all__ = ["demo"]

_NAMES = ("c", "x0", "y0")


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the store and the recording.")] = Path(
        "thermocald-demo"
    ),
    epochs: Annotated[int, typer.Option(min=10, help="Of 10 s each.")] = 150,
    seed: SeedOption = 0,
    discovery: Annotated[
        bool, typer.Option("--discovery/--no-discovery", help="End with a hidden effect found.")
    ] = True,
    json: JsonOption = None,
) -> None:
    """Run the main job on a camera that is rendered: 25 minutes of heating and cooling.

    Example: thermocald demo --out /tmp/demo
    """
    if out.exists() and any(out.iterdir()):
        raise DataError(f"{out}: exists and is not empty; give another folder with --out")
    say(f"a rendered camera (3280 × 2464) looks at a corner field for {epochs} epochs of 10 s")
    run = _acquire(out, epochs, seed)
    rows = _compare(run)
    document: dict[str, Any] = {
        "format": "thermocald-demo/1",
        "epochs": epochs,
        "ok": int(run.table.ok.sum()),
        "targets": run.targets,
        "sigma0": float(np.median(run.table.sigma0[run.table.ok])),
        "temperature": [
            float(np.nanmin(run.table.temperature)),
            float(np.nanmax(run.table.temperature)),
        ],
        "parameters": rows,
        "store": out / "demo.db",
        "recording": out / "M1",
    }
    if json != "-":
        _tell(document)
    if discovery:
        document["discovery"] = _discover(out, seed, quiet=json == "-")
    if json is not None:
        write_json(document, json)


@dataclass(frozen=True, eq=False)
class _Run:
    table: SeriesTable
    truth: Array  # (E, 16) at the frames' times
    pitch: float
    targets: int


def _acquire(out: Path, epochs: int, seed: int) -> _Run:
    """The pipeline on a virtual clock, kept in a store and a recording."""
    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.acquisition.pipeline import Pipeline
    from thermocald.analysis.series.stored import table_of_stored
    from thermocald.hal import VirtualClock, open_device
    from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
    from thermocald.store.database.row import EpochResult
    from thermocald.store.database.store import Store
    from thermocald.store.recording.reader import CameraSpec, Channel, Head, RecordingWriter
    from thermocald.store.sources import open_source

    clock = VirtualClock()
    camera = open_device("camera", "mock", {"seed": seed}, clock)
    thermometer = open_device("thermometer", "mock", {"seed": seed + 1}, clock)
    make_folder(out)
    with camera, thermometer:
        sensor, field = camera.model.sensor, camera.field
        settings = AdjustmentSettings()
        head = Head(
            "demo-M1",
            "M1",
            10.0,
            CameraSpec("demo", sensor, 3.04, None),
            {"temperature": Channel("degC", 0.0625)},
        )
        calibrator = Calibrator(sensor, field, settings, nominal_c=3.04)
        pipeline = Pipeline(camera, {"temperature": thermometer}, calibrator, clock, period_s=10.0)
        truth = []
        with (
            Store.open(out / "demo.db", "append", durable=False) as store,
            RecordingWriter(out / "M1", head, field) as recording,
            progress(epochs, "epochs") as advance,
        ):
            series = store.create_series(
                head,
                field,
                start="cold",
                identity=camera.identity(),
                settings={"exterior": "per_epoch", "free": list(settings.free)},
                created_utc=clock.utc(),
            )
            for done, frame in pipeline.run(epochs):
                result = EpochResult.from_adjustment(done.adjustment)
                store.append(series, done.epoch, result, extra=done.extra)
                recording.append(done.epoch)
                at = camera.truth(frame.monotonic)
                truth.append(np.concatenate([at.iop[0], at.eop[0]]))
                advance(1)
    with open_source(out / "demo.db") as source:
        table = table_of_stored(source, source.find_series(), settings, "series")
    return _Run(table, np.array(truth), sensor.pixel_pitch, len(field))


def _compare(run: _Run) -> list[dict[str, Any]]:
    """Per kelvin and over the series: the drift put in and the drift found."""
    from thermocald.photogrammetry.camera.camera_model import IOP_NAMES

    table, ok = run.table, run.table.ok & np.isfinite(run.table.temperature)
    t = table.temperature[ok] - table.temperature[ok].mean()
    hottest = int(np.argmax(table.temperature[ok]))
    rows = []
    for name in _NAMES:
        k = IOP_NAMES.index(name)
        found, sd, true = table.values[ok, k], table.sd[ok, k], run.truth[ok, k]
        error = (found - found.mean()) - (true - true.mean())
        rows.append(
            {
                "name": name,
                "drift_in_mm": float(true[hottest] - true[0]),
                "drift_found_mm": float(found[hottest] - found[0]),
                "sd_drift_found_mm": float(np.hypot(sd[hottest], sd[0])),
                "drift_in_px": float(true[hottest] - true[0]) / run.pitch,
                "drift_found_px": float(found[hottest] - found[0]) / run.pitch,
                "sd_drift_found_px": float(np.hypot(sd[hottest], sd[0])) / run.pitch,
                "rate_in_mm_per_k": float(true @ t / (t @ t)),
                "rate_found_mm_per_k": float(found @ t / (t @ t)),
                "scatter_over_sd": float(np.sqrt(np.mean(error**2) / np.mean(sd**2))),
            }
        )
    return rows


def _tell(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    low, high = document["temperature"]
    typer.echo(
        f"{document['ok']} of {document['epochs']} epochs calibrated, {document['targets']} "
        f"targets, {low:.1f} to {high:.1f} °C, sigma0 {document['sigma0']:.2f}"
    )
    table = Table(title="Drift from the first epoch to the hottest, px", box=None, pad_edge=False)
    for title in ("", "put in", "found", "sd", "scatter / sd"):
        table.add_column(title, justify="left" if not title else "right")
    for row in document["parameters"]:
        table.add_row(
            row["name"],
            f"{row['drift_in_px']:+.3f}",
            f"{row['drift_found_px']:+.3f}",
            f"{row['sd_drift_found_px']:.3f}",
            f"{row['scatter_over_sd']:.2f}",
        )
    console.print(table, highlight=False)
    typer.echo(f"store:     {document['store']}")
    typer.echo(f"recording: {document['recording']}")


def _discover(out: Path, seed: int, quiet: bool) -> dict[str, Any]:
    """A camera with a lag that its model does not have: found, named, added."""
    from thermocald.cli.demo_discovery import discover_hidden_effect

    return discover_hidden_effect(out, seed, quiet)
