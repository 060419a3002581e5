"""The front door's results, each with its text, document, report and figure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from thermocald.analysis import field as checks
from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.camera.photographs import Photographs
from thermocald.analysis.series.epochs import CAUSES_OF_SIGMA0, MATERIAL
from thermocald.analysis.study import study as studies
from thermocald.discovery import result as discoveries
from thermocald.discovery.entries import effects_of
from thermocald.discovery.result import build_model, field_lines, mount_lines, say_adequate
from thermocald.errors import DataError
from thermocald.figures import draw_figure
from thermocald.names import tell_apart
from thermocald.numbers import counted, percent, plain
from thermocald.output import calibration as calibration_report
from thermocald.output import discovery as discovery_report
from thermocald.output.study import report as study_report
from thermocald.output.study.figures import deviation_figure
from thermocald.photogrammetry.camera_files import write_camera
from thermocald.physics.model_file import write_effects, write_model
from thermocald.result import Result, document_of, jsonable
from thermocald.store.logger.photographs import known_photograph
from thermocald.store.recording.sense import doubt_lines, interior_doubts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from thermocald.analysis.study.reference import Comparison
    from thermocald.photogrammetry.camera.camera_model import CameraSpec, ExteriorOrientation
    from thermocald.physics.model import ThermalModel


@dataclass(frozen=True, eq=False, repr=False)
class Study(Result, studies.Study):
    """A thermal study of one or more cameras, as in section 4 of Elias et al. 2020.

    cameras: for each label, its series, statistics, correlations and Monte-Carlo simulation;
    settings: the study's settings; reference: for a reference study, each published number with
    the one computed here.
    """

    heading = "Thermal study of a camera"
    reference: tuple[Comparison, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald study --json` writes."""
        document = study_report.study_document(self)
        if self.reference:
            document["reference"] = jsonable(self.reference)
        return document

    def lines(self) -> list[str]:
        """Return what `thermocald study` prints."""
        return study_report.study_lines(self, self.reference)

    def page(self, title: str = "") -> str:
        """Return the report as HTML text."""
        return study_report.render_study(self, title or self.heading)

    def save_figures(self, folder: Path | str) -> list[Path]:
        """Write every figure as SVG and PNG; return the files."""
        return study_report.save_figures(self, Path(folder))

    def plot(self) -> Figure:
        """Draw the changes of the first camera's interior orientation."""
        return draw_figure(deviation_figure(self.cameras[0]))


@dataclass(frozen=True, eq=False, repr=False)
class Discovery(discoveries.Discovery, Result):
    """The effects that explain where simulation and measurement disagree.

    verdict: `adequate`, `effects_found` or `unexplained`; effects: the effects found, each with
    name, sentence, estimates, evidence and alternatives; stages: the gap before and after each
    effect; name: the explained series; before: the model at the start, None for the base model.
    """

    name: str = ""
    before: ThermalModel | None = None

    def lines(self) -> list[str]:
        """Return what `thermocald discover` prints."""
        first, last = self.stages[0], self.stages[-1]
        lines = [f"verdict: {self.headline}"]
        if self.verdict == "adequate":
            lines.append(say_adequate(self.examination))
        for effect in self.effects:
            lines.append(f"{effect.effect}: {effect.statement}")
            lines += [
                f"    {name} = {discovery_report.estimate_text(e)}"
                for name, e in effect.estimates.items()
                if isinstance(e["value"], float)
            ]
            evidence = effect.evidence
            if "false_alarm_probability" in evidence:
                drawn = evidence["surrogates"]
                lines.append(
                    f"    probability of a false name {evidence['false_alarm_probability']:.3f} "
                    f"(gain {drawn['gain']:.0f}; the largest of {drawn['count']} surrogates "
                    f"{drawn['gains_of_surrogates'][-1]:.0f})".replace("-", "−")
                )
            if proposal := evidence.get("proposal"):
                lines.append(
                    f"    constants of the first recording explain "
                    f"{percent(proposal['closed_on_verify_by_fit'])} of the misfit of the second; "
                    f"probability of a false formula {proposal['false_alarm_probability']:.3f}"
                )
            lines += [
                f"    not excluded: {a['effect']}; {a['experiment']}"
                for a in effect.alternatives
                if not a.get("resembles")
            ]
        lines += [*mount_lines(self.examination), *field_lines(self.examination)]
        sources = [e.source.name for e in self.examination.fitter.series]
        names = tell_apart([Path(source).name or source for source in sources], sources)
        gaps = zip(first.gaps, last.gaps, strict=True)
        for name, (before, after) in zip(names, gaps, strict=True):
            lines.append(
                f"gap on {name}: {before.rms_px:.4f} → {after.rms_px:.4f} px RMS, reduced χ² "
                f"{before.chi2_reduced:.3f} → {after.chi2_reduced:.3f}, "
                f"{before.object_mm_at_10m:.2f} → {after.object_mm_at_10m:.2f} mm at 10 m"
            )
        return [*lines, *doubt_lines(self.doubts)]

    def page(self, title: str = "") -> str:
        """Return the report as HTML text; title: by default the series' name."""
        return discovery_report.report_html(self, title or self.name)

    def plot(self) -> Figure:
        """Draw the gap before and after each effect and the noise, px."""
        return draw_figure(discovery_report.gap_figure(self))

    @cached_property
    def model(self) -> ThermalModel:
        """The thermal model with the effects found."""
        return build_model(self, self.before)

    def save(self, path: Path | str) -> Path:
        """Write the thermal model with the effects found (YAML), for `fit` and `simulate`."""
        write_model(Path(path), self.model)
        return Path(path)

    def save_effects(self, path: Path | str) -> Path | None:
        """Write the effects found as an effect file; return None if none would recur elsewhere."""
        effects = [one for entry in self.effects for one in effects_of(entry)]
        if not effects:
            return None
        evidence = {"verdict": self.verdict, "gap": self.as_dict()["gap"]}
        statement = "; ".join(e.statement for e in self.effects)
        write_effects(Path(path), effects, statement, evidence)
        return Path(path)


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Photographs, Result):
    """A camera calibrated from photographs of a test field, and the photographs' poses.

    file: the camera's data as given; pitch_assumed: whether the pixel pitch was assumed.
    """

    JSON: ClassVar = Photographs.JSON | {
        "file": "", "pitch_assumed": "", "head": "camera", "doubts": "doubts",
    }  # fmt: skip

    file: CameraSpec = field(kw_only=True)
    pitch_assumed: bool = False

    @property
    def head(self) -> dict[str, Any]:
        """The camera's part of the document."""
        sensor = document_of(self.file.sensor)
        return {"name": self.file.name, **sensor, "pixel_pitch_assumed": self.pitch_assumed}

    @property
    def doubts(self) -> list[str]:
        """Probable mistakes in the estimated camera, one sentence each."""
        if self.interior is None or not self.estimated:
            return []
        found = []
        if self.disagreement > 1:
            found.append(
                "the photographs disagree: what the image points of one photograph have in common "
                f"is {self.disagreement:.1f} times as large as their noise explains (another "
                "focus or zoom, a board that bends, a rolling shutter, blur by motion?); the "
                "standard deviations, also of the poses, include this, but no error that all "
                "photographs share"
            )
        if self.pitch_assumed:
            return found
        first = known_photograph(Path(self.photographs[0].path), "file")
        nominal = self.file.principal_distance or (first.focal_length if first else None)
        c, x0, y0 = self.interior.as_array()[:3].tolist()
        return found + interior_doubts(replace(self.file, principal_distance=nominal), c, x0, y0)

    @property
    def _notes(self) -> list[str]:
        """The doubts and what was assumed, for text and report."""
        assumed = (
            "the pixel pitch is not known and taken as 1 µm: c, x0, y0 in mm are thousandths of "
            "px; give --pixel-pitch or --camera"
        )
        return doubt_lines(self.doubts) + [assumed] * self.pitch_assumed

    @cached_property
    def camera(self) -> Camera:
        """The camera, with its covariance if it was estimated.

        Raises DataError if the camera was not calibrated.
        """
        if self.interior is None:
            raise DataError(f"the camera was not calibrated: {self.reason}")
        values, Q = self.interior.as_array(), self.covariance[:10, :10]
        return Camera(self.file.sensor, math.nan, values, Q, name=self.file.name)

    @property
    def poses(self) -> dict[str, ExteriorOrientation]:
        """{photograph: exterior orientation} of the photographs that have one."""
        return {str(p.path): p.exterior for p in self.photographs if p.exterior is not None}

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald calibrate --json` writes."""
        return {"format": "thermocald-calibration/1", **document_of(self)}

    def lines(self) -> list[str]:
        """Return what `thermocald calibrate` prints."""
        if self.status == "ok":
            lines = [
                f"calibrated from {len(self.poses)} of "
                f"{counted(self.n_photographs, 'photograph')}: sigma0 "
                f"{self.sigma0:.2f}, redundancy {self.redundancy}"
                + (f"; {CAUSES_OF_SIGMA0}" if self.sigma0 > 1.0 + MATERIAL else "")
            ]
            table = calibration_report.interior_table(self, self.file.sensor, str)
            rows = [("", *table.headings[1:]), *table.rows]
            width = [max(len(row[k]) for row in rows) for k in range(3)]
            lines += [
                "  ".join(f"{t:<{w}}" for t, w in zip(row, width, strict=True)) for row in rows
            ]
            lines += self._notes
        else:
            lines = [f"not calibrated: {self.reason}"]
        for p in self.photographs:
            line = f"{p.path}: {p.status}, {counted(p.n_targets, 'target')}"
            if p.exterior is not None:
                line += f", {plain(p.rms_px, 'px', 2)}, at {p.place} mm"
            lines.append(line + (f": {p.reason}" if p.reason else ""))
        return lines

    def page(self, title: str = "") -> str:
        """Return residuals and coverage as HTML text; title: by default the camera's name."""
        name = title or self.file.name
        return calibration_report.render_calibration(self, self.file.sensor, name, self._notes)

    def plot(self) -> Figure:
        """Draw the residuals of all photographs over the image, px."""
        return draw_figure(calibration_report.residual_figure(self, self.file.sensor))

    def save(self, path: Path | str) -> Path:
        """Write the camera in this program's format: `.json` with covariance, `.yaml` without.

        Raises DataError if nothing was estimated.
        """
        if not self.estimated:
            raise DataError(f"{path}: not written, the camera was not calibrated: {self.reason}")
        comment = (
            f"calibrated by thermocald from {counted(len(self.poses), 'photograph')}, "
            f"sigma0 {self.sigma0:.2f}"
        )
        known = replace(self.file, interior=self.interior)
        write_camera(Path(path), known, self.covariance[:10, :10], comment)
        return Path(path)


@dataclass(frozen=True, eq=False, repr=False)
class FieldCheck(checks.FieldCheck, Result):
    """How well a camera sees a test field, what it would calibrate, and what is missing."""

    def page(self, title: str = "") -> str:
        """Return the report as HTML text."""
        return calibration_report.render_field_check(self, title)

    def plot(self) -> Figure:
        """Draw the visible targets in the image, px."""
        return draw_figure(calibration_report.seen_figure(self))
