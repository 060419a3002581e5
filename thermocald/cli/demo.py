"""`thermocald demo` and `simulate`: a camera that warms up, without hardware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, write_json, write_result
from thermocald.cli.options import JsonOption, SeedOption
from thermocald.errors import UsageError


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
    from thermocald.demonstration import discover_hidden_effect, run_demo

    say(f"a rendered camera (3280 × 2464) looks at a corner field for {epochs} epochs of 10 s")
    with progress(epochs, "epochs") as advance:
        document = run_demo(out, epochs, seed, advance)
    if json != "-":
        _tell(document)
    if discovery:
        document["discovery"] = discover_hidden_effect(out, seed, say)
        if json != "-":
            _tell_effect(document["discovery"])
    if json is not None:
        write_json(document, json)


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
        list[Path] | None, expert(help="An effect file (YAML) to add, such as a proposal.")
    ] = None,
    seed: SeedOption = 0,
    series: Annotated[str, typer.Option(help="Name of the series (preset).")] = "M1",
    model_out: Annotated[
        Path | None, expert(help="Also write the model that was simulated.")
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="List presets and effects.")] = False,
    json: JsonOption = None,
) -> None:
    """Simulate a camera that warms up, and write a recording of it.

    Example: thermocald simulate --preset rpi-v2.1-heating --out rpi-M1 --seed 1
    """
    import thermocald as tc

    if list_:
        known = tc.catalogue()
        if write_result(known.as_dict(), json):
            typer.echo(str(known))
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
    if write_result({**made.simulation.as_dict(), "recording": str(out)}, json):
        typer.echo(f"{out}: {made.simulation.lines()[0]}")
