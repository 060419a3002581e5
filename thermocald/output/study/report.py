"""The report of a study: the change of a camera with its temperature, and its effects.

`save_figures` writes the figures of the report for a publication.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.figures import draw_figure, save
from thermocald.files import make_folder
from thermocald.numbers import enumerated, plain
from thermocald.output.study import tables
from thermocald.output.study.figures import (
    dependence_figure,
    file_name,
    principal_point_figure,
    study_figures,
)
from thermocald.output.study.summary import answer_sentences, detail_sentences
from thermocald.report import Answer, Chapter, Section, Table, as_sentence, day, render_report
from thermocald.store.recording.sense import doubt_lines

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from thermocald.analysis.study.series_study import StudySettings
    from thermocald.analysis.study.study import CameraStudy, Study

_LEAD = (
    "How the interior orientation of a camera changes with its temperature, whether the changes "
    "are significant, and what they do to measurements in object space; the analysis is that of "
    "Elias, Eltner, Liebold and Maas (2020), Sensors 20, 643, section 4."
)


def render_study(study: Study, title: str = "Thermal study of a camera") -> str:
    """Return the report as HTML text."""
    chapters = [
        Chapter(
            camera.label,
            _answer(camera),
            tuple(_sections(camera, study.settings)),
            (_device(camera),),
            tuple(_notes(camera)),
        )
        for camera in study.cameras
    ]
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


def _answer(camera: CameraStudy) -> Answer:
    sentences = answer_sentences(camera) or ["The data do not show whether the camera changes."]
    proof = dependence_figure(camera, ("c", "x0", "y0"))
    if proof is None and any(len(study.series) > 1 for study in camera.series):
        proof = principal_point_figure(camera)
    if any(c.dependences for study in camera.series for c in study.channels):
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


def _device(camera: CameraStudy) -> str:
    """Describe the camera, its sensor, and when each series was measured."""
    series = [study.series for study in camera.series]
    names = ", ".join(dict.fromkeys(s.camera for s in series))
    measured = "; ".join(f"{s.name} {day(s.start_utc)}" for s in series)
    return f"{names}, {series[0].sensor}. Measured: {measured}."


def _sections(camera: CameraStudy, settings: StudySettings) -> list[Section]:
    drawn = study_figures(camera)

    def section(
        title: str, names: Sequence[str], found: Sequence[Table],
        text: Sequence[str] = (), folded: bool = False,
    ) -> Section:  # fmt: skip
        shown = tuple(drawn[name] for name in names if name in drawn)
        rows = tuple(t for t in found if t.rows)
        return Section(title, tuple(text), shown, rows, folded=folded)

    matrices = [name for name in drawn if name.startswith("correlation-")]
    depends = tables.dependence_tables(camera)
    parts = [
        section(
            "How the camera changed", ("deviations", "principal-point", "movement"),
            [tables.deviation_table(camera)],
        ),
        section(
            "How it depends on the temperature", ("temperature-dependence",),
            depends[:1], text=detail_sentences(camera),
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
    """Return the notes of all series, each once, with the series to which it applies."""
    holders: dict[str, list[str]] = {}
    for study in camera.series:
        for note in study.notes:
            holders.setdefault(note, []).append(study.series.name)
    notes = [
        note if len(names) == len(camera.series) else f"{', '.join(names)}: {note}"
        for note, names in holders.items()
    ]
    doubts = [
        as_sentence(line)
        for study in camera.series
        for line in doubt_lines(study.series.doubts, study.series.name)
    ]
    return doubts + notes + list(camera.notes)
