"""`thermocald simulate`: a recording, with frames if wanted, of a camera that warms up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.options import JsonOption, SeedOption
from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.simulation.observations import Simulation

__all__ = ["simulate"]


def simulate(
    preset: Annotated[
        str | None, typer.Option(help="A camera of the reference study; see --list.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="A thermal model (YAML); replaces the preset's.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="A camera file (YAML): heat, thermometers, noise.")
    ] = None,
    testfield: Annotated[
        str | None, typer.Option(help="A testfield.csv, or markers, circles, plain.")
    ] = None,
    programme: Annotated[
        Path | None, typer.Option(help="What is done to the camera (YAML).")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The recording to write.")] = None,
    frames: Annotated[
        bool, typer.Option("--frames", help="Render frames instead of measured image points.")
    ] = False,
    effect: Annotated[
        list[Path] | None, typer.Option(help="An effect file (YAML) to add, such as a proposal.")
    ] = None,
    seed: SeedOption = 0,
    series: Annotated[str, typer.Option(help="Name of the series (preset).")] = "M1",
    model_out: Annotated[
        Path | None, typer.Option(help="Also write the model that was simulated.")
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="List presets and effects.")] = False,
    json: JsonOption = None,
) -> None:
    """Simulate a camera that warms up, and write a recording of it.

    Example: thermocald simulate --preset rpi-v2.1-heating --out rpi-M1 --seed 1
    """
    from thermocald.cli.common import progress, write_result

    if list_:
        _print_list(json)
        return
    if out is None:
        raise UsageError("--out is missing: the folder of the recording to write")
    simulation = _simulation(preset, model, camera, testfield, programme, seed, series)
    for path in effect or ():
        simulation = _with_effects(simulation, path)
    with progress(simulation.programme.epochs, "simulating") as advance:
        simulation.write(out, with_frames=frames, advance=advance)
    if model_out is not None:
        from thermocald.simulation.model_file import write_model

        write_model(model_out, replace(simulation.model, exterior=simulation.exterior))
    summary = _summary(simulation, out)
    if write_result(summary, json):
        drift = summary["drift"]
        typer.echo(
            f"{out}: {summary['epochs']} epochs, {summary['targets']} targets, "
            f"{summary['temperature']['first']:.1f} to {summary['temperature']['highest']:.1f} °C, "
            f"principal point moved by up to {drift['principal_point_px']:.1f} px, "
            f"principal distance by {drift['c_mm'] * 1000:.1f} µm"
        )


def _simulation(
    preset: str | None,
    model: Path | None,
    camera: Path | None,
    testfield: str | None,
    programme: Path | None,
    seed: int,
    series: str,
) -> Simulation:
    from thermocald.simulation.demonstration import load_field
    from thermocald.simulation.device import CameraDevice, default_heat, read_camera_device
    from thermocald.simulation.model_file import read_model
    from thermocald.simulation.observations import Simulation
    from thermocald.simulation.presets import preset_names, preset_simulation
    from thermocald.simulation.programme import read_programme

    field: TestField | None = load_field(testfield) if testfield is not None else None
    if preset is not None:
        simulation = preset_simulation(preset, seed, series, field)
        if camera is not None:
            simulation = replace(simulation, device=read_camera_device(camera))
        if programme is not None:
            simulation = replace(simulation, programme=read_programme(programme))
        if model is not None:
            simulation = replace(simulation, model=read_model(model))
        return simulation
    if model is None or programme is None:
        raise UsageError(
            f"give --preset ({', '.join(preset_names())}), or --model and --programme "
            "(--camera and --testfield as well, where the usual ones do not fit)"
        )
    thermal = read_model(model)
    if camera is not None:
        device = read_camera_device(camera)
    else:
        network, thermometers = default_heat()
        device = CameraDevice(thermal.camera, thermal.sensor, network, thermometers)
    if field is None:
        field = load_field("circles")
    return Simulation(thermal, device, field, read_programme(programme), seed)


def _with_effects(simulation: Simulation, path: Path) -> Simulation:
    from thermocald.simulation.effect_file import read_effects

    model = simulation.model
    for one in read_effects(path):
        model = model.with_effect(one)
    return replace(simulation, model=model)


def _summary(simulation: Simulation, out: Path) -> dict[str, Any]:
    import numpy as np

    truth, model = simulation.truth, simulation.model
    temperature = simulation.true_history.temperature()
    moved = truth.iop - truth.iop[0]
    pitch = model.sensor.pixel_pitch
    return {
        "format": "thermocald-simulation/1",
        "recording": str(out),
        "series": simulation.programme.series,
        "seed": simulation.seed,
        "epochs": simulation.programme.epochs,
        "targets": len(simulation.field),
        "model": {
            "name": model.name or model.camera,
            "version": model.version,
            "effects": [effect.name for effect in model.effects],
        },
        "temperature": {
            "first": float(temperature[0]),
            "last": float(temperature[-1]),
            "highest": float(temperature.max()),
        },
        "drift": {
            "principal_point_px": float(np.hypot(moved[:, 1], moved[:, 2]).max() / pitch),
            "principal_point_last_px": float(np.hypot(moved[-1, 1], moved[-1, 2]) / pitch),
            "c_mm": float(moved[np.argmax(np.abs(moved[:, 0])), 0]),
        },
        "noise_factor": {"first": float(truth.noise_factor[0]),
                         "highest": float(truth.noise_factor.max())},
    }  # fmt: skip


def _print_list(json: str | None) -> None:
    from thermocald.cli.common import write_json
    from thermocald.simulation import effects
    from thermocald.simulation.presets import PRESETS

    presets = [{"preset": p.name, "about": p.about} for p in PRESETS.values()]
    catalogue = [
        {"effect": name, "kind": effects.get(name).kind, "parameters": effects.get(name).units()}
        for name in effects.names()
    ]
    if json is not None:
        write_json({"presets": presets, "effects": catalogue}, json)
    if json == "-":
        return
    typer.echo("presets")
    for entry in presets:
        typer.echo(f"  {entry['preset']:<18} {entry['about']}")
    typer.echo("effects (for model files)")
    for name in effects.names():
        effect = effects.get(name)
        searched = ", ".join(f"{k} [{p.unit}]" for k, p in effect.nonlinear.items())
        linear = ", ".join(f"{k} [{effect.linear[k]}]" for k in effect.usual)
        typer.echo(f"  {name:<24} {'; '.join(t for t in (searched, linear) if t)}")
