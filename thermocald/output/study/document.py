"""A study as one JSON document (CONVENTIONS §4): units of the model, `sd_<name>` with a value."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.output.study.summary import rate_in_px_and_mm
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.result import jsonable

if TYPE_CHECKING:
    from thermocald.analysis.statistics.dependence import Dependence
    from thermocald.analysis.study.series_study import ChannelStudy, SeriesStudy, Significance
    from thermocald.analysis.study.study import CameraStudy, Study

FORMAT = "thermocald-study/1"


def study_document(study: Study) -> dict[str, Any]:
    """Everything the study computed; null where something could not be, `notes` says why."""
    s = study.settings
    document: dict[str, Any] = jsonable(
        {
            "format": FORMAT,
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
    correlations = None
    if camera.correlations is not None:
        correlations = {
            "parameters": list(IOP_NAMES),
            "median": camera.correlations.median.tolist(),
            "noise": camera.correlations.noise.tolist(),
            "largest_deviation": camera.correlations.largest.tolist(),
            "epochs": camera.correlations.epochs,
        }
    return {
        "label": camera.label,
        "series": [_series(one, distance_mm) for one in camera.series],
        "interior_orientation": dict(zip(IOP_NAMES, camera.iop.tolist(), strict=True)),
        "sd_over_time": dict(zip(IOP_NAMES, camera.sds.tolist(), strict=True)),
        "iop_correlations": correlations,
        "correlations_over_time": {
            "parameters": list(IOP_NAMES),
            "r": camera.over_time.tolist(),
        },
        "object_space": _object_space(camera),
        "trajectory": [
            {
                "reference": one.reference,
                "fractions": one.fractions.tolist(),
                "mean_mm": one.mean,
                "mean_of_maxima_mm": one.mean_largest,
                "epochs": one.epochs,
            }
            for one in camera.trajectories
        ],
        "notes": list(camera.notes),
    }


def _series(study: SeriesStudy, distance_mm: float) -> dict[str, Any]:
    s = study.series
    focus = study.focus
    return {
        "name": s.name,
        "camera": s.camera,
        "source": s.source,
        "epochs": len(s),
        "without_result": dict(s.without_result),
        "sigma0": float(np.sqrt(np.mean(np.square(s.sigma0)))),
        "noise_ratio": study.noise_ratio,
        "image_noise_ratio": s.image_noise_ratio,
        "exterior_choice": s.choice or None,
        "field_movements": list(s.field_movements),
        "exterior": s.exterior,
        "free": list(s.free),
        "deviations": {name: jsonable(d) for name, d in study.deviations.items()},
        "depth_of_field": None
        if focus is None
        else {
            "near_first_mm": focus.first.near,
            "far_first_mm": focus.first.far,
            "near_last_mm": focus.last.near,
            "far_last_mm": focus.last.far,
            "change_mm": focus.change,
            "sd_change_mm": focus.sd_change,
            "confusion_mm": focus.confusion,
        },
        "image_displacement_px": None
        if study.displacement is None
        else {"points": study.grid.tolist(), "displacement": study.displacement.tolist()},
        "significance": {name: _significance(t) for name, t in study.significance.items()},
        "temperature_dependence": {
            channel.thermometer.name: _channel(study, channel, distance_mm)
            for channel in study.channels
        },
        "correlation_matrix": {"columns": list(study.columns), "r": study.matrix.tolist()},
        "notes": list(study.notes),
        "doubts": list(s.doubts),
    }


def _significance(test: Significance) -> dict[str, Any]:
    return {
        "success_ratio": test.success_ratio,
        "tests": test.tests,
        "left_out": test.left_out,
        "degrees_variance": test.degrees_variance,
        "degrees_sd": test.degrees_sd,
        "critical_ratio": test.critical,
        "median_ratio": test.median_ratio,
        "drift_test": None
        if test.drift is None
        else {
            "p": test.drift.p_value,
            "p_holm": test.p_holm,
            "p_excess": test.drift.p_excess,
            "p_excess_holm": test.p_excess_holm,
            "variance_ratio": test.drift.variance_ratio,
            "noise_ratio": test.drift.noise_ratio,
            "sd_noise_ratio": test.drift.sd_noise_ratio,
            "epochs": test.drift.epochs,
        },
    }


def _channel(study: SeriesStudy, channel: ChannelStudy, distance_mm: float) -> dict[str, Any]:
    return {
        "sd_thermometer": channel.thermometer.sd,
        "reason": channel.reason or None,
        "parameters": {
            name: {
                "n": d.n,
                "r": d.r,
                "p_naive": d.p_naive,
                "p_naive_holm": channel.p_naive_holm[name],
                "n_effective": d.n_effective,
                "residual_lag_one": d.lag_one,
                "p": d.p_value,
                "p_holm": channel.p_holm[name],
                "slope": d.slope,
                "sd_slope": d.sd_slope,
                **_rate_seen(study, name, d, distance_mm),
                "too_short": d.too_short,
                "scatter_over_noise": d.misfit,
            }
            for name, d in channel.dependences.items()
        },
    }


def _rate_seen(
    study: SeriesStudy, name: str, d: Dependence, distance_mm: float
) -> dict[str, float]:
    """A rate of c, x0 or y0 in px/K, and in mm/K on the object plane."""
    if name not in ("c", "x0", "y0"):
        return {}
    (px, mm), (sd_px, sd_mm) = (
        rate_in_px_and_mm(study, name, rate, distance_mm) for rate in (d.slope, d.sd_slope)
    )
    seen = {"slope_px": px, "sd_slope_px": sd_px}
    return {**seen, "slope_on_plane_mm": mm, "sd_slope_on_plane_mm": sd_mm}


def _object_space(camera: CameraStudy) -> dict[str, Any] | None:
    mc, first = camera.montecarlo, camera.first_order
    if mc is None or first is None:
        return None
    return {
        "sets": mc.sets,
        "seed": mc.seed,
        "distance_mm": mc.distance_mm,
        "clusters_mm": list(mc.clusters_mm),
        "fractions": mc.fractions.tolist(),
        "mean_mm": mc.overall_mean,
        "mean_of_maxima_mm": mc.mean_largest,
        "folded_sets": mc.folded,
        "points": [
            {
                "image_point_px": mc.image_points[k].tolist(),
                "expected_mm": mc.expected[k].tolist(),
                "counts": mc.counts[k].tolist(),
                "mean_mm": float(mc.mean[k]),
                "largest_mm": float(mc.largest[k]),
                "bias_mm": mc.mean_error[k].tolist(),
                "covariance_mm2": mc.covariance[k].tolist(),
                "first_order": {
                    "mean_mm": float(first.mean[k]),
                    "expected_largest_mm": float(first.expected_largest[k]),
                    "covariance_mm2": first.covariance[k].tolist(),
                },
            }
            for k in range(len(mc.image_points))
        ],
        "first_order": {
            "fractions": first.fractions.tolist(),
            "mean_mm": float(first.mean.mean()),
            "mean_of_maxima_mm": float(first.expected_largest.mean()),
        },
    }
