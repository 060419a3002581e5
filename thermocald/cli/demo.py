"""`thermocald demo` and `simulate`: a camera that warms up, without hardware.

The demo runs the daemon on a virtual clock for 25 minutes of heating and cooling, with frames of a
corner field and a thermometer. It compares the estimated drift with the true one, and then
discovers a hidden effect in a second simulation.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer

import thermocald as tc
from thermocald.cli import options as opt
from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, show, write_json
from thermocald.errors import DataError, UsageError
from thermocald.files import make_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.arrays import Array
    from thermocald.daemon.service import Service


def demo(
    out: Path = typer.Option(
        Path("thermocald-demo"), "--out", "-o", help="Folder for store and recording."
    ),
    epochs: int = typer.Option(150, min=10, help="Number of epochs, of 10 s each."),
    seed: opt.Seed = 0,
    discovery: bool = typer.Option(
        True, "--discovery/--no-discovery", help="Finish with the discovery of a hidden effect."
    ),
    json: opt.Json = None,
) -> None:
    """Run the daemon on a rendered camera through 25 minutes of heating and cooling.

    Example: thermocald demo --out /tmp/demo
    """
    if out.exists() and any(out.iterdir()):
        raise DataError(f"{out}: exists and is not empty; give another folder with --out")
    say(f"a rendered camera (3280 × 2464 px) takes {epochs} epochs of 10 s of a corner field")
    with progress(epochs, "epochs") as advance:
        series, truth = _acquire(out, epochs, seed, advance)
    table = series.calibrate(exterior="series")
    ok, temperature = table.ok, table.temperature
    document: dict[str, Any] = {
        "format": "thermocald-demo/1",
        "epochs": epochs,
        "ok": int(ok.sum()),
        "targets": len(series.testfield),
        "sigma0": float(np.median(table.sigma0[ok])),
        "temperature": [float(np.nanmin(temperature)), float(np.nanmax(temperature))],
        "parameters": _compare(table, truth, series.head.camera.sensor.pixel_pitch),
        "store": out / "demo.db",
        "recording": out / "M1",
    }
    if json != "-":
        _print_drift(document)
    if discovery:
        found = _discover_hidden_effect(out / "discovery", seed)
        model = found.save(out / "discovery" / "camera.thermal.yaml")
        document["discovery"] = {**found.as_dict(), "model": str(model)}
        document["discovery"]["hidden"] = {"effect": _HIDDEN, "tau_s": _TAU_S}
        if json != "-":
            typer.echo(f"\nhidden: {_HIDDEN}, tau {_TAU_S:.0f} s\n{found}\nmodel: {model}")
    write_json(document, json)


def _print_drift(document: dict[str, Any]) -> None:
    low, high = document["temperature"]
    typer.echo(
        f"{document['ok']} of {document['epochs']} epochs calibrated, {document['targets']} "
        f"targets, {low:.1f} to {high:.1f} °C, sigma0 {document['sigma0']:.2f}"
    )
    typer.echo("Drift from the first epoch to the hottest, px:")
    typer.echo("       true  estimated     sd  scatter / sd")
    for row in document["parameters"]:
        drifts = f"{row['drift_in_px']:+8.3f}  {row['drift_found_px']:+9.3f}".replace("-", "−")
        scatter = f"{row['sd_drift_found_px']:.3f}  {row['scatter_over_sd']:12.2f}"
        typer.echo(f"{row['name']:<2} {drifts}  {scatter}")
    typer.echo(f"store:     {document['store']}")
    typer.echo(f"recording: {document['recording']}")


def simulate(
    preset: str | None = typer.Option(None, help="A camera of the reference study; see --list."),
    model: Path | None = typer.Option(None, help="Thermal model (YAML); replaces the preset's."),
    camera: Path | None = typer.Option(None, help="Camera file (YAML): heat, thermometers, noise."),
    testfield: str | None = typer.Option(None, help="A testfield.csv, or markers, circles, plain."),
    programme: Path | None = typer.Option(
        None, help="Programme (YAML): epochs, ambient temperatures, heat sources."
    ),
    out: Path | None = typer.Option(None, "--out", "-o", help="The recording to write."),
    frames: bool = typer.Option(
        False, "--frames", help="Render frames instead of simulating measured image points."
    ),
    effect: list[str] | None = expert(
        None, help="NAME[:PARAMETER=VALUE,…] or effect file (YAML): an effect to add; repeatable."
    ),
    seed: opt.Seed = 0,
    series: str = typer.Option("M1", help="Name of the series, for a preset."),
    model_out: Path | None = expert(None, help="Also write the simulated thermal model."),
    list_: bool = typer.Option(False, "--list", help="List the presets and effects."),
    json: opt.Json = None,
) -> None:
    """Simulate a camera that warms up, and write a recording of it.

    Example: thermocald simulate --preset rpi-v2.1-heating --out rpi-M1 --seed 1
    """
    if list_:
        if out is not None:
            raise UsageError(f"--list writes no recording; leave out --list, or --out {out}")
        show(tc.catalogue(), json)
        return
    if out is None:
        raise UsageError("--out is missing: the folder of the recording to write")
    with progress(None, "simulating") as advance:
        made = tc.simulate(
            preset, model=model, camera=camera, programme=programme, effects=effect or (),
            seed=seed, series=series, testfield=testfield, frames=frames, out=out,
            model_out=model_out, progress=advance,
        )  # fmt: skip
    assert made.simulation is not None
    document = {**made.simulation.as_dict(), "recording": out}
    show(document, json, f"{out}: {made.simulation.lines()[0]}")
    for doubt in document["doubts"]:
        say(f"doubtful: {doubt}")


_NAMES = ("c", "x0", "y0")  # the first parameters of the interior orientation
_HIDDEN = "thermal_lag"
_TAU_S = 75.0


def _acquire(
    out: Path, epochs: int, seed: int, advance: Callable[[int], None]
) -> tuple[tc.Series, Array]:
    """Run the daemon on a virtual clock until it has taken the epochs, then write the recording.

    Returns the series, and the true interior orientation (E, 10) at the times of the frames.
    """
    from thermocald.daemon.plan import demo_config
    from thermocald.daemon.service import Service
    from thermocald.daemon.systemd import set_up_logging
    from thermocald.hal import VirtualClock, open_device
    from thermocald.store.archive import archive_series
    from thermocald.store.database.store import Store

    make_folder(out)
    config = demo_config(out, seed)
    clock = VirtualClock()
    begin = clock.utc() - clock.monotonic()
    taken = 0
    set_up_logging("warning")

    def show_progress(service: Service) -> bool:
        nonlocal taken
        run = service.station.cameras[0].run
        now = 0 if run is None else run.taken
        advance(now - taken)
        taken = now
        return False

    service = Service(
        config, epochs=epochs, until_finished=True, on_turn=show_progress, clock=clock
    )
    service.run()
    show_progress(service)
    if taken < epochs:  # Ctrl-C, which ends the daemon without an exception
        raise typer.Abort
    with Store.open(config.store.path) as store:
        archive_series(store, store.find_series(), out / "M1")
    series = tc.open(config.store.path)
    with open_device("camera", "mock", {"seed": seed}, VirtualClock()) as camera:
        return series, np.array([camera.truth(float(t) - begin).iop[0] for t in series.frame_time])


def _compare(table: tc.Epochs, truth: Array, pitch: float) -> list[dict[str, Any]]:
    """Compare estimated and true drift, per kelvin and from the first epoch to the hottest.

    pitch: pixel pitch, mm. Returns a record for each of c, x0, y0.
    """
    ok = table.ok & np.isfinite(table.temperature)
    t = table.temperature[ok] - table.temperature[ok].mean()
    hottest = int(np.argmax(table.temperature[ok]))
    rows = []
    for k, name in enumerate(_NAMES):
        found, sd, true = table.values[ok, k], table.sd[ok, k], truth[ok, k]
        error = (found - found.mean()) - (true - true.mean())
        drifts = {
            "drift_in": float(true[hottest] - true[0]),
            "drift_found": float(found[hottest] - found[0]),
            "sd_drift_found": float(np.hypot(sd[hottest], sd[0])),
        }
        rows.append(
            {
                "name": name,
                **{f"{key}_mm": drift for key, drift in drifts.items()},
                **{f"{key}_px": drift / pitch for key, drift in drifts.items()},
                "rate_in_mm_per_k": float(true @ t / (t @ t)),
                "rate_found_mm_per_k": float(found @ t / (t @ t)),
                "scatter_over_sd": float(np.sqrt(np.mean(error**2) / np.mean(sd**2))),
            }
        )
    return rows


def _discover_hidden_effect(folder: Path, seed: int) -> tc.Discovery:
    """Simulate a hidden lag in two series, discover it in M1 and verify it in M2."""
    say(
        "simulating a hidden effect: the camera follows the thermometer with a lag of "
        f"{_TAU_S:.0f} s"
    )
    make_folder(folder)
    M1, M2 = (
        tc.simulate(
            "rpi-v2.1-heating", effects={_HIDDEN: {"tau": _TAU_S}}, own_effects=False,
            seed=seed + number, series=name, out=folder / name,
        )
        for number, name in enumerate(("M1", "M2"))
    )  # fmt: skip
    say("discovering where simulation and measurement disagree, and why")
    return tc.discover(M1, verify=[M2], say=say)
