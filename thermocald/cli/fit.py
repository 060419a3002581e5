"""`thermocald fit`: one thermal model from all series of a camera."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermocald.cli.options import JobsOption, JsonOption
from thermocald.errors import UsageError
from thermocald.store.sources import require_source

if TYPE_CHECKING:
    from collections.abc import Callable

    from thermocald.analysis.thermal.prediction_test import PredictedError
    from thermocald.analysis.thermal.result import FittedModel
    from thermocald.reduction.series import ReducedSeries
    from thermocald.simulation.model import ModelEffect, ThermalModel

__all__ = ["fit"]

_UNSEEN = 0.5
"""From which weight of the type on a parameter is called the type's."""


def fit(
    inputs: Annotated[
        list[Path], typer.Argument(metavar="RECORDING_OR_STORE…", help="Folders and stores.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="The model file to write.")],
    effect: Annotated[
        list[str] | None,
        typer.Option(help="NAME[:PARAMETER=VALUE,…] to fit alongside the base model; repeatable."),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="Fit the effects of this model, such as discovery wrote it.")
    ] = None,
    reference_temperature: Annotated[
        float | None, typer.Option("--t0", help="Reference temperature °C; default: the mean.")
    ] = None,
    type_name: Annotated[
        str | None,
        typer.Option(
            "--type",
            metavar="NAME|MODEL",
            help="Several cameras: fit each, write the type NAME. One: its type's MODEL file helps "
            "where it was measured at few temperatures.",
        ),
    ] = None,
    code: Annotated[
        Path | None, typer.Option(help="Write the model as FILE.h (C, C++) and FILE.py too.")
    ] = None,
    jobs: JobsOption = 1,
    json: JsonOption = None,
) -> None:
    """Fit a thermal model to all series of a camera, in one adjustment over all image points.

    Example: thermocald fit M1 M2 -o camera.thermal.yaml --effect thermal_lag
    """
    from thermocald.analysis.thermal.type_model import fit_with_type, weight_of_type
    from thermocald.cli.common import progress, write_result
    from thermocald.cli.effect_options import check_names
    from thermocald.simulation.model_file import write_model

    known = _known_type(type_name)
    if known is not None and (effect or model or reference_temperature is not None):
        raise UsageError(f"--type {type_name}: effects and T0 are the type's; give no others")
    listed, T0 = _structure(effect or [], model, reference_temperature)
    with progress(None, "reading and measuring") as advance:
        series = _read(inputs, advance, jobs)
    check_names(listed, series)
    if known is not None:
        fitted = fit_with_type(series, known)
        fitted_model, document = fitted.model, _document(fitted, [])
        document["type"] = {
            "name": known.camera,
            "cameras": len(known.fitted_on),
            "weights": weight_of_type(fitted_model, known),
        }
    elif type_name is not None:
        fitted_model, document = _type(series, listed, T0, type_name)
    else:
        fitted, held = _one(series, listed, T0)
        fitted_model, document = fitted.model, _document(fitted, held)
    write_model(output, fitted_model)
    document["model"] = str(output)
    if code is not None:
        from thermocald.analysis.thermal.thermal_camera import ThermalCamera
        from thermocald.output.model_code import write_code

        document["code"] = [str(file) for file in write_code(ThermalCamera(fitted_model), code)]
    if write_result(document, json):
        _say(document)


def _known_type(text: str | None) -> ThermalModel | None:
    """The type's model where a file is named; None for a name that is to be given."""
    from thermocald.analysis.thermal.type_model import require_type
    from thermocald.simulation.model_file import read_model

    if text is None:
        return None
    path = Path(text)
    if not path.is_file():
        if path.suffix in (".yaml", ".yml") or "/" in text:
            raise UsageError(f"--type {text}: there is no such file")
        return None
    found = read_model(path)
    require_type(found)
    return found


def _read(inputs: list[Path], advance: Callable[[int], None], jobs: int) -> list[ReducedSeries]:
    from thermocald.reduction.reduce import reduce_series
    from thermocald.reduction.source import load_series

    return [
        reduce_series(s, affinity=False, strict=False)
        for path in map(require_source, inputs)
        for s in load_series(path, advance, jobs)
    ]


def _structure(
    names: list[str], path: Path | None, T0: float | None
) -> tuple[list[ModelEffect], float | None]:
    from thermocald.cli.effect_options import parse_effect
    from thermocald.simulation.model_file import read_model

    listed = []
    if path is not None:
        start = read_model(path)
        listed = list(start.effects)
        T0 = start.T0 if T0 is None else T0
    for text in names:
        effect = parse_effect(text)
        if any(e.name == effect.name for e in listed):
            raise UsageError(f"--effect {text}: {effect.name} is given twice")
        listed.append(effect)
    return listed, T0


def _one(
    series: list[ReducedSeries], listed: list[ModelEffect], T0: float | None
) -> tuple[FittedModel, list[PredictedError]]:
    """The fit to everything, and the error on what a fit to the rest predicts."""
    from thermocald.analysis.thermal.prediction_test import predicted_error
    from thermocald.analysis.thermal.thermal_model import fit_thermal_model

    fitted = fit_thermal_model(series, listed, T0)
    held = []
    if len(series) > 1:
        for k, left_out in enumerate(series):
            rest = [s for i, s in enumerate(series) if i != k]
            part = fit_thermal_model(
                rest, list(fitted.model.effects), fitted.model.T0, search=False
            )
            sd = fitted.series[k].thermometer_sd
            held.append(predicted_error(part.model, left_out, sd))
    return fitted, held


def _document(fitted: FittedModel, held: list[PredictedError]) -> dict[str, Any]:
    from dataclasses import asdict

    from thermocald.simulation.model_file import model_document

    written = model_document(fitted.model)
    return {
        "format": "thermocald-fit/1",
        "camera": fitted.model.camera,
        "reference_temperature": fitted.model.T0,
        "interior": written["interior"],
        "rates": written["rates"],
        "effects": written["effects"],
        "validity": written["validity"],
        "sigma0": fitted.sigma0,
        **fitted.missing.as_mapping(),
        "series": [asdict(s) for s in fitted.series],
        "prediction_test": [asdict(h) for h in held],
        "held_out": [asdict(h) for h in held],  # its name until the next version
    }


def _type(
    series: list[ReducedSeries], listed: list[ModelEffect], T0: float | None, name: str
) -> tuple[Any, dict[str, Any]]:
    import numpy as np

    from thermocald.analysis.thermal.thermal_model import fit_thermal_model
    from thermocald.analysis.thermal.type_model import type_model
    from thermocald.simulation.model_file import model_document

    cameras = list(dict.fromkeys(s.source.camera for s in series))
    if T0 is None:
        T0 = round(float(np.mean([s.history.temperature().mean() for s in series])), 1)
    models = [
        fit_thermal_model([s for s in series if s.source.camera == c], listed, T0).model
        for c in cameras
    ]
    found = type_model(models, name)
    written = model_document(found)
    return found, {
        "format": "thermocald-fit/1",
        "camera": name,
        "cameras": cameras,
        "reference_temperature": T0,
        **{k: written[k] for k in ("interior", "rates", "effects", "validity")},
        "series": [],
        "prediction_test": [],
        "held_out": [],
    }


def _say(document: dict[str, Any]) -> None:
    typer.echo(f"{document['model']}: {document['camera']}")
    low, high = next(iter(document["validity"].values()))
    T0 = f"T0 = {document['reference_temperature']:g} °C"
    if document.get("effect_missing"):
        typer.echo(
            f"  an effect is missing: the model leaves {document['misfit_px']:.3f} px in smooth "
            f"trajectories ({document['significance_sigmas']:.0f} standard deviations); "
            "run: thermocald discover\n"
            f"  fitted from {low:g} to {high:g} °C, {T0}; standard deviations are widened by what "
            "is left, and no 95 % band is stated"
        )
    else:
        typer.echo(f"  valid from {low:g} to {high:g} °C, {T0}")
    if "type" in document:
        kind = document["type"]
        typer.echo(f"  with what {kind['cameras']} cameras of the type {kind['name']} say of it")
        if unseen := [name for name, weight in kind["weights"].items() if weight > _UNSEEN]:
            typer.echo(
                f"  these recordings show little of {', '.join(unseen)}: value and standard "
                "deviation are the type's; record the way between two temperatures, too"
            )
    from thermocald.output.figures.numbers import with_sd

    for name, rate in document["rates"].items():
        shown = with_sd(1e3 * rate["value"], 1e3 * rate.get("sd", math.nan), "µm/K")
        typer.echo(f"  {name:>4}: {shown}")
    for effect in document["effects"]:
        parts = [
            f"{k} = {with_sd(v['value'], v.get('sd', math.nan), v['unit'])}"
            for k, v in effect["parameters"].items()
            if isinstance(v, dict)
        ]
        typer.echo(f"  {effect['effect']}: {', '.join(parts)}")
    for s in document["series"]:
        typer.echo(
            f"  {s['name']}: {s['epochs']} epochs{_on_means(s['means'])}, {s['rms_px']:.4f} px, "
            f"thermometer ± {s['thermometer_sd']:.3f} K"
        )
    for h in document["prediction_test"]:
        typer.echo(
            f"  {h['name']} left out: predicted to {h['rms_px']:.4f} px (noise alone "
            f"{h['floor_px']:.4f}), {h['object_mm']:.2f} mm at 10 m"
        )


def _on_means(count: int | None) -> str:
    return "" if count is None else f" on {count} means"
