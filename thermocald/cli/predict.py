"""`thermocald predict` and `correct`: a camera at a temperature, and what was measured with it."""

from __future__ import annotations

import collections
from pathlib import Path
from typing import Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, say, warnings_said, write_parts, write_result
from thermocald.cli.options import (
    ExtrapolateOption,
    JsonOption,
    ModelOption,
    TimezoneOption,
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


@takes_log_options
def correct(
    points: Annotated[
        Path,
        typer.Argument(
            metavar="POINTS.csv",
            help="Columns time, x, y (px) and others; or time, image; - for standard input.",
        ),
    ],
    model: ModelOption,
    log: Annotated[Path, typer.Option(help="A logger's file, a recording, or a store.")],
    out: Annotated[
        Path | None, typer.Option(help="CSV to write (points), or folder (images).")
    ] = None,
    to: Annotated[float | None, expert(help="°C to correct to; default: the model's T0.")] = None,
    temperature_sd: Annotated[
        float | None,
        expert(min=0.0, help="Of a reading of the log, K; default: as the model's fit found it."),
    ] = None,
    image_size: Annotated[
        str | None, expert("--size", help="WIDTHxHEIGHT where images are binned.")
    ] = None,
    extrapolate: ExtrapolateOption = False,
    timezone: TimezoneOption = None,
    ambiguous: str = "order",
    log_options: Any = None,
    json: JsonOption = None,
) -> None:
    """Correct image points, or images, that were taken at known temperatures.

    A row that cannot be corrected is named by its line and does not stop the others; exit status 1.

    Example: thermocald correct --model camera.thermal.yaml --log weather.csv points.csv
    """
    import thermocald as tc

    thermal = tc.load_camera(model)
    if thermal.warning:
        say(f"warning: {thermal.warning}")
    done = tc.correct(
        points, thermal, log=log, log_options=log_options, to=to, temperature_sd=temperature_sd,
        size=None if image_size is None else _size(image_size), timezone=timezone,
        ambiguous=ambiguous, extrapolate=extrapolate, say=say,
    )  # fmt: skip
    with warnings_said():
        if done.of_images and out is None:
            raise UsageError("--out is missing: the folder for the corrected images")
        if out is not None:
            with progress(None, "correcting images") as advance:
                done.write(out, advance)
        elif json == "-":
            collections.deque(done.lines(), 0)
        else:
            write_parts(done.lines(), "-")
    if write_result(done.as_dict(), json) and out is not None:
        typer.echo(f"{out}: {done}")
    done.require_all()


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not width.isdigit() or not height.isdigit() or int(width) * int(height) == 0:
        raise UsageError(f"--size {text}: write WIDTHxHEIGHT in px, such as 1640x1232")
    return int(width), int(height)
