"""How far two cameras are apart: in their parameters, and in the image.

In the image it is by how much a fixed direction is seen elsewhere, over a grid of the whole image,
as the cameras stand and after the rotation that brings them together best: what no orientation
takes up (mrcal calls it the projection difference). The cameras count as independent of each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from thermocald.analysis.camera.undistortion import directions, image_grid
from thermocald.errors import ConfigurationError
from thermocald.numbers import plain, with_sd
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, CameraModel, partials, project
from thermocald.physics.effect import PARAMETER_UNITS
from thermocald.result import Result, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from thermocald.arrays import Array

_GRID = 25  # points a side
_IN_PX = ("c", "x0", "y0")


@dataclass(frozen=True, eq=False)
class CameraDifference(Result):
    """Second minus first camera.

    names: of both, for people; first, second: cameras; covariances: of their interior orientations
    (10, 10), None where one is not known.
    """

    names: tuple[str, str]
    first: CameraModel
    second: CameraModel
    covariances: tuple[Array | None, Array | None] = (None, None)

    def __post_init__(self) -> None:
        a, b = self.first.sensor, self.second.sensor
        if (a.width, a.height) != (b.width, b.height):
            raise ConfigurationError(
                f"{self.names[0]} has {a.width} × {a.height} px, {self.names[1]} {b.width} × "
                f"{b.height}: only cameras of one image size can be compared"
            )
        if abs(a.pixel_pitch / b.pixel_pitch - 1.0) > 1e-9:
            raise ConfigurationError(
                f"{self.names[0]} has pixels of {a.pixel_pitch:g} mm, {self.names[1]} of "
                f"{b.pixel_pitch:g} mm: say --pixel-pitch where a file does not hold it"
            )

    @property
    def has_sd(self) -> bool:
        """Whether both cameras have a covariance."""
        return all(c is not None for c in self.covariances)

    @cached_property
    def shifts(self) -> Array:
        """By how much each direction of the grid is seen elsewhere, (n, 2) px."""
        return self._seen(self.second, self._directions) - self._grid

    @property
    def rms_px(self) -> float:
        """The root of the mean square of the shifts' lengths."""
        return _rms(self.shifts)

    @cached_property
    def turned_shifts(self) -> Array:
        """The same after the rotation that makes them smallest, (n, 2) px."""

        def left(angles: Array) -> Array:
            turned = Rotation.from_rotvec(angles).apply(self._directions)
            return (self._seen(self.second, turned) - self._grid).ravel()

        best = least_squares(left, np.zeros(3), x_scale=1e-4, xtol=1e-14, ftol=1e-14)
        return np.asarray(best.fun).reshape(-1, 2)

    def as_dict(self) -> dict[str, Any]:
        """The result as `--json` has it."""
        a, b = self.first.interior.as_array(), self.second.interior.as_array()
        sds = self._sds()
        rows = []
        for k, name in enumerate(IOP_NAMES):
            row = {"name": name, "unit": PARAMETER_UNITS[name], "first": a[k], "second": b[k],
                   "difference": b[k] - a[k]}  # fmt: skip
            rows.append(row if sds is None else row | {"sd_difference": sds[k]})
        lengths = np.linalg.norm(self.shifts, axis=1)
        turned = np.linalg.norm(self.turned_shifts, axis=1)
        worst = int(np.argmax(lengths))
        document = {
            "format": "thermocald-camera-difference/1",
            "first": self.names[0],
            "second": self.names[1],
            "parameters": rows,
            "largest_px": lengths[worst],
            "largest_at": self._grid[worst],
            "rms_px": _rms(self.shifts),
            "largest_turned_px": turned.max(),
            "rms_turned_px": _rms(self.turned_shifts),
        }
        if sds is not None:
            largest, rms = self._image_sds(worst)
            document |= {"sd_largest_px": largest, "sd_rms_px": rms}
        return document

    def lines(self) -> list[str]:
        """The result for people."""
        found = self.as_dict()
        pitch = self.first.sensor.pixel_pitch
        lines = [f"{self.names[1]} minus {self.names[0]}"]
        for row in found["parameters"]:
            if not row["first"] and not row["second"]:
                continue
            sd = row.get("sd_difference", np.nan)
            text = with_sd(row["difference"], sd, row["unit"])
            if row["name"] in _IN_PX:
                text += f"  ({with_sd(row['difference'] / pitch, sd / pitch, 'px')})"
            lines.append(f"  {row['name']:>3}  {text}")

        def px(name: str) -> str:
            sd = found.get(f"sd_{name}")
            return plain(found[name], "px", 3) if sd is None else with_sd(found[name], sd, "px")

        x, y = found["largest_at"]
        lines.append(
            f"in the image: {px('rms_px')} (RMS), {px('largest_px')} at most, at ({x:.0f}, {y:.0f})"
        )
        lines.append(
            f"after the best rotation: {px('rms_turned_px')} (RMS), {px('largest_turned_px')} at "
            "most"
        )
        return lines

    def plot(self) -> Figure:
        """Draw by how much each direction is seen elsewhere, enlarged, over the image."""
        sensor = self.first.sensor
        figure, axes = new_figure(1, 1, (5.0, 5.0 * sensor.height / sensor.width))
        axis = axes[0, 0]
        every = np.arange(_GRID**2).reshape(_GRID, _GRID)[::2, ::2].ravel()
        arrows = axis.quiver(*self._grid[every].T, *self.shifts[every].T, angles="xy", width=0.002)
        longest = float(np.linalg.norm(self.shifts, axis=1).max())
        axis.quiverkey(arrows, 0.9, 1.03, longest, f"{plain(longest, 'px', 2)}")
        axis.set(xlim=(0, sensor.width), ylim=(sensor.height, 0), xlabel="x, px", ylabel="y, px")
        axis.set_aspect("equal")
        return figure

    @cached_property
    def _grid(self) -> Array:
        return image_grid(self.first.sensor, _GRID)

    @cached_property
    def _directions(self) -> Array:
        return directions(self.first.sensor, self.first.interior.as_array(), self._grid)

    @staticmethod
    def _seen(camera: CameraModel, seen: Array) -> Array:
        return project(camera.sensor, camera.interior.as_array(), np.zeros(6), seen)

    def _sds(self) -> Array | None:
        a, b = self.covariances
        return None if a is None or b is None else np.sqrt(np.diag(a) + np.diag(b))

    def _image_sds(self, worst: int) -> tuple[float, float]:
        """Standard deviations px of the largest shift's length, and of the RMS."""
        along_shifts = self.shifts / np.linalg.norm(self.shifts, axis=1)[:, None].clip(1e-300)
        weights = self.shifts / (len(self.shifts) * max(_rms(self.shifts), 1e-300))
        largest = rms = 0.0
        cameras = (self.first, self.second)
        for camera, covariance in zip(cameras, self.covariances, strict=True):
            assert covariance is not None
            values = camera.interior.as_array()
            J = partials(camera.sensor, values, np.zeros(6), self._directions)[1][..., :10]
            along = along_shifts[worst] @ J[worst]
            total = np.einsum("nc,ncp->p", weights, J)
            largest += float(along @ covariance @ along)
            rms += float(total @ covariance @ total)
        return float(np.sqrt(largest)), float(np.sqrt(rms))


def _rms(shifts: Array) -> float:
    """Root of the mean square of lengths (n, 2)."""
    return float(np.sqrt(np.mean(np.sum(shifts**2, axis=1))))
