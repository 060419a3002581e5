"""Results as documents, and in lines for people."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.series.epochs import CAUSES_OF_SIGMA0, MATERIAL
from thermocald.discovery.result import Discovery, field_lines, mount_lines
from thermocald.numbers import UNITS, plain, with_sd
from thermocald.photogrammetry.camera.camera_model import EOP_NAMES, IOP_NAMES, Sensor
from thermocald.store.logger.photographs import focal_length, moment_taken
from thermocald.store.recording.head import CameraSpec
from thermocald.store.recording.sense import doubt_lines, interior_doubts

if TYPE_CHECKING:
    from thermocald.analysis.camera.photographs import PhotographResult, Photographs


def discovery_lines(found: Discovery) -> list[str]:
    """Return the lines that `thermocald discover` prints."""
    first, last = found.stages[0], found.stages[-1]
    lines = [f"verdict: {found.headline}"]
    if found.verdict == "adequate":
        lines.append("the model reproduces the recording; nothing is missing that it could show")
    for effect in found.effects:
        lines.append(f"{effect.effect}: {effect.statement}")
        for name, e in effect.estimates.items():
            if isinstance(e["value"], float):
                sd = math.nan if e["sd"] is None else e["sd"]
                lines.append(f"    {name} = {with_sd(e['value'], sd, e['unit'])}")
        if "false_alarm_probability" in effect.evidence:
            surrogates = effect.evidence["surrogates"]
            lines.append(
                f"    probability of a false name {effect.evidence['false_alarm_probability']:.3f} "
                f"(gain {surrogates['gain']:.0f}; the largest of {surrogates['count']} surrogates "
                f"{surrogates['gains_of_surrogates'][-1]:.0f})"
            )
        if proposal := effect.evidence.get("proposal"):
            lines.append(
                f"    constants of the first recording explain "
                f"{proposal['closed_on_verify_by_fit']:.0%} of the misfit of the second; "
                f"probability of a false formula {proposal['false_alarm_probability']:.3f}"
            )
        lines += [
            f"    not excluded: {a['effect']}; {a['experiment']}"
            for a in effect.alternatives
            if not a.get("resembles")
        ]
    lines += [*mount_lines(found.examination), *field_lines(found.examination)]
    names = [Path(e.source.name).name or e.source.name for e in found.examination.fitter.series]
    gaps = zip((first.fit, *first.others), (last.fit, *last.others), strict=True)
    for name, (before, after) in zip(names, gaps, strict=True):
        lines.append(
            f"gap on {name}: {before.rms_px:.4f} → {after.rms_px:.4f} px RMS, reduced χ² "
            f"{before.chi2_reduced:.3f} → {after.chi2_reduced:.3f}, "
            f"{before.object_mm_at_10m:.2f} → {after.object_mm_at_10m:.2f} mm at 10 m"
        )
    return [*lines, *doubt_lines(found.doubts)]


def calibration_document(
    result: Photographs, name: str, sensor: Sensor, assumed: bool, nominal: float | None = None
) -> dict[str, Any]:
    """Return what `thermocald calibrate --json` writes; assumed: the pixel pitch is.

    nominal: the focal length mm, by default EXIF's.
    """
    document: dict[str, Any] = {
        "format": "thermocald-calibration/1",
        "camera": {
            "name": name,
            "width": sensor.width,
            "height": sensor.height,
            "pixel_pitch": sensor.pixel_pitch,
            "pixel_pitch_assumed": assumed,
        },
        "status": result.status,
        "reason": result.reason,
        "sigma0": result.sigma0,
        "redundancy": result.redundancy,
        "n_photographs": len(result.photographs),
        "interior": None,
        "correlations": None,
        "doubts": [],
        "photographs": [_photograph(p) for p in result.photographs],
    }
    if result.interior is not None:
        values = result.interior.as_array()
        document["interior_estimated"] = result.estimated
        nominal = nominal or focal_length(Path(result.photographs[0].path))
        if result.estimated and not assumed:
            c, x0, y0 = values[:3].tolist()
            spec = CameraSpec(name, sensor, nominal)
            document["doubts"] = interior_doubts(spec, c, x0, y0)
        document["interior"] = dict(zip(IOP_NAMES, values.tolist(), strict=True))
        if result.estimated:
            sd = np.sqrt(np.diag(result.covariance)[:10])
            free = sd > 0
            document["interior"] |= {
                f"sd_{n}": float(s) for n, s, f in zip(IOP_NAMES, sd, free, strict=True) if f
            }
            rows = np.flatnonzero(free)
            r = result.covariance[np.ix_(rows, rows)] / np.outer(sd[rows], sd[rows])
            document["correlations"] = {"names": [IOP_NAMES[i] for i in rows], "matrix": r}
    return document


def _photograph(p: PhotographResult) -> dict[str, Any]:
    taken = moment_taken(Path(p.path))
    out: dict[str, Any] = {
        "image": p.path,
        "time": None if taken is None else taken.isoformat(),
        "status": p.status,
        "reason": p.reason,
        "n_targets": p.n_targets,
        "n_rejected": len(p.rejected),
        "rejected": list(p.rejected),
        "rms_px": p.rms_px,
        "exterior": None,
    }
    if p.exterior is not None:
        values = p.exterior.as_array()
        out["exterior"] = dict(zip(EOP_NAMES, values.tolist(), strict=True))
        out["exterior"] |= {
            f"sd_{n}": float(s) for n, s in zip(EOP_NAMES, p.exterior_sd, strict=True)
        }
    return out


def calibration_lines(document: dict[str, Any]) -> list[str]:
    """Return what `thermocald calibrate` prints of a document of `calibration_document`."""
    lines: list[str] = []
    interior = document["interior"]
    if document["status"] == "ok":
        used = sum(p["exterior"] is not None for p in document["photographs"])
        lines.append(
            f"calibrated from {used} of {document['n_photographs']} photographs: sigma0 "
            f"{document['sigma0']:.2f}, redundancy {document['redundancy']}"
            + (f"; {CAUSES_OF_SIGMA0}" if document["sigma0"] > 1.0 + MATERIAL else "")
        )
        rows = [("", "value ± sd", "in px")]
        pitch = document["camera"]["pixel_pitch"]
        for name in IOP_NAMES:
            sd = interior.get(f"sd_{name}")
            if sd is None:
                rows.append((name, f"{plain(interior[name], UNITS[name], 6)} (held)", ""))
                continue
            px = with_sd(interior[name] / pitch, sd / pitch) if name in ("c", "x0", "y0") else ""
            rows.append((name, with_sd(interior[name], sd, UNITS[name]), px))
        width = [max(len(row[k]) for row in rows) for k in range(3)]
        lines += ["  ".join(f"{t:<{w}}" for t, w in zip(row, width, strict=True)) for row in rows]
        lines += doubt_lines(document["doubts"])
        if document["camera"]["pixel_pitch_assumed"]:
            lines.append(
                "the pixel pitch is not known and taken as 1 µm: c, x0, y0 in mm are thousandths "
                "of px; give --pixel-pitch or --camera"
            )
    else:
        lines.append(f"not calibrated: {document['status']}: {document['reason']}")
    for p in document["photographs"]:
        line = f"{p['image']}: {p['status']}, {p['n_targets']} targets"
        if p["exterior"] is not None:
            e = p["exterior"]
            line += f", {p['rms_px']:.2f} px, at " + ", ".join(
                with_sd(e[n], e["sd_" + n]) for n in ("X0", "Y0", "Z0")
            )
            line += " mm"
        if p["reason"]:
            line += f": {p['reason']}"
        lines.append(line)
    return lines
