"""The calibrated epochs of a series: one row per epoch, and the results for the whole series.

They come from a recording or a store: calibrated one by one, as stored, or all adjusted together
from their observations (`adjusted`).
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.acquisition.calibrator import calibrated_epochs
from thermocald.analysis.series.course import Course, carried_by_c, say_carried, table_of
from thermocald.errors import DataError, DriverMissing, UsageError
from thermocald.figures import BAND
from thermocald.files import write_parts
from thermocald.numbers import counted, parameter_label, with_sd
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.series.covariances import AFFINITY, count_moved
from thermocald.photogrammetry.series.mount import FASTEST_DRIFT_S
from thermocald.physics.effect import PARAMETER_UNITS
from thermocald.result import Result, csv_text, document_of, in_parts, jsonable, new_figure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.photogrammetry.series.field_motion import FieldMovement
    from thermocald.photogrammetry.series.result import SeriesAdjustment
    from thermocald.result import Columns
    from thermocald.store.recording.head import Head


MATERIAL = 0.1
"""Excess of sigma0 over 1 that is explained in the output."""
CAUSES_OF_SIGMA0 = (
    "above 1 if the image points or the test field are worse than stated, or if the distortion "
    "does not describe the lens"
)
_TESTS_A_FIELD = 18  # redundancy of a level that tests the field: 16 targets
_SHOWN_SDS = 5.0  # significance of an affinity that the targets show
_LEVEL_OF_FEW = 1.6  # error over sd with 12 to 14 targets whose field is 3 to 10 times worse
_UNEVEN = 1.3  # outer noise over that in the middle, which is reported


_EXTERIOR_WORDS = {
    "per_epoch": "per epoch",
    "series": "of the series",
    "mount": "of the series with movements of the mount",
}
_DRAWN = ("c", "x0", "y0")


@dataclass(frozen=True, eq=False, repr=False)
class Epochs(Result):
    """The calibrated epochs of a series, one row per epoch.

    number, frame_time (E,) s UTC; temperature (E,) °C of the reference at the frame's time;
    values, sd (E, 16): the parameters c, x0, y0 (mm), A1 … C2, omega, phi, kappa (rad), X0, Y0, Z0
    (mm) and their standard deviations, NaN without a result; sigma0, n_observations, n_rejected
    (E,); status, reasons: E words and sentences; exterior: `series`, `mount` or `per_epoch`;
    level_sd (16,): of the level that all epochs share, NaN if it cannot be separated. Columns are
    also attributes: `epochs.c`, `epochs.sd_c`.

    drifts: the changes of the parameters and their significance; left_out: targets found to move by
    themselves; field_movements: of boards and targets, for which observations are corrected;
    adjustment: of the series, None for epochs as stored; groups: {name: rows of the test field} of
    targets on a board; without: returns the epochs without some targets (rows), quickly or fully.

    >>> epochs = tc.open("M1").calibrate()
    >>> bool((epochs.sd_c[epochs.ok] > 0).all())
    True
    """

    number: NDArray[np.int64]
    frame_time: Array
    temperature: Array
    values: Array
    sd: Array
    sigma0: Array
    n_observations: NDArray[np.integer]
    n_rejected: NDArray[np.integer]
    status: Sequence[str]
    reasons: Sequence[str]
    exterior: str
    level_sd: Array = field(default_factory=lambda: np.full(16, np.nan))
    adjustment: SeriesAdjustment | None = None
    groups: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    without: Callable[[NDArray[np.int64], bool], Epochs] | None = None
    left_out: tuple[str, ...] = ()
    trend_sd: Array = field(default_factory=lambda: np.zeros(16))
    perspective_sd: Array = field(default_factory=lambda: np.full(16, np.nan))
    redundancy: Array = field(default_factory=lambda: np.zeros(0))
    stillness: Array = field(default_factory=lambda: np.zeros(0))
    sampled: NDArray[np.int64] | None = None
    field_movements: tuple[FieldMovement, ...] = ()
    drifts: tuple[Course, ...] = ()
    head: Head | None = None

    heading = "Every epoch of a series"
    caption = "Change of each parameter since the first epoch; bars hold 95 % of its own noise."

    def __len__(self) -> int:
        return len(self.number)

    def __getattr__(self, name: str) -> Array:
        """Return a column (E,): `c`, `x0`, … `Z0` or `sd_c`, …"""
        column = name.removeprefix("sd_")
        if column not in PARAMETER_NAMES:
            known = ", ".join(PARAMETER_NAMES)
            raise AttributeError(f"Epochs has no {name!r}; the parameters are {known}")
        table = self.sd if name != column else self.values
        return table[:, PARAMETER_NAMES.index(column)]

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: not `without`, a function that holds the observations."""
        return {**vars(self), "without": None}

    @cached_property
    def ok(self) -> NDArray[np.bool_]:
        """Which epochs (E,) have a result."""
        return np.fromiter((word == "ok" for word in self.status), bool, len(self.status))

    @property
    def slow_errors(self) -> tuple[Array, Array]:
        """The courses (n, E) of errors that all epochs share but for a factor, and their variances
        (n, 16).
        """
        slow = () if self.adjustment is None else self.adjustment.slow
        at = np.linspace(0.0, 1.0, len(self))  # a long series has the course of its sample
        courses = [np.interp(at, np.linspace(0.0, 1.0, len(c)), c) for c, _ in slow]
        variances = [np.diag(changes) for _, changes in slow]
        return np.reshape(courses, (-1, len(self))), np.reshape(variances, (-1, 16))

    @property
    def slow_between_ends(self) -> Array:
        """The covariance (16, 16) of last minus first by which slow errors exceed independent ones.

        They have opposite signs in the first and the last epoch.
        """
        slow = () if self.adjustment is None else self.adjustment.slow
        changes = np.reshape([own for _, own in slow], (-1, 16, 16))
        ends = np.flatnonzero(self.ok)[[0, -1]] if self.ok.any() else [0, 0]
        first, last = self.slow_errors[0][:, ends].T
        return np.tensordot(-2.0 * first * last, changes, axes=1)

    @property
    def time(self) -> NDArray[np.datetime64]:
        """The frames' times (E,), UTC, to the microsecond."""
        return np.round(self.frame_time * 1e6).astype(np.int64).astype("datetime64[us]")

    @cached_property
    def covariance(self) -> Array:
        """The covariance (E, 16, 16) of each epoch's parameters, NaN without a result.

        Its diagonal is sd². Raises DataError for epochs as stored, and for a series too long for
        all its matrices; `adjustment.covariance` then has a sample.
        """
        if self.sampled is not None:
            raise DataError(
                "a series this long does not hold the covariance of every epoch; "
                "adjustment.covariance has those of the epochs `sampled`"
            )
        if self.adjustment is None:
            raise DataError(
                "these epochs are as stored, without covariance: open the series and calibrate it"
            )
        out: Array = self.adjustment.covariance.copy()
        common = self.adjustment.settings.common
        if len(common):
            out[:, common[:, None], common] += self.adjustment.level_covariance[
                common[:, None], common
            ]
        out[~self.ok] = np.nan
        return out

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald replay --json` writes, without the names of files."""
        ok, adjustment = self.ok, self.adjustment
        level = dict(zip(PARAMETER_NAMES, self.level_sd.tolist(), strict=True))
        document: dict[str, Any] = {
            "format": "thermocald-replay/1",
            "exterior": self.exterior,
            "exterior_choice": None,
            "epochs": len(self),
            "ok": int(ok.sum()),
            "sigma0": float(np.median(self.sigma0[ok])) if ok.any() else None,
            "noise_ratio": None,
            "field_ratio": None,
            "outer_noise": None,
            "held_affinity": None,
            "rejected": int(self.n_rejected.sum()),
            "left_out": list(self.left_out),
            "field_movements": [
                {**m.as_dict(), "sentence": m.sentence} for m in self.field_movements
            ],
            "parameters": [{**document_of(c), "sd_mean_level": level[c.name]} for c in self.drifts],
            "without_result": [
                {"epoch": int(self.number[i]), "status": self.status[i], "reason": self.reasons[i]}
                for i in np.flatnonzero(~ok).tolist()
            ],
        }
        if adjustment is not None:
            value, sd = adjustment.outer_noise
            uneven = abs(value - 1.0) > max(3.0 * sd, _UNEVEN - 1.0)
            document |= {
                "exterior_choice": adjustment.choice,
                "noise_ratio": adjustment.noise_ratio,
                "field_ratio": adjustment.field_ratio,
                "outer_noise": {"value": value, "sd": sd} if uneven else None,
                "held_affinity": _held_affinity(adjustment),
            }
            if adjustment.step:
                document["targets_moved_before_epoch"] = int(self.number[adjustment.step])
            seen = int(adjustment.observed.any(axis=0).sum())
            free = len(adjustment.settings.free) + 6  # and the exterior orientation
            if np.isfinite(adjustment.offsets).any() and 2 * seen - free < _TESTS_A_FIELD:
                document["level_tested_by_targets"] = seen
        if hang := self._hang_on_c():
            document["changes_hang_on_c"] = hang
        if adjustment is not None and self.exterior == "series":
            # test of single epochs for another exterior orientation
            moved, bound = count_moved(self.stillness)
            document["stood_still"] = {
                "epochs_that_moved": moved,
                "largest_chi2": float(np.nan_to_num(self.stillness).max(initial=0.0)),
                "bound": bound,
            }
        converted: dict[str, Any] = jsonable(document)
        return converted

    def answer(self) -> str:
        """Return how c, x0 and y0 change, if at all; without drifts, what was calibrated."""
        drawn = [course for course in self.drifts if course.name in _DRAWN]
        if not drawn:
            return super().answer()
        moving = [f"{parameter_label(c.name)} moves by {c.movement}" for c in drawn if c.moves]
        still = [parameter_label(c.name) for c in drawn if not c.moves]
        if still:
            verb = "show" if len(still) > 1 else "shows"
            moving.append(f"{', '.join(still)} {verb} no significant drift")
        seen = self.temperature[self.ok & np.isfinite(self.temperature)]
        within = f"between {seen.min():.0f} and {seen.max():.0f} °C " if len(seen) else ""
        return f"In {len(self)} epochs {within}{'; '.join(moving)}"

    def lines(self) -> list[str]:
        """Return what `thermocald replay` prints."""
        document = self.as_dict()
        exterior = _EXTERIOR_WORDS[self.exterior]
        calibrated = f"{document['ok']} of {document['epochs']} epochs calibrated"
        rejected = counted(document["rejected"], "rejected observation")
        out = [f"{calibrated}, exterior orientation {exterior}, {rejected}"]
        still = document.get("stood_still")
        if (sigma0 := document["sigma0"]) is not None:
            cause = ""
            if moved := document.get("targets_moved_before_epoch"):
                cause = (
                    f"; the targets moved against one another before epoch {moved}: it cannot be "
                    "decided which of them, and the standard deviations allow for all"
                )
            elif self.adjustment is not None and not self.adjustment.noise_shown:
                cause = (
                    "; so few observations show the errors of the test field rather than theirs, "
                    "so that the stated standard deviations are kept, untested"
                )
            elif still and still["epochs_that_moved"]:
                cause = "; the camera did not stand still"
            elif sigma0 > 1.0 + MATERIAL:
                cause = f"; {CAUSES_OF_SIGMA0}"
                if self.adjustment is not None and np.isfinite(self.adjustment.offsets).any():
                    cause = (
                        "; it changes from epoch to epoch: noise of the image points, not the test "
                        "field"
                    )
            out.append(
                f"sigma0 {sigma0:.2f}: scatter of the image points over their stated standard "
                f"deviations{cause}"
            )
        if (ratio := document["field_ratio"] or 1.0) > 1.0:
            out.append(
                f"the targets have the same errors in all epochs, {ratio:.1f} times what the test "
                "field's stated standard deviations allow: wrong coordinates, or a lens that the "
                "distortion does not describe; the level's standard deviations are scaled by that"
            )
        if few := document.get("level_tested_by_targets"):
            out.append(
                f"{few} targets are too few to test the test field's coordinates: if these are "
                f"worse than stated, the level is wrong by up to {_LEVEL_OF_FEW:g} times its "
                "standard deviations; differences between epochs are not affected"
            )
        if outer := document["outer_noise"]:
            out.append(
                f"the outermost targets are {outer['value']:.1f} ± {outer['sd']:.1f} times as "
                "noisy as those in the middle of the image; the weights follow that"
            )
        if held := document["held_affinity"]:
            label, micrometres = parameter_label(held["parameter"]), 1e3 * held["level_mm"]
            off = (
                f"the level of {label} by {micrometres:.2f} µm, {held['sds']:.1f} of its standard "
            )
            off += "deviations; differences between epochs are not affected"
            if shown := held.get("shown"):
                differs = with_sd(shown["value"], shown["sd"])
                out.append(
                    f"{shown['name']} is held, and the targets show that it differs by {differs}, "
                    f"which moves {off}: add {shown['name']} to --free, or state it in the camera "
                    "file"
                )
            else:
                out.append(f"C1 and C2 are held: an affinity of {AFFINITY:g} would move {off}")
        if document["exterior_choice"]:
            out.append(f"--exterior {self.exterior}: {document['exterior_choice']}")
        out += [f"{moved.sentence}; corrected" for moved in self.field_movements]
        out += [
            f"left out: target {name}, which moves by itself, and the targets on its board"
            for name in self.left_out
        ]
        out += table_of(self.drifts)
        if hang := document.get("changes_hang_on_c"):
            out.append(say_carried(hang["c_known_to"], hang["sds"]))
        if limits := [c for c in self.drifts if isfinite(c.sd_by_perspective)]:
            sds = ", ".join(f"{c.name} ± {1e3 * c.sd_by_perspective:.3f}" for c in limits)
            nor = ", nor faster changes of the camera from the mount's"
            out.append(
                f"movements of the mount slower than {FASTEST_DRIFT_S / 60:.0f} min cannot be "
                f"separated from the camera's{nor if self.exterior == 'mount' else ''}; last − "
                f"first by the perspective alone, whatever the mount does: {sds} µm"
            )
        reasons = [f"{w['status']}: {w['reason']}" for w in document["without_result"]]
        out += [f"{reasons.count(text)} × {text}" for text in sorted(set(reasons))]
        if still and still["epochs_that_moved"]:
            out.append(
                f"the camera did not stand still in {counted(still['epochs_that_moved'], 'epoch')} "
                f"(chi-square {still['largest_chi2']:.0f}, bound {still['bound']:.0f}): "
                "use --exterior per_epoch"
            )
        return out

    def _hang_on_c(self) -> dict[str, float] | None:
        """Return c's relative sd, and the largest error of a change due to it, in sds, or None."""
        if not self.drifts or not self.level_sd[0] > 0:
            return None
        share = float(self.level_sd[0] / np.nanmedian(self.values[self.ok, 0]))
        changes = {c.name: (c.last_minus_first, c.sd_last_minus_first) for c in self.drifts}
        changes |= {f"{c.name}/K": (c.per_kelvin, c.sd_per_kelvin) for c in self.drifts}
        sds = carried_by_c(share, changes)
        return {"c_known_to": share, "sds": max(sds.values())} if sds else None

    def plot(self, against: str = "time") -> Figure:
        """Draw the changes of c, x0 and y0 since the first epoch, µm, with 95 % bars.

        against: `time` or `temperature`. Needs matplotlib (extra `report`).
        """
        if against not in ("time", "temperature"):
            raise UsageError(f"against is {against!r}; it must be time or temperature")
        ok = self.ok
        x = self.temperature[ok] if against == "temperature" else self.time[ok].astype(object)
        figure, axes = new_figure(len(_DRAWN))
        for axis, name in zip(axes[:, 0], _DRAWN, strict=True):
            y, sd = 1e3 * getattr(self, name)[ok], 1e3 * getattr(self, f"sd_{name}")[ok]
            y = y - y[:1]
            axis.errorbar(x, y, BAND * np.nan_to_num(sd), fmt=".", ms=3, lw=0.6)
            axis.set_ylabel(f"change of {parameter_label(name)} in µm")
            axis.grid(alpha=0.3)
        if against != "temperature":
            from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

            if len(x) == 1:  # else years about it are shown
                half = np.timedelta64(30, "s")
                axes[-1, 0].set_xlim(self.time[ok][0] - half, self.time[ok][0] + half)
            times = AutoDateLocator(maxticks=8)  # type: ignore[no-untyped-call]
            axes[-1, 0].xaxis.set_major_locator(times)
            axes[-1, 0].xaxis.set_major_formatter(
                ConciseDateFormatter(times)  # type: ignore[no-untyped-call]
            )
        axes[-1, 0].set_xlabel("temperature in °C" if against == "temperature" else "time (UTC)")
        if self.head is not None:
            axes[0, 0].set_title(f"{self.head.camera.name}/{self.head.series}")
        return figure

    def to_csv(self, path: Path | str) -> Path:
        """Write what `thermocald export` writes (CONVENTIONS §4); return the file's path."""
        write_parts(Path(path), csv_text(in_parts(self.columns())))
        return Path(path)

    @property
    def without_result(self) -> dict[str, int]:
        """{reason: epochs without a result}, the most frequent first.

        Reasons that differ only in their numbers are merged, with the most frequent one's text.
        """
        counts = Counter(self.reasons)
        del counts[""]
        alike: dict[str, tuple[str, int]] = {}
        for reason, count in sorted(counts.items(), key=lambda entry: -entry[1]):
            kind = re.sub(r"[\d.]+", "#", reason.partition(";")[0])
            words, so_far = alike.get(kind, (reason, 0))
            alike[kind] = (words, so_far + count)
        return dict(sorted(alike.values(), key=lambda entry: -entry[1]))

    def to_pandas(self) -> pd.DataFrame:
        """Return a DataFrame with `time` and the columns of `to_csv`, indexed by epoch number.

        Units are in `attrs["units"]`. Raises DriverMissing without pandas.

        >>> frame = tc.open("M1").calibrate().to_pandas()
        >>> units = frame.attrs.get("units")
        >>> frame.index.name, units.get("c")
        ('epoch', 'mm')
        """
        pandas = _import("pandas")
        frame = pandas.DataFrame({"time": self.time, **self.columns()}).set_index("epoch")
        frame.attrs["units"] = {n: u for n in frame.columns if (u := unit_of(str(n)))}
        return frame

    def to_xarray(self) -> xr.Dataset:
        """Return a Dataset on the axes `epoch` and `parameter`, with units as attributes.

        Every column of `to_csv` is a variable, also `covariance` (epoch, parameter, parameter_2) if
        there is one; coordinates are time and temperature. The Dataset can be written as netCDF.
        Raises DriverMissing without xarray.

        >>> data = tc.open("M1").calibrate().to_xarray()
        >>> data.c.units, tuple(data.covariance.dims)
        ('mm', ('epoch', 'parameter', 'parameter_2'))
        """
        xarray = _import("xarray")
        columns = self.columns()
        coordinates = {
            "epoch": columns.pop("epoch"),
            "time": ("epoch", self.time.astype("datetime64[ns]")),
            "temperature": ("epoch", columns.pop("temperature")),
        }
        variables: dict[str, Any] = {
            name: ("epoch", np.array(list(values)) if name == "status" else values)
            for name, values in columns.items()
        }
        if self.adjustment is not None and self.sampled is None:
            axes = ("epoch", "parameter", "parameter_2")
            variables["covariance"] = (axes, self.covariance)
            coordinates["parameter"] = coordinates["parameter_2"] = list(PARAMETER_NAMES)
        about = {"exterior": self.exterior}
        if self.head is not None:
            about |= {"camera": self.head.camera.name, "series": self.head.series}
        data: xr.Dataset = xarray.Dataset(variables, coordinates, about)
        for name in data.variables:
            if unit := unit_of(str(name)):
                data[name].attrs["units"] = unit
        return data

    def columns(self) -> Columns:
        """Return the columns of `to_csv` (CONVENTIONS §4) by name, E values each."""
        return {
            "epoch": self.number,
            "frame_time": self.frame_time,
            "temperature": self.temperature,
            **dict(zip(PARAMETER_NAMES, self.values.T, strict=True)),
            "sigma0": self.sigma0,
            "n_observations": self.n_observations.astype(np.int64),
            "n_rejected": self.n_rejected.astype(np.int64),
            "status": self.status,
            **dict(zip((f"sd_{name}" for name in PARAMETER_NAMES), self.sd.T, strict=True)),
        }


def unit_of(column: str) -> str:
    """Return the unit of a column of `Epochs.columns`, "" if it has none."""
    others = {"frame_time": "s", "temperature": "degC"}
    return others.get(column) or PARAMETER_UNITS.get(column.removeprefix("sd_"), "")


def _held_affinity(adjustment: SeriesAdjustment) -> dict[str, Any] | None:
    """Return the parameter whose level a held affinity shifts most; None if by less than one sd.

    The affinity is that which the targets show, with its difference and sd, or else `AFFINITY`.
    """
    held = adjustment.affinity
    if held is None or not held.names:
        return None
    size = np.abs(held.differences)
    shown = (size > _SHOWN_SDS * held.sds) & (size > AFFINITY)
    size = np.where(shown, size, 0.0 if shown.any() else AFFINITY)
    sd = np.where(adjustment.level_sd > 0, adjustment.level_sd, np.inf)[: len(_DRAWN)]
    moved = np.abs(held.moves[:, : len(_DRAWN)]) * size[:, None]
    which, worst = np.unravel_index(int(np.argmax(moved / sd)), moved.shape)
    mm, sds = float(moved[which, worst]), float((moved / sd)[which, worst])
    if not sds > 1.0:
        return None
    found: dict[str, Any] = {"parameter": PARAMETER_NAMES[worst], "level_mm": mm, "sds": sds}
    if shown.any():
        difference = {"value": float(held.differences[which]), "sd": float(held.sds[which])}
        found["shown"] = {"name": held.names[which], **difference}
    return found


def _import(module: str) -> Any:
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError:
        missing = f"{module} is not installed: pip install 'thermocald[tables]'"
        raise DriverMissing(missing) from None


def calibrate_epochs(
    epochs: Iterable[Epoch],
    calibrator: Calibrator,
    temperature: Array,
    advance: Callable[[int], None] | None = None,
    jobs: int = 1,
) -> tuple[Epochs, list[Observations | None]]:
    """Adjust epochs one by one; return them, and their observations for a series adjustment.

    temperature (E,): °C at the frames' times; jobs: processes.
    """
    rows = []
    for done in calibrated_epochs(calibrator, epochs, jobs):
        rows.append(done)
        if advance is not None:
            advance(1)
    nothing, found = np.full(16, np.nan), [done.adjustment for done in rows]
    table = Epochs(
        np.array([done.epoch.number for done in rows], dtype=np.int64),
        np.array([done.epoch.frame_time for done in rows]),
        temperature,
        np.array([a.values if a.ok else nothing for a in found]).reshape(-1, 16),
        np.array([a.sd if a.ok else nothing for a in found]).reshape(-1, 16),
        np.array([a.sigma0 if a.ok else np.nan for a in found]),
        np.array([a.n_observations for a in found], dtype=np.int64),
        np.array([len(a.rejected) for a in found], dtype=np.int64),
        tuple(a.status for a in found), tuple(a.reason for a in found), "per_epoch",
    )  # fmt: skip
    return table, [done.epoch.observations for done in rows]
