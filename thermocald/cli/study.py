"""`thermocald study`: statistics, significance, Monte-Carlo, and the report of measured series."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from thermocald.atomic_file import make_folder
from thermocald.cli.common import progress, write_json
from thermocald.cli.options import (
    DEFAULT_FREE_TEXT,
    ExteriorOption,
    FreeOption,
    JobsOption,
    JsonOption,
    SeedOption,
    free_names,
)
from thermocald.errors import DataError, UsageError
from thermocald.store.server.address import is_server
from thermocald.store.sources import require_source

if TYPE_CHECKING:
    from thermocald.analysis.study.measured import MeasuredSeries
    from thermocald.analysis.study.reference import Comparison
    from thermocald.analysis.study.study import Study, StudySettings

__all__ = ["study"]


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
    title: Annotated[str, typer.Option(help="Of the report.")] = "Thermal study of a camera",
    window: Annotated[int, typer.Option(min=3, help="Epochs in the F-test's window, odd.")] = 31,
    alpha: Annotated[float, typer.Option(min=1e-6, max=0.5, help="Level of the F-test.")] = 0.05,
    sets: Annotated[
        int, typer.Option(min=2, help="Interior orientations drawn (Monte-Carlo).")
    ] = 50_000,
    seed: SeedOption = 0,
    distance: Annotated[float, typer.Option(min=0.01, help="Of the object plane, m.")] = 10.0,
    grid: Annotated[
        int,
        typer.Option("--grid", "--raster", min=2, max=9, help="Image points per row and column."),
    ] = 3,
    focus: Annotated[
        float, typer.Option(min=0.01, help="Focus distance for the depth of field, m.")
    ] = 1.0,
    f_number: Annotated[float, typer.Option(min=0.1, help="Of the lens.")] = 2.0,
    confusion: Annotated[
        float | None, typer.Option(min=1e-6, help="Circle of confusion, mm [diagonal/2000].")
    ] = None,
    thermometer_sd: Annotated[
        float | None, typer.Option(min=0.0, help="Noise of the thermometers, K [estimated].")
    ] = None,
    exterior: ExteriorOption = "auto",
    free: FreeOption = DEFAULT_FREE_TEXT,
    jobs: JobsOption = 1,
    reference: Annotated[
        bool,
        typer.Option("--reference", help="Study the presets instead, next to the reference study."),
    ] = False,
) -> None:
    """How the camera changes with its temperature, whether that is significant, what it does.

    Example: thermocald study M1 M2 --report study.html --json study.json
    """
    from thermocald.analysis.study.study import StudySettings

    if reference == bool(inputs):
        raise UsageError(
            "give recordings or stores to study, or --reference"
            if not inputs
            else "--reference studies the presets; give no recordings with it"
        )
    if window % 2 == 0:
        raise UsageError(f"--window is {window}; it must be odd, so that it has a centre")
    settings = StudySettings(
        window=window,
        alpha=alpha,
        sets=sets,
        seed=seed,
        distance_mm=1000 * distance,
        grid=grid,
        focus_mm=1000 * focus,
        f_number=f_number,
        confusion_mm=confusion,
        thermometer_sd=thermometer_sd,
        jobs=jobs,
    )
    from thermocald.photogrammetry.series.result import EXTERIOR_CHOICES

    if exterior not in EXTERIOR_CHOICES:
        raise UsageError(f"--exterior {exterior}: must be one of {', '.join(EXTERIOR_CHOICES)}")
    # Refused before the work, not after it.
    for path in (report, figures):
        if path is not None:
            make_folder(path.absolute().parent)
    comparisons: list[Comparison] = []
    if reference:
        result, comparisons = _reference(settings)
    else:
        result = _study(inputs or [], settings, exterior, free_names(free))
    _write(result, comparisons, json, report, figures, title)


def _study(
    inputs: list[str], settings: StudySettings, exterior: str, free: tuple[str, ...]
) -> Study:
    from thermocald.analysis.study.input import load_series
    from thermocald.analysis.study.study import study as run
    from thermocald.photogrammetry.series.spool import give_back
    from thermocald.store.recording.reader import open_recording

    series: list[MeasuredSeries] = []
    labelled = [_labelled(text) for text in inputs]
    _refuse_duplicates([path for _, path in labelled])
    for label, path in labelled:
        recording = open_recording(path) if path.is_dir() else None
        epochs = None if recording is None else len(recording)
        with progress(epochs, f"calibrating {path.name}") as advance:
            series += load_series(
                recording or path, label, settings.thermometer_sd, exterior, free, advance,
                settings.jobs,
            )  # fmt: skip
        del recording  # its columns are not needed any more
        give_back()
    _refuse_copies(series)
    cameras = len({one.label for one in series})
    with progress(settings.sets * cameras, "simulating") as advance:
        return run(series, settings, advance)


def _refuse_duplicates(paths: list[Path]) -> None:
    """UsageError where one series is given twice: it would count as two that agree."""
    seen: dict[Path, Path] = {}
    for path in paths:
        real = path.resolve()
        if real in seen:
            raise UsageError(
                f"{path} is the same series as {seen[real]}; give each series once (a copy would "
                "count as a second measurement that agrees perfectly)"
            )
        seen[real] = path


def _refuse_copies(series: list[MeasuredSeries]) -> None:
    """DataError where two inputs hold the same epochs."""
    for i, one in enumerate(series):
        for other in series[:i]:
            if len(one) > 1 and len(one) == len(other) and np.array_equal(one.values, other.values):
                raise DataError(
                    f"{one.source} holds the same epochs as {other.source}; give each series once"
                )


def _labelled(text: str) -> tuple[str | None, Path]:
    """`LABEL=PATH` or `PATH`; DataError where there is nothing at the path."""
    label, equals, rest = text.partition("=")
    # A path may hold "="; what exists as it stands is a path.
    if not equals or Path(text).exists() or is_server(text):
        label, rest = "", text
    return label or None, require_source(Path(rest))


def _reference(settings: StudySettings) -> tuple[Study, list[Comparison]]:
    from thermocald.analysis.study.reference import QUOTED, SERIES, compare, reference_studies
    from thermocald.analysis.study.study import Study

    with progress(len(QUOTED) * len(SERIES), "simulating, adjusting, studying") as advance:
        cameras = reference_studies(settings, advance=advance)
    return Study(settings, tuple(cameras)), [c for camera in cameras for c in compare(camera)]


def _write(
    result: Study,
    comparisons: list[Comparison],
    json: str | None,
    report: Path | None,
    figures: Path | None,
    title: str,
) -> None:
    from thermocald.output.study.document import study_document

    if json is not None:
        document = study_document(result)
        if comparisons:
            document["reference"] = [_comparison(c) for c in comparisons]
        write_json(document, json)
    written = []
    if report is not None:
        from thermocald.output.study.report import render_report, write_report

        write_report(report, render_report(result, title))
        written.append(str(report))
    if figures is not None:
        from thermocald.output.study.report import save_figures

        written.append(f"{len(save_figures(result, figures))} figures in {figures}")
    if json == "-":
        return
    if comparisons:
        _print_comparisons(comparisons)
    else:
        _print_summary(result)
    for line in written:
        typer.echo(f"written: {line}")


def _comparison(c: Comparison) -> dict[str, Any]:
    return {
        "camera": c.camera,
        "quantity": c.quantity,
        "unit": c.unit,
        "reference": c.text,
        "ours": c.ours,
        "reproduced": c.reproduced,
    }


def _print_comparisons(comparisons: list[Comparison]) -> None:
    """Reference alongside ours, one line per figure."""
    typer.echo(f"{'camera':17}{'quantity':43}{'reference':>12}{'ours':>9}  met")
    for c in comparisons:
        unit = f" {c.unit}" if c.unit else ""
        typer.echo(
            f"{c.camera:17}{c.quantity + unit:43}{c.text:>12}{c.ours:>9.3g}  "
            f"{'yes' if c.reproduced else 'NO'}"
        )


def _print_summary(result: Study) -> None:
    from thermocald.output.study.summary import summary

    for camera in result.cameras:
        typer.echo(camera.label)
        for sentence in summary(camera):
            typer.echo(f"  {sentence}")
        for study_of_series in camera.series:
            for note in study_of_series.notes:
                typer.echo(f"  note, {study_of_series.series.name}: {note}")
        for note in camera.notes:
            typer.echo(f"  note: {note}")
