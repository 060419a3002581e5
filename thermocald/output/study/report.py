"""The results of a study: in sentences, as a JSON document, and as the report's page.

The document follows CONVENTIONS §4: units of the model, `sd_<name>` beside a value.

`save_figures` writes the figures of the report for a publication.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.figures import draw_figure, save
from thermocald.files import make_folder
from thermocald.numbers import (
    coefficient,
    duration,
    enumerated,
    parameter_label,
    percent,
    plain,
    signed,
    with_sd,
)
from thermocald.output.study import tables
from thermocald.output.study.figures import (
    FEWEST_FOR_R,
    by_series,
    dependence_figure,
    file_name,
    principal_point_figure,
    study_figures,
)
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.report import Answer, Chapter, Section, Table, as_sentence, day, render_report
from thermocald.result import document_of, jsonable
from thermocald.store.recording.sense import doubt_lines

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from thermocald.analysis.study.measured import StudySettings
    from thermocald.analysis.study.reference import Comparison
    from thermocald.analysis.study.study import (
        CameraStudy,
        ChannelStudy,
        Deviation,
        SeriesStudy,
        Study,
    )

_LEAD = (
    "How the interior orientation of a camera changes with its temperature, whether the changes "
    "are significant, and what they do to measurements in object space; the analysis is that of "
    "Elias, Eltner, Liebold and Maas (2020), Sensors 20, 643, section 4."
)


def render_study(study: Study, title: str = "Thermal study of a camera") -> str:
    """Return the report as HTML text."""
    chapters = []
    for camera in study.cameras:
        series = [one.series for one in camera.series]
        names = ", ".join(dict.fromkeys(f"{s.camera}, {s.sensor}" for s in series))
        measured = "; ".join(f"{s.name} {day(s.start_utc)}" for s in series)
        chapters.append(
            Chapter(
                camera.label,
                _answer(camera, study.settings.distance_mm),
                tuple(_sections(camera, study.settings)),
                (f"{names}. Measured: {measured}.",),
                tuple(map(as_sentence, (*_doubts(camera), *_notes(camera)))),
            )
        )
    return render_report(title, chapters, _LEAD)


def save_figures(study: Study, folder: Path) -> list[Path]:
    """Write every figure as SVG and PNG to `folder`, which is created; return the files."""
    make_folder(folder)
    paths = []
    for camera in study.cameras:
        prefix = file_name(camera.label) + "-" if len(study.cameras) > 1 else ""
        for name, figure in study_figures(camera).items():
            paths += save(draw_figure(figure), folder, prefix + name)
    return paths


def _answer(camera: CameraStudy, distance_mm: float) -> Answer:
    sentences = answer_sentences(camera, distance_mm)
    sentences = sentences or ["The data do not show whether the camera changes."]
    proof = dependence_figure(camera, ("c", "x0", "y0"))
    if proof is None and any(len(study.series) > 1 for study in camera.series):
        proof = principal_point_figure(camera)
    channels = [channel for study in camera.series for channel in study.channels]
    if not any(study.series.free for study in camera.series):
        steps = ["Let the study estimate parameters: leave out --free none."]
    elif any(
        d.p_holm < _SIGNIFICANT
        for c in channels
        for name, d in c.dependences.items()
        if name != "sigma0"
    ):
        steps = [
            "Fit a thermal model, with which to correct measurements: thermocald fit.",
            "Find what a straight line does not explain, and why: thermocald discover.",
        ]
    elif any(
        len(study.series) < 2 or any(np.isfinite(t.values).any() for t in study.series.thermometers)
        for study in camera.series
    ):
        steps = ["Record more epochs, over a wider range of temperatures."]
    else:
        steps = ["Record a temperature with the frames; without one nothing can be corrected."]
    if len(camera.series) < 2:
        steps.append("Measure a second series on another day, to see which changes repeat.")
    uncovered = [
        "Temperatures other than those measured, and changes faster than the epochs.",
        "Errors of the camera model itself, and changes of focus or lens by hand.",
        "The behaviour of another specimen of this camera, which needs its own series.",
    ]
    courses = [
        study.deviations[c.thermometer.name]
        for study in camera.series
        for c in study.channels[:1]
        if c.dependences
    ]
    if courses and not any(d.returned for d in courses):
        uncovered.append(
            "Changes with time alone, such as a creeping mount: the temperature did not return, "
            "so that they look like a dependence on it."
        )
    return Answer(
        sentences[0],
        None if proof is None else replace(proof, name="proof"),
        tuple(sentences[1:]),
        tuple(steps),
        tuple(uncovered),
    )


def _sections(camera: CameraStudy, settings: StudySettings) -> list[Section]:
    drawn = study_figures(camera)

    def section(title: str, names: Sequence[str], found: Sequence[Table], **more: Any) -> Section:
        shown = tuple(drawn[name] for name in names if name in drawn)
        return Section(title, figures=shown, tables=tuple(t for t in found if t.rows), **more)

    matrices = [name for name in drawn if name.startswith("correlation-")]
    depends = tables.dependence_tables(camera)
    parts = [
        section(
            "How the camera changed", ("deviations", "principal-point", "movement"),
            [tables.deviation_table(camera)],
        ),
        section(
            "How it depends on the temperature", ("temperature-dependence",),
            depends[:1], text=tuple(detail_sentences(camera)),
        ),
        section(
            "What it means in object space", ("object-space-errors", "errors-by-point"),
            tables.object_space_tables(camera),
        ),
        section(
            "Whether the changes are significant", ("significance",),
            [tables.significance_table(camera, settings)], folded=True,
        ),
        section(
            "Correlations, and other thermometers", (*matrices, "iop-correlations"),
            depends[1:], folded=True,
        ),
        section(
            "What was measured and assumed", (), [tables.overview_table(camera)],
            text=_assumed(camera, settings), folded=True,
        ),
    ]  # fmt: skip
    return [part for part in parts if part.figures or part.tables]


def _assumed(camera: CameraStudy, settings: StudySettings) -> tuple[str, ...]:
    """State what would follow from values that were not measured, instead of giving a result."""
    changes = [
        f"{plain(study.focus.change, 'mm', 2)} in {study.series.name}"
        for study in camera.series
        if study.focus is not None
    ]
    if not changes:
        return ()
    lens = f"f/{settings.f_number:g} and focused at {settings.focus_mm / 1000:g} m"
    change = f"its depth of field would change by {enumerated(changes)}"
    return (f"If the lens were {lens}, {change}. Neither was measured.",)


def _notes(camera: CameraStudy) -> list[str]:
    found = ((study, note) for study in camera.series for note in study.notes)
    return by_series(camera, found, name_all=False) + list(camera.notes)


def _doubts(camera: CameraStudy) -> list[str]:
    """Return the doubts about all series, a line each, with the name if there are several."""
    several = len(camera.series) > 1
    measured = [study.series for study in camera.series]
    return [line for s in measured for line in doubt_lines(s.doubts, s.name if several else "")]


_CLOSE = 0.9
_TOGETHER = 0.9
_NOISE_AGREES = 1.15
_SIGNIFICANT = 0.05
_OF_SERIES = (
    "name", "camera", "source", "without_result", "image_noise_ratio", "field_movements",
    "exterior", "free", "doubts",
)  # fmt: skip
_OF_STUDY = ("noise_ratio", "deviations", "significance", "notes")
_FIXED = {
    "first": "the first epoch's interior orientation",
    "mean": "the mean",
    "last": "the last epoch's",
}


def study_lines(study: Study, comparisons: Sequence[Comparison] = ()) -> list[str]:
    """Return the lines that `thermocald study` prints, or those of the comparisons if given."""
    if comparisons:
        rows = [f"{'camera':17}{'quantity':43}{'reference':>12}{'ours':>9}  met"]
        for c in comparisons:
            quantity = f"{c.quantity} {c.unit}" if c.unit else c.quantity
            met = "yes" if c.reproduced else "NO"
            rows.append(f"{c.camera:17}{quantity:43}{c.text:>12}{c.ours:>9.3g}  {met}")
        return rows
    lines = []
    for camera in study.cameras:
        lines.append(camera.label)
        lines += [f"  {s}" for s in answer_sentences(camera, study.settings.distance_mm)]
        lines += [f"  {s}" for s in detail_sentences(camera)]
        lines += [f"  {line}" for line in _doubts(camera)]
        lines += [f"  note: {note}" for note in _notes(camera)]
    return lines


def answer_sentences(camera: CameraStudy, distance_mm: float) -> list[str]:
    """Return the results in sentences, the rates first, without those the data do not support."""
    mc = camera.montecarlo
    sentences = by_series(camera, ((s, rates(s, distance_mm)) for s in camera.series))
    sentences += by_series(camera, ((s, _change(s)) for s in camera.series))
    if mc is not None:
        sentences.append(
            f"On a plane at {mc.distance_mm / 1000:g} m, interior orientations drawn normally "
            "about the series' mean with the correlations of an epoch's adjustment (the procedure "
            f"of Elias et al. 2020) cause errors of {plain(mc.overall_mean / 10, 'cm', 3)} on "
            f"average and up to {plain(mc.mean_largest / 10, 'cm', 2)} (mean of the largest of "
            f"{mc.sets:,} draws); "
            f"{percent(float(mc.fractions[0]))} stay below {mc.clusters_mm[0] / 10:g} cm."
        )
        sentences += _trajectory(camera, mc.clusters_mm[0])
    return sentences


def detail_sentences(camera: CameraStudy) -> list[str]:
    """Return sentences on the dependence on temperature, and on noise other than the stated."""
    said = ((study, text(study)) for text in (_dependence, _noise) for study in camera.series)
    return by_series(camera, said)


def rates(study: SeriesStudy, distance_mm: float) -> str:
    """State the significant rates of c, x0 and y0 with the reference temperature; "" if none is.

    The rates are in px/K and µm/K with their standard deviations, and in mm/K on a plane at a
    distance: for x0 and y0 everywhere, for c at the image's left and right edge.
    """
    channel = next((c for c in study.channels if c.dependences), None)
    if channel is None:
        return ""
    found = [
        (name, rate_in_px_and_mm(study, name, d.slope, distance_mm), d)
        for name, d in channel.dependences.items()
        if name in ("c", "x0", "y0") and d.p_holm < _SIGNIFICANT
    ]
    if not found:
        return ""
    found.sort(key=lambda one: -abs(one[1][0]))
    parts = []
    for name, (px, _), d in found:
        sd_px = abs(px * d.sd_slope / d.slope)
        parts.append(f"{parameter_label(name)} by {signed(px, sd_px, 'px/K')}")
    name, (_, mm), d = found[0]
    edge = " at the image's edge" if name == "c" else ""
    parts[0] = parts[0].replace(" by ", " moves by ", 1) + (
        f" ({signed(1000 * d.slope, 1000 * d.sd_slope, 'µm/K')}; at {distance_mm / 1000:g} m "
        f"{plain(abs(mm), 'mm/K', 3)}{edge})"
    )
    T = channel.thermometer.values
    low, high = float(np.nanmin(T)), float(np.nanmax(T))
    rough = " (short series: standard deviations are rough)"
    where = parameter_label(channel.thermometer.name)
    return (
        f"between {low:.0f} and {high:.0f} °C "
        f"{'' if where == 'temperature' else f'({where}) '}{enumerated(parts)}"
        f"{rough if any(d.too_short for *_, d in found) else ''}."
    )


def rate_in_px_and_mm(
    study: SeriesStudy, name: str, rate: float, distance_mm: float
) -> tuple[float, float]:
    """Convert a rate of c, x0 or y0 from mm/K to px/K, and to mm/K on a plane at a distance."""
    s = study.series
    c = float(np.mean(s.values[:, 0]))
    lever = 0.5 * s.sensor.width * s.sensor.pixel_pitch / c if name == "c" else 1.0
    return rate / s.sensor.pixel_pitch, rate * lever / c * distance_mm


def _trajectory(camera: CameraStudy, limit_mm: float) -> list[str]:
    """Compare the camera's own path with the draws, and state the correlations these ignore."""
    if not camera.trajectories:
        return []
    parts = [
        f"{percent(float(one.fractions[0]))} with {_FIXED[one.reference]}"
        for one in camera.trajectories
    ]
    parts[0] = parts[0].replace(" with", " of the points with") + " held fixed"
    if all(one.fractions[0] == 1 for one in camera.trajectories):
        parts = ["all points, whichever of its interior orientations is held fixed"]
    text = (
        f"The camera, along its own path, stays within {limit_mm / 10:g} cm at {enumerated(parts)}."
    )
    known = sum(len(study.series) for study in camera.series) >= FEWEST_FOR_R
    strong = [
        f"{parameter_label(IOP_NAMES[i])} and {parameter_label(IOP_NAMES[j])} {coefficient(r)}"
        for i, j in ((1, 2), (0, 1), (0, 2))
        if known and abs(r := float(camera.over_time[i, j])) >= _TOGETHER
    ]
    if strong and camera.correlations is not None:
        drawn = coefficient(float(camera.correlations.median[1, 2]))
        text += (
            f" Over time its parameters change together (r of {', '.join(strong)}), which the "
            f"draws ignore (r of x₀ and y₀ in the draws: {drawn})."
        )
    return [text]


def _change(study: SeriesStudy) -> str:
    s, d = study.series, study.deviations
    if not d or len(s) < 2:
        return ""
    words = []
    if "x0" in d and "y0" in d:
        way = np.hypot(*s.path_px.T)
        moved, farthest = float(way[-1]), float(way.max())
        sds = np.array([d["x0"].sd_change, d["y0"].sd_change]) / s.sensor.pixel_pitch
        sd = float(np.hypot(*sds))
        if farthest > max(1.5 * moved, 6 * sd):
            words.append(
                f"the principal point moved by up to {plain(farthest, 'px', 3)} and ended "
                f"{plain(moved, 'px', 3)} from where it started"
            )
        elif moved > 3 * sd:
            along = float(np.hypot(*(s.path_px[-1] * sds))) / moved
            words.append(f"the principal point moved by {with_sd(moved, along, 'px')}")
        else:
            words.append(
                f"the principal point stayed within {plain(max(farthest, 3 * sd), 'px', 2)}"
            )
    if "c" in d:
        words.append(_distance(d["c"]))
    if not words:
        return ""
    time = duration(float(s.time_s[-1] - s.time_s[0]))
    return f"in {time} {', and '.join(words)}{_warmed(study)}."


def _distance(c: Deviation) -> str:
    """Describe the change of the principal distance."""
    if c.returned:
        grew = "grew" if c.largest > 0 else "shrank"
        ended = f"{plain(1000 * abs(c.change), 'µm', 2)} {'longer' if c.change > 0 else 'shorter'}"
        if abs(c.change) < 3 * c.sd_change:
            ended = f"within {plain(3000 * c.sd_change, 'µm', 2)} of where it started"
        return (
            f"the principal distance {grew} by up to {plain(1000 * abs(c.largest), 'µm', 2)} and "
            f"ended {ended}"
        )
    if abs(c.change) > 3 * c.sd_change:
        grew = "grew" if c.change > 0 else "shrank"
        return (
            f"the principal distance {grew} by "
            f"{with_sd(1000 * abs(c.change), 1000 * c.sd_change, 'µm')}"
        )
    return "the principal distance did not change beyond its uncertainty"


def _warmed(study: SeriesStudy) -> str:
    """Describe the change of the reference temperature during the series."""
    reference = study.series.reference
    if reference is None or reference.name not in study.deviations:
        return ""
    d = study.deviations[reference.name]
    label, known = parameter_label(reference.name), int(np.isfinite(reference.values).sum())
    name = "the temperature" if label == "temperature" else f"the temperature ({label})"
    if known < len(study.series):
        name += f", known in {known} of {len(study.series)} epochs,"
    if d.returned:
        rose, largest = "rose" if d.largest > 0 else "fell", plain(abs(d.largest), "K", 3)
        within = plain(d.range, "K", 3)
        over = "" if within == largest else f" (range {within})"
        back = abs(d.change) < 3 * d.sd_change
        end = "" if back else f"{plain(abs(d.change), 'K', 3)} from "
        return f", while {name} {rose} by up to {largest}{over} and ended {end}where it started"
    if not d.range:
        return f", while {name} stayed at {d.first:.2f} °C"
    if abs(d.change) < 3 * d.sd_change:
        return f", while {name} stayed within {plain(d.range, 'K', 2)}"
    return f", while {name} changed by {plain(d.change, 'K', 3)}"


def _noise(study: SeriesStudy) -> str:
    """State the noise if it differs from the stated standard deviations, else ""."""
    ratio = study.noise_ratio
    if not np.isfinite(ratio) or 1 / _NOISE_AGREES <= ratio <= _NOISE_AGREES:
        return ""
    # the parameters may be correlated: then they show it together as well as one
    one = next(t.drift for t in study.significance.values() if t.drift)
    sd = ratio * one.sd_noise_ratio / one.noise_ratio
    if abs(ratio - 1.0) < 2.0 * sd:
        return ""
    return (
        f"neighbouring epochs scatter {with_sd(ratio, sd)} times as much as the standard "
        f"deviations state (σ₀ {study.series.rms_sigma0:.2f})."
    )


def _dependence(study: SeriesStudy) -> str:
    """State which parameters depend on the reference temperature; "" if none was examined."""
    channel = next((c for c in study.channels if c.dependences), None)
    if channel is None or not study.series.free:
        return ""
    found = channel.dependences.items()
    close = [parameter_label(n) for n, d in found if abs(d.r) >= _CLOSE]
    significant = [parameter_label(n) for n, d in found if d.p_holm < _SIGNIFICANT]
    name = parameter_label(channel.thermometer.name)
    if not significant:
        return f"no parameter depends significantly on {name}."
    depends = "depends" if len(significant) == 1 else "depend"
    text = f"{enumerated(significant)} {depends} significantly on {name}"
    which = "" if close == significant else f" {enumerated(close)}"
    return text + (f",{which or ' and'} closely (|r| ≥ {_CLOSE})." if close else ".")


def study_document(study: Study) -> dict[str, Any]:
    """Return all results; those that could not be computed are null, and `notes` states why."""
    s = study.settings
    document: dict[str, Any] = jsonable(
        {
            "format": "thermocald-study/1",
            "settings": {k: v for k, v in jsonable(s).items() if k != "jobs"},
            "cameras": [_camera(camera, s.distance_mm) for camera in study.cameras],
            "doubts": [
                f"{one.series.name}: {text}"
                for camera in study.cameras
                for one in camera.series
                for text in one.series.doubts
            ],
        }
    )
    return document


def _camera(camera: CameraStudy, distance_mm: float) -> dict[str, Any]:
    correlations = jsonable(camera.correlations)
    return {
        "label": camera.label,
        "series": [_series(one, distance_mm) for one in camera.series],
        "interior_orientation": dict(zip(IOP_NAMES, camera.iop.tolist(), strict=True)),
        "sd_over_time": dict(zip(IOP_NAMES, camera.sds.tolist(), strict=True)),
        "iop_correlations": correlations and {"parameters": IOP_NAMES, **correlations},
        "correlations_over_time": {"parameters": IOP_NAMES, "r": camera.over_time},
        "object_space": _object_space(camera),
        "trajectory": camera.trajectories,
        "notes": list(camera.notes),
    }


def _series(study: SeriesStudy, distance_mm: float) -> dict[str, Any]:
    s = study.series
    covariance = study.displacement_covariance
    sd = None if covariance is None else np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    moved = {"points": study.grid, "displacement": study.displacement, "sd_displacement": sd}
    return {name: getattr(s, name) for name in _OF_SERIES} | {
        **{name: getattr(study, name) for name in _OF_STUDY},
        "epochs": len(s),
        "sigma0": s.rms_sigma0,
        "exterior_choice": s.choice or None,
        "depth_of_field": study.focus,
        "image_displacement_px": None if study.displacement is None else moved,
        "temperature_dependence": {
            channel.thermometer.name: _channel(study, channel, distance_mm)
            for channel in study.channels
        },
        "correlation_matrix": {"columns": study.columns, "r": study.matrix},
    }


def _channel(study: SeriesStudy, channel: ChannelStudy, distance_mm: float) -> dict[str, Any]:
    parameters = {}
    for name, d in channel.dependences.items():
        parameters[name] = document_of(d)
        if name in ("c", "x0", "y0"):
            px, mm = rate_in_px_and_mm(study, name, d.slope, distance_mm)
            sd_px, sd_mm = rate_in_px_and_mm(study, name, d.sd_slope, distance_mm)
            parameters[name] |= {
                "slope_px": px, "sd_slope_px": sd_px,
                "slope_on_plane_mm": mm, "sd_slope_on_plane_mm": sd_mm,
            }  # fmt: skip
    return {
        "sd_thermometer": channel.thermometer.sd,
        "reason": channel.reason or None,
        "parameters": parameters,
    }


def _object_space(camera: CameraStudy) -> dict[str, Any] | None:
    mc = camera.montecarlo
    if mc is None:
        return None
    first = mc.first_order
    points = [
        {
            "image_point_px": mc.image_points[k], "expected_mm": mc.expected[k],
            "counts": mc.counts[k], "mean_mm": mc.mean[k], "largest_mm": mc.largest[k],
            "bias_mm": mc.mean_error[k], "covariance_mm2": mc.covariance[k],
            "first_order": {
                "mean_mm": first.mean[k], "expected_largest_mm": first.expected_largest[k],
                "covariance_mm2": first.covariance[k],
            },
        }
        for k in range(len(mc.image_points))
    ]  # fmt: skip
    return {
        "sets": mc.sets,
        "seed": mc.seed,
        "distance_mm": mc.distance_mm,
        "clusters_mm": mc.clusters_mm,
        "fractions": mc.fractions,
        "mean_mm": mc.overall_mean,
        "mean_of_maxima_mm": mc.mean_largest,
        "folded_sets": mc.folded,
        "points": points,
        "first_order": {
            "fractions": first.fractions,
            "mean_mm": first.mean.mean(),
            "mean_of_maxima_mm": first.expected_largest.mean(),
        },
    }
