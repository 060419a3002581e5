"""`thermocald study`: statistics, significance, Monte-Carlo, and the report of measured series."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.commands import expert
from thermocald.cli.common import progress, write_result
from thermocald.cli.options import (
    DEFAULT_FREE,
    ExteriorOption,
    FreeOption,
    JobsOption,
    JsonOption,
    SeedOption,
)
from thermocald.errors import UsageError
from thermocald.files import make_folder
from thermocald.store.server.connection import is_server
from thermocald.store.sources import require_source

if TYPE_CHECKING:
    from thermocald.results import Study


def study(
    inputs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[LABEL=]RECORDING_OR_STORE…",
            help="Recordings (folders) and stores (files). Series with one label are one camera; "
            "the label is the camera's name unless given.",
        ),
    ] = None,
    json: JsonOption = None,
    report: Annotated[Path | None, typer.Option(help="Write the report, one HTML file.")] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Write all figures as SVG and PNG here.")
    ] = None,
    window: Annotated[int, expert(min=3, help="Epochs in the F-test's window, odd.")] = 31,
    alpha: Annotated[float, expert(min=1e-6, max=0.5, help="Level of the F-test.")] = 0.05,
    sets: Annotated[int, expert(min=2, help="Interior orientations drawn (Monte-Carlo).")] = 50_000,
    seed: SeedOption = 0,
    distance: Annotated[float, expert(min=0.01, help="Of the object plane, m.")] = 10.0,
    grid: Annotated[
        int, expert("--grid", min=2, max=9, help="Image points per row and column.")
    ] = 3,
    focus: Annotated[
        float, expert(min=0.01, help="Focus distance for the depth of field, m.")
    ] = 1.0,
    f_number: Annotated[float, expert(min=0.1, help="Of the lens.")] = 2.0,
    confusion: Annotated[
        float | None, expert(min=1e-6, help="Circle of confusion, mm [diagonal/2000].")
    ] = None,
    thermometer_sd: Annotated[
        float | None, expert(min=0.0, help="Noise of the thermometers, K [estimated].")
    ] = None,
    exterior: ExteriorOption = "auto",
    free: FreeOption = DEFAULT_FREE,
    jobs: JobsOption = 1,
    reference: Annotated[
        bool, expert("--reference", help="Study the presets instead, next to the reference study.")
    ] = False,
) -> None:
    """How the camera changes with its temperature, whether that is significant, what it does.

    Example: thermocald study M1 M2 --report study.html --json study.json
    """
    import thermocald as tc

    if reference == bool(inputs):
        raise UsageError(
            "give recordings or stores to study, or --reference"
            if not inputs
            else "--reference studies the presets; give no recordings with it"
        )
    if window % 2 == 0:
        raise UsageError(f"--window is {window}; it must be odd, so that it has a centre")
    settings: dict[str, Any] = {
        "window": window,
        "alpha": alpha,
        "sets": sets,
        "seed": seed,
        "distance_mm": 1000 * distance,
        "grid": grid,
        "focus_mm": 1000 * focus,
        "f_number": f_number,
        "confusion_mm": confusion,
        "thermometer_sd": thermometer_sd,
        "jobs": jobs,
    }
    # Refused before the work, not after it.
    for path in (report, figures):
        if path is not None:
            make_folder(path.absolute().parent)
    if reference:
        with progress(None, "simulating, adjusting, studying") as advance:
            result = tc.reference_study(progress=advance, **settings)
    else:
        result = _study(inputs or [], settings, exterior, free)
    written = []
    if report is not None:
        written.append(str(result.report(report)))
    if figures is not None:
        written.append(f"{len(result.save_figures(figures))} figures in {figures}")
    if write_result(result.as_dict(), json):
        typer.echo("\n".join([str(result), *(f"written: {line}" for line in written)]))


def _study(inputs: list[str], settings: dict[str, Any], exterior: str, free: str) -> Study:
    import thermocald as tc

    labels: list[str | None] = []
    series: list[tc.Series] = []
    for label, path in map(_labelled, inputs):
        found = tc.open_all(path)
        labels += [label] * len(found)
        series += found
    cameras = len({label or one.camera for label, one in zip(labels, series, strict=True)})
    with progress(settings["sets"] * cameras, "calibrating and simulating") as advance:
        return tc.study(
            *series, labels=labels, **settings, exterior=exterior, free=free, progress=advance
        )


def _labelled(text: str) -> tuple[str | None, Path]:
    """`LABEL=PATH` or `PATH`; DataError where there is nothing at the path."""
    label, equals, rest = text.partition("=")
    # A path may hold "="; what exists as it stands is a path.
    if not equals or Path(text).exists() or is_server(text):
        label, rest = "", text
    return label or None, require_source(Path(rest))
