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

from thermocald.cli.common import progress, say, write_json
from thermocald.cli.options import JsonOption, SeedOption
from thermocald.errors import DataError
from thermocald.files import make_folder

if TYPE_CHECKING:
    from thermocald import Epochs
    from thermocald.arrays import Array
    from thermocald.daemon.station import Station

_NAMES = ("c", "x0", "y0")  # the first of the interior orientation
_HIDDEN = "thermal_lag"
_TAU_S = 75.0


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


def _acquire(out: Path, epochs: int, seed: int) -> _Run:
    """Have the daemon take the epochs on a virtual clock, then write their recording."""
    import thermocald as tc
    from thermocald.daemon.given_config import demo_config
    from thermocald.daemon.service import Service
    from thermocald.daemon.systemd import set_up_logging
    from thermocald.hal import VirtualClock, open_device
    from thermocald.store.database.archive import archive_series
    from thermocald.store.database.store import Store

    make_folder(out)
    config = demo_config(out, seed)
    clock = VirtualClock()
    begin = clock.utc() - clock.monotonic()
    taken = 0
    set_up_logging("warning")
    with progress(epochs, "epochs") as advance:

        def look(station: Station) -> bool:
            nonlocal taken
            run = station.cameras[0].run
            now = 0 if run is None else run.taken
            advance(now - taken)
            taken = now
            return False

        Service(config, epochs=epochs, until_finished=True, on_turn=look, clock=clock).run()
        advance(epochs - taken)
    with Store.open(config.store.path) as store:
        archive_series(store, store.find_series(), out / "M1")
    series = tc.open(config.store.path)
    table = series.calibrate(exterior="series")
    with open_device("camera", "mock", {"seed": seed}, VirtualClock()) as camera:
        truth = np.array([camera.truth(float(utc) - begin).iop[0] for utc in table.frame_time])
    return _Run(table, truth, series.head.camera.sensor.pixel_pitch, len(series.testfield))


@dataclass(frozen=True, eq=False)
class _Run:
    table: Epochs
    truth: Array  # (E, 10) at the frames' times
    pitch: float
    targets: int


def _compare(run: _Run) -> list[dict[str, Any]]:
    """Per kelvin and over the series: the drift put in and the drift found."""
    table, ok = run.table, run.table.ok & np.isfinite(run.table.temperature)
    t = table.temperature[ok] - table.temperature[ok].mean()
    hottest = int(np.argmax(table.temperature[ok]))
    rows = []
    for k, name in enumerate(_NAMES):
        found, sd, true = table.values[ok, k], table.sd[ok, k], run.truth[ok, k]
        error = (found - found.mean()) - (true - true.mean())
        drifts = {
            "in": float(true[hottest] - true[0]),
            "found": float(found[hottest] - found[0]),
            "sd": float(np.hypot(sd[hottest], sd[0])),
        }
        rows.append(
            {
                "name": name,
                "drift_in_mm": drifts["in"],
                "drift_found_mm": drifts["found"],
                "sd_drift_found_mm": drifts["sd"],
                "drift_in_px": drifts["in"] / run.pitch,
                "drift_found_px": drifts["found"] / run.pitch,
                "sd_drift_found_px": drifts["sd"] / run.pitch,
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
    """Simulate M1 and M2 with a hidden lag, discover it on M1, prove it on M2; the document."""
    import thermocald as tc

    say(f"hiding an effect: the camera follows the thermometer with a lag of {_TAU_S:.0f} s")
    folder = out / "discovery"
    make_folder(folder)
    M1, M2 = (
        tc.simulate(
            "rpi-v2.1-heating", effects={_HIDDEN: {"tau": _TAU_S}}, own_effects=False,
            seed=seed + number, series=name, out=folder / name,
        )
        for number, name in enumerate(("M1", "M2"))
    )  # fmt: skip
    say("discovering: where do model and measurement disagree, and why?")
    found = tc.discover(M1, verify=[M2], say=say)
    document = found.as_dict()
    document["model"] = str(found.save(folder / "camera.thermal.yaml"))
    document["hidden"] = {"effect": _HIDDEN, "tau_s": _TAU_S}
    if not quiet:
        _tell_effect(document)
    return document


def _tell_effect(document: dict[str, Any]) -> None:
    hidden = document["hidden"]
    typer.echo(f"\nhidden:    {hidden['effect']}, tau {hidden['tau_s']:.0f} s")
    for effect in document["effects"]:
        typer.echo(f"found:     {effect['effect']}: {effect['statement']}")
    for label, key in (("on M1", "fit"), ("on M2", "verify")):
        gap = document["gap"][key]
        if gap is not None:
            typer.echo(
                f"gap {label}: {gap['before']['rms_px']:.3f} → {gap['after']['rms_px']:.3f} px, "
                f"reduced χ² {gap['before']['chi2_reduced']:.2f} → "
                f"{gap['after']['chi2_reduced']:.2f}"
            )
    typer.echo(f"model:     {document['model']}")
