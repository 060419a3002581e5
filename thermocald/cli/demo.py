"""`thermocald demo` and `simulate`: a camera that warms up, without hardware."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import JsonOption, SeedOption, progress, say, show, write_json
from thermocald.errors import UsageError


def demo(
    out: Path = typer.Option(
        Path("thermocald-demo"), help="Folder for the store and the recording."
    ),
    epochs: int = typer.Option(150, min=10, help="Number of epochs, of 10 s each."),
    seed: SeedOption = 0,
    discovery: bool = typer.Option(
        True, "--discovery/--no-discovery", help="End with a hidden effect found."
    ),
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
    preset: str | None = typer.Option(None, help="A camera of the reference study; see --list."),
    model: Path | None = typer.Option(None, help="A thermal model (YAML); replaces the preset's."),
    camera: Path | None = typer.Option(
        None, help="A camera file (YAML): heat, thermometers, noise."
    ),
    testfield: str | None = typer.Option(None, help="A testfield.csv, or markers, circles, plain."),
    programme: Path | None = typer.Option(None, help="What is done to the camera (YAML)."),
    out: Path | None = typer.Option(None, help="The recording to write."),
    frames: bool = typer.Option(
        False, "--frames", help="Render frames instead of measured image points."
    ),
    effect: list[Path] | None = expert(
        None, help="An effect file (YAML) to add, such as a proposal."
    ),
    seed: SeedOption = 0,
    series: str = typer.Option("M1", help="Name of the series (preset)."),
    model_out: Path | None = expert(None, help="Also write the model that was simulated."),
    list_: bool = typer.Option(False, "--list", help="List presets and effects."),
    json: JsonOption = None,
) -> None:
    """Simulate a camera that warms up, and write a recording of it.

    Example: thermocald simulate --preset rpi-v2.1-heating --out rpi-M1 --seed 1
    """
    import thermocald as tc

    if list_:
        known = tc.catalogue()
        show(known, json)
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
