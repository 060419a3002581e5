"""`thermocald simulate`: a recording, with frames if wanted, of a camera that warms up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, write_result
from thermocald.cli.options import JsonOption, SeedOption
from thermocald.errors import UsageError


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
