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
    from thermocald.analysis.thermal import predictions
    from thermocald.analysis.thermal.model_log import read_model_log

    if sum(option is not None for option in (temperature, log, test, programme)) != 1:
        raise UsageError("give one of --temperature, --log, --test, --programme")
    thermal = tc.load_camera(model)
    if thermal.warning:
        say(f"warning: {thermal.warning}")
    with warnings_said():
        if temperature is not None:
            others = _channels(channel or [])
            state = thermal.at(temperature, channels=others or None, extrapolate=extrapolate)
            document, lines = predictions.describe_camera(thermal, state, distance)
        elif log is not None:
            table = read_model_log(thermal, log, log_options)
            document, lines = predictions.predict_along(thermal, table, extrapolate)
        elif test is not None:
            with progress(None, "reading and measuring") as advance:
                document, lines = predictions.check_prediction(thermal, test, advance)
        else:
            assert programme is not None
            document, lines = predictions.advise_warm_up(
                thermal, programme, camera, distance, wanted
            )
    if write_result(document, json):
        typer.echo("\n".join(lines))


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
