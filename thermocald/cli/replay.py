"""`thermocald replay` and `thermocald export`: a recording calibrated, a series as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from thermocald.cli.common import progress, say, write_parts, write_result
from thermocald.cli.options import (
    DEFAULT_FREE_TEXT,
    ExteriorOption,
    FreeOption,
    JobsOption,
    JsonOption,
    adjustment_settings,
)
from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.series.words import Words
from thermocald.store.sources import require_source

if TYPE_CHECKING:
    from thermocald.analysis.series.drift import Course
    from thermocald.analysis.series.table import SeriesTable
    from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
    from thermocald.store.recording.reader import Recording

__all__ = ["export", "replay"]


_EXTERIOR_WORDS = {
    "per_epoch": "per epoch",
    "series": "of the series",
    "mount": "of the series with movements of the mount",
}


def replay(
    recording: Annotated[Path, typer.Argument(help="The recording's folder.")],
    store: Annotated[
        Path | None, typer.Option(help="Keep all in this store; an interrupted replay goes on.")
    ] = None,
    exterior: ExteriorOption = "auto",
    free: FreeOption = DEFAULT_FREE_TEXT,
    jobs: JobsOption = 1,
    json: JsonOption = None,
) -> None:
    """Calibrate every epoch of a recording, and say what the series is worth.

    Example: thermocald replay rpi-heating-M1 --store thermocald.db
    """
    from thermocald.analysis.series.drift import settled
    from thermocald.store.recording.reader import open_recording

    _check_exterior(exterior)
    settings = adjustment_settings(free)
    opened = open_recording(require_source(recording))
    if store is not None:
        from thermocald.analysis.series.stored import replay_into

        with progress(len(opened.columns), "calibrating") as advance:
            table, found = replay_into(store, opened, settings, exterior, advance, jobs)
    else:
        table, found = settled(_recording_table(opened, settings, exterior, jobs))
    document = _summary(recording, store, table, found)
    if write_result(document, json):
        _tell(document)
    if not table.ok.any():
        raise DataError(f"{recording}: no epoch has a result: {_commonest(table)}")


def export(
    source: Annotated[Path, typer.Argument(help="A recording (folder) or a store (file).")],
    format_: Annotated[str, typer.Option("--format", help="csv, json, or parquet.")] = "csv",
    output: Annotated[
        str, typer.Option("--output", "-o", help="File; - is standard output.")
    ] = "-",
    exterior: Annotated[
        str,
        typer.Option(
            help="stored: a store's epochs as they were stored; the others adjust the series "
            "again: auto (of a recording), per_epoch, series, mount.",
        ),
    ] = "",
    free: FreeOption = DEFAULT_FREE_TEXT,
    series: Annotated[
        str | None, typer.Option(help="Which of a store: CAMERA/SERIES or SERIES.")
    ] = None,
    units: Annotated[
        str, typer.Option(help="px, um, deg instead of mm and rad; named in the columns.")
    ] = "",
    time_: Annotated[
        str, typer.Option("--time", help="seconds since 1970 UTC, or iso.")
    ] = "seconds",
    separator: Annotated[str, typer.Option(help="Of the columns: , ; | tab")] = ",",
    decimal: Annotated[str, typer.Option(help="The decimal mark: . or ,")] = ".",
    extra: Annotated[
        bool,
        typer.Option(
            "--extra",
            help="All thermometers and all else that is stored of an epoch: camera_… settings as "
            "the camera reported them, light, blur, the online filter.",
        ),
    ] = False,
    jobs: JobsOption = 1,
) -> None:
    """One row per epoch: parameters, standard deviations, sigma0, status.

    With one of --units, --time, --separator, --decimal, --extra, and as Parquet, the temperatures
    of all thermometers follow.

    Example: thermocald export rpi-heating-M1 --format csv > M1.csv
    Example: thermocald export M1 --units px,deg --time iso --separator ';' --decimal ',' -o M1.csv
    """
    from thermocald.analysis.series.drift import settled
    from thermocald.analysis.series.table import csv_text
    from thermocald.output import series_export
    from thermocald.store.recording.reader import open_recording

    folder = source.is_dir()
    exterior = exterior or ("auto" if folder else "stored")
    if folder or exterior != "stored":
        _check_exterior(exterior)
    if format_ not in ("csv", "json", "parquet"):
        raise UsageError(f"--format {format_}: csv, json and parquet are written")
    style = series_export.style_of(units, time_, separator, decimal)
    if format_ == "parquet" and output == "-":
        raise UsageError("--format parquet needs a file: -o FILE")
    if format_ == "json" and not style.is_plain:
        raise UsageError("--units, --time, --separator and --decimal are for csv and parquet")
    settings = adjustment_settings(free)
    if require_source(source).is_dir():
        table, _ = settled(_recording_table(open_recording(source), settings, exterior, jobs))
    else:
        from thermocald.analysis.series.stored import stored_table

        table, _ = stored_table(source, series, settings, exterior, jobs)
    if format_ == "csv" and style.is_plain and not extra:
        write_parts(csv_text(table), output)
    elif format_ == "json" and not extra:
        write_parts(series_export.as_json(series_export.plain_rows(table)), output)
    else:
        known = series_export.besides(source, series, table.number, extra=extra)
        parts = series_export.column_parts(table, style, known)
        if format_ == "parquet":
            series_export.write_parquet(parts, Path(output))
        elif format_ == "json":
            write_parts(series_export.as_json(series_export.as_rows(parts)), output)
        else:
            write_parts(series_export.as_csv(parts, style), output)
    for sentence, count in sorted(Words.of(table.reasons).counts().items()):
        if sentence:
            say(f"{count} epochs without a result: {sentence}")


def _check_exterior(exterior: str) -> None:
    from thermocald.photogrammetry.series.result import EXTERIOR_CHOICES

    if exterior not in EXTERIOR_CHOICES:
        raise UsageError(f"--exterior {exterior}: must be one of {', '.join(EXTERIOR_CHOICES)}")


def _recording_table(
    recording: Recording, settings: AdjustmentSettings, exterior: str, jobs: int
) -> SeriesTable:
    """Calibrate a recording without a store."""
    from thermocald.analysis.series.recorded import recorded_table

    with progress(len(recording), "calibrating") as advance:
        return recorded_table(recording, settings, exterior, advance, jobs)[0]


def _summary(
    recording: Path, store: Path | None, table: SeriesTable, found: list[Course]
) -> dict[str, Any]:
    ok = table.ok
    document: dict[str, Any] = {
        "format": "thermocald-replay/1",
        "recording": recording,
        "store": store,
        "exterior": table.exterior,
        "exterior_choice": None if table.adjustment is None else table.adjustment.choice,
        "epochs": len(table.number),
        "ok": int(ok.sum()),
        "sigma0": float(np.median(table.sigma0[ok])) if ok.any() else None,
        "noise_ratio": None if table.adjustment is None else table.adjustment.noise_ratio,
        "rejected": int(table.n_rejected.sum()),
        "left_out": list(table.left_out),
        "field_movements": [{**m.as_json(), "sentence": m.sentence} for m in table.field_movements],
        "parameters": [
            {
                "name": c.name,
                "mean": c.mean,
                "sd_mean_level": float(table.level_sd[("c", "x0", "y0").index(c.name)]),
                "scatter": c.scatter,
                "stated_sd": c.sd,
                "scatter_over_sd": c.scatter / c.sd,
                "change": c.change,
                "sd_change": c.sd_change,
                "last_minus_first": c.last_minus_first,
                "sd_last_minus_first": c.sd_last_minus_first,
                "p": c.p,
                "drift": c.moves,
                "per_kelvin": c.per_kelvin,
                "p_temperature": c.p_temperature,
                "rests_on": c.rests_on or None,
            }
            for c in found
        ],
        "without_result": [
            {"epoch": int(table.number[i]), "status": table.status[i], "reason": table.reasons[i]}
            for i in np.flatnonzero(~ok).tolist()
        ],
    }
    if table.adjustment is not None and table.exterior == "series":
        document["stood_still"] = _stood_still(table.stillness)
    return document


def _stood_still(stillness: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Whether single epochs had another exterior orientation (chi-square, 6 degrees of freedom)."""
    from scipy.stats import chi2

    values = stillness[np.isfinite(stillness)]
    limit = float(chi2.ppf(1 - 0.01 / max(len(values), 1), 6))
    moved = int((values > limit).sum())
    return {
        "epochs_that_moved": moved,
        "largest_chi2": float(values.max(initial=0.0)),
        "bound": limit,
    }


def _commonest(table: SeriesTable) -> str:
    counts = Words.of(table.reasons).counts()
    counts.pop("", None)
    return max(counts, key=lambda reason: counts[reason], default="there is no epoch")


def _drift(parameter: dict[str, Any]) -> str:
    if parameter["drift"]:
        if parameter["p_temperature"] < 0.01:
            return f"{parameter['per_kelvin'] * 1000:+.3f} µm/K"
        return f"in time (p {parameter['p']:.1g})"
    rests_on = parameter["rests_on"]
    return f"none (only target {rests_on} moves)" if rests_on else "none"


def _tell(document: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    typer.echo(
        f"{document['ok']} of {document['epochs']} epochs calibrated, exterior orientation "
        f"{_EXTERIOR_WORDS[document['exterior']]}, {document['rejected']} rejected observations"
    )
    if document["sigma0"] is not None:
        typer.echo(
            f"sigma0 {document['sigma0']:.2f}: the noise found is that many times the stated one"
        )
    if document["exterior_choice"]:
        typer.echo(f"--exterior {document['exterior']}: {document['exterior_choice']}")
    for moved in document["field_movements"]:
        typer.echo(f"{moved['sentence']}; this is taken off")
    for name in document["left_out"]:
        typer.echo(f"left out: target {name} and what belongs to it moves by itself")
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    titles = ("", "mean mm", "scatter", "sd", "ratio", "line µm", "last - first", "drift")
    for title in titles:
        table.add_column(title, justify="right" if title else "left", no_wrap=True)
    for p in document["parameters"]:
        table.add_row(
            p["name"],
            f"{p['mean']:.5f}",
            f"{1e3 * p['scatter']:.3f}",
            f"{1e3 * p['stated_sd']:.3f}",
            f"{p['scatter_over_sd']:.2f}",
            f"{1e3 * p['change']:+.3f} ± {1e3 * p['sd_change']:.3f}",
            f"{1e3 * p['last_minus_first']:+.3f} ± {1e3 * p['sd_last_minus_first']:.3f}",
            _drift(p),
        )
    if document["parameters"]:
        console.print(table, highlight=False)
    reasons = [f"{w['status']}: {w['reason']}" for w in document["without_result"]]
    for text in sorted(set(reasons)):
        typer.echo(f"{reasons.count(text)} × {text}")
    still = document.get("stood_still")
    if still and still["epochs_that_moved"]:
        typer.echo(
            f"the camera did not stand still in {still['epochs_that_moved']} epochs (chi-square "
            f"{still['largest_chi2']:.0f}, bound {still['bound']:.0f}): use --exterior per_epoch"
        )
