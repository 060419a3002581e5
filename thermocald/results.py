"""Results with all that output makes of them: text, document, report, figure."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.study import study as studies
from thermocald.discovery import result as discoveries
from thermocald.discovery.entries import effects_of
from thermocald.discovery.model import build_model
from thermocald.errors import DataError
from thermocald.files import write_text
from thermocald.output.printed import calibration_document, calibration_lines, discovery_lines
from thermocald.output.study.summary import study_document, study_lines
from thermocald.physics.model_file import write_effects, write_model
from thermocald.result import Result, jsonable, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from thermocald.analysis.camera.photographs import Photographs
    from thermocald.analysis.study.reference import Comparison
    from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation
    from thermocald.photogrammetry.camera_files import CameraFile
    from thermocald.physics.model import ThermalModel

_Kind = TypeVar("_Kind")


def as_result(kind: type[_Kind], found: Any, **more: Any) -> _Kind:
    """Return an object of a class with the fields of an object of its base class."""
    return kind(**{f.name: getattr(found, f.name) for f in fields(found)}, **more)


@dataclass(frozen=True, eq=False, repr=False)
class Study(Result, studies.Study):
    """A study of one or several cameras: section 4 of Elias et al. 2020 for one's own.

    cameras: for each label its series, statistics, correlations and Monte-Carlo; settings: what it
    was made with; reference: each figure of the reference study beside ours, where that was asked.
    """

    reference: tuple[Comparison, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald study --json` writes."""
        document = study_document(self)
        if self.reference:
            document["reference"] = [c.as_dict() for c in self.reference]
        return document

    def lines(self) -> list[str]:
        """Return what `thermocald study` prints."""
        return study_lines(self, self.reference)

    def report(self, path: Path | str, title: str = "Thermal study of a camera") -> Path:
        """Write the report, one HTML file (extra `report`)."""
        from thermocald.output.study.report import render_study

        write_text(Path(path), render_study(self, title))
        return Path(path)

    def save_figures(self, folder: Path | str) -> list[Path]:
        """Write every figure as SVG and PNG; returns the files."""
        from thermocald.output.study.report import save_figures

        return save_figures(self, Path(folder))

    def plot(self) -> Figure:
        """Draw how the interior orientation of the first camera changed."""
        from thermocald.figures import draw_figure
        from thermocald.output.study.figures import deviation_figure

        figure: Figure = draw_figure(deviation_figure(self.cameras[0]))
        return figure


@dataclass(frozen=True, eq=False, repr=False)
class Discovery(Result, discoveries.Discovery):
    """Where simulation and measurement disagree, and which effect is missing.

    verdict: `adequate`, `effects_found` or `unexplained`; effects: names, sentences, estimates,
    evidence and alternatives; stages: how the gap closed; name: of what was explained; before: the
    model that it was explained from, None for the base model.
    """

    name: str = ""
    before: ThermalModel | None = None

    as_dict = discoveries.Discovery.as_dict

    def lines(self) -> list[str]:
        """Return what `thermocald discover` prints."""
        return discovery_lines(self)

    def report(self, path: Path | str, title: str = "") -> Path:
        """Write the report, one HTML file (extra `report`)."""
        from thermocald.output.discovery import report_html

        write_text(Path(path), report_html(self, title or self.name))
        return Path(path)

    def plot(self) -> Figure:
        """Draw the gap before and after each effect, reduced χ² over its floor."""
        figure, axes = new_figure(1)
        names = [stage.added or "base model" for stage in self.stages]
        axis = axes[0, 0]
        axis.plot(names, [s.fit.chi2_reduced for s in self.stages], "o-", label="M1")
        if all(s.verify is not None for s in self.stages):
            gaps = [s.verify.chi2_reduced for s in self.stages if s.verify is not None]
            axis.plot(names, gaps, "s--", label="verified on")
        axis.axhline(1.0, lw=0.6, color="grey")
        axis.set_ylabel("reduced χ² (no unit)")
        axis.legend()
        return figure

    @cached_property
    def model(self) -> ThermalModel:
        """The model with what was found."""
        return build_model(self, self.before)

    def save(self, path: Path | str) -> Path:
        """Write the model with what was found (YAML), which `fit` and `simulate` take."""
        write_model(Path(path), self.model)
        return Path(path)

    def save_effects(self, path: Path | str) -> Path | None:
        """Write what was found as an effect file; None where another recording would show none."""
        effects = [one for entry in self.effects for one in effects_of(entry)]
        if not effects:
            return None
        evidence = {"verdict": self.verdict, "gap": self.as_dict()["gap"]}
        said = "; ".join(e.statement for e in self.effects)
        write_effects(Path(path), effects, said, evidence)
        return Path(path)


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Result):
    """A camera calibrated from photographs of a test field, and where each was taken.

    photographs: status and reason, the adjustment's sigma0 and covariance, and each photograph;
    file: what was known of the camera; pitch_assumed: nobody said how large a pixel is.
    """

    photographs: Photographs
    file: CameraFile
    pitch_assumed: bool = False

    @property
    def status(self) -> str:
        """`ok` where the interior orientation was estimated."""
        return self.photographs.status

    @property
    def posed(self) -> bool:
        """Whether the camera was calibrated, or a photograph has a pose."""
        return self.status == "ok" or any(p.status == "ok" for p in self.photographs.photographs)

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight, NaN where nothing was estimated."""
        return self.photographs.sigma0

    @cached_property
    def camera(self) -> Camera:
        """The camera, with covariance where it was estimated.

        Raises DataError where there is none.
        """
        if self.photographs.interior is None:
            raise DataError(f"the camera was not calibrated: {self.photographs.reason}")
        return Camera(
            self.file.sensor,
            float("nan"),
            self.photographs.interior.as_array(),
            np.array(self.photographs.covariance[:10, :10]),
            name=self.file.name,
        )

    @property
    def poses(self) -> dict[str, ExteriorOrientation]:
        """{photograph: orientation} of those that have one."""
        return {
            str(p.path): p.exterior for p in self.photographs.photographs if p.exterior is not None
        }

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald calibrate --json` writes."""
        document = calibration_document(
            self.photographs, self.file.name, self.file.sensor, self.pitch_assumed,
            self.file.principal_distance,
        )  # fmt: skip
        converted: dict[str, Any] = jsonable(document)
        return converted

    def lines(self) -> list[str]:
        """Return what `thermocald calibrate` prints."""
        return calibration_lines(self.as_dict())

    def report(self, path: Path | str, title: str = "") -> Path:  # noqa: ARG002
        """Write residuals and coverage, one HTML file (extra `report`)."""
        from thermocald.output.calibration import render_calibration

        page = render_calibration(self.photographs, self.file.sensor, self.file.name)
        write_text(Path(path), page)
        return Path(path)

    def plot(self) -> Figure:
        """Draw the residuals of all photographs over the image, px."""
        figure, axes = new_figure(1, panel=(6.0, 4.5))
        axis = axes[0, 0]
        for p in self.photographs.photographs:
            if len(p.points):
                x, y = p.points[p.used].T
                axis.quiver(x, y, *p.residuals[p.used].T, angles="xy", width=0.002)
        axis.set(xlim=(0, self.file.sensor.width), ylim=(self.file.sensor.height, 0))
        axis.set(xlabel="x, px", ylabel="y, px", aspect="equal", title=f"sigma0 {self.sigma0:.2f}")
        return figure

    def save(self, path: Path | str) -> Path:
        """Write the camera as our own file: `.json` with covariance, `.yaml` without.

        Raises DataError where nothing was estimated.
        """
        from thermocald.photogrammetry.camera_files import write_camera

        if self.photographs.interior is None or not self.photographs.estimated:
            why = self.photographs.reason
            raise DataError(f"{path}: not written, the camera was not calibrated: {why}")
        comment = (
            f"calibrated by thermocald from {len(self.photographs.photographs)} photographs, "
            f"sigma0 {self.sigma0:.2f}"
        )
        known = replace(self.file, interior=self.photographs.interior)
        write_camera(Path(path), known, self.photographs.covariance[:10, :10], comment)
        return Path(path)
