"""`thermocald predict`: the interior orientation at a temperature, or along a temperature log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, warnings_said, write_result
from thermocald.cli.options import (
    ExtrapolateOption,
    JsonOption,
    ModelOption,
    takes_log_options,
)
from thermocald.errors import UsageError


@takes_log_options
def predict(
    model: ModelOption,
    temperature: Annotated[
        float | None, typer.Option(help="°C: a camera that has long been there.")
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="A logger's file, a recording, or a store.")
    ] = None,
    test: Annotated[
        Path | None, typer.Option(help="Recording or store: how well the model predicts it.")
    ] = None,
    programme: Annotated[
        Path | None, typer.Option(help="Warm-up advice for what is done to the camera.")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="Camera file, for --programme.")] = None,
    channel: Annotated[
        list[str] | None, expert(help="NAME=°C of another thermometer; repeatable.")
    ] = None,
    distance: Annotated[float, expert(min=0.01, help="Of the object, m.")] = 10.0,
    wanted: Annotated[float, expert("--wanted-mm", min=1e-3, help="Wanted error there, mm.")] = 5.0,
    extrapolate: ExtrapolateOption = False,
    log_options: Any = None,
    json: JsonOption = None,
) -> None:
    """Predict the interior orientation with standard deviations.

    Example: thermocald predict --model camera.thermal.yaml --temperature 35
    """
    import thermocald as tc

    thermal = tc.load_camera(model)
    if thermal.warning:
        say(f"warning: {thermal.warning}")
    with warnings_said(), progress(None, "reading and measuring") as advance:
        found = tc.predict(
            thermal, temperature, channels=_channels(channel or []) or None, log=log,
            log_options=log_options, test=() if test is None else tc.open_all(test),
            programme=programme, camera=camera, distance_m=distance, wanted_mm=wanted,
            extrapolate=extrapolate, progress=advance,
        )  # fmt: skip
    if write_result(found.as_dict(), json):
        typer.echo(str(found))


def _channels(given: list[str]) -> dict[str, float]:
    found = {}
    for text in given:
        name, equals, value = text.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise UsageError(f"--channel {text}: write NAME=°C, such as board_temperature=48.5")
    return found
