"""Photographs of a test field: measurement, and joint calibration or single orientation."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.errors import GeometryError, ImageError, UsageError
from thermocald.numbers import with_sd
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    CameraSpec,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings, cold_start, pose_only
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.photogrammetry.frame.measurement import REPEATED, find_repeated, measure
from thermocald.photogrammetry.linalg import correlations
from thermocald.photogrammetry.network.common_interior import CommonInterior, adjust_common_interior
from thermocald.photogrammetry.orientation import approximate_orientation
from thermocald.photogrammetry.targets.image_file import EncodedImage, decode_grey
from thermocald.result import with_sds
from thermocald.store.logger.photographs import find_copies, known_photograph

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField

_IMAGES = frozenset(
    {".bmp", ".heic", ".heif", ".jpeg", ".jpg", ".pgm", ".png", ".tif", ".tiff", ".webp"}
)
_ASSUMED_PITCH = 0.001
_FIRST = 5  # photographs from which a camera to start from is tried


@dataclass(frozen=True, eq=False)
class PhotographResult:
    """A photograph with its pose; without one, status is not `ok` and has a reason.

    points (n, 2) px: its image points; residuals (n, 2) px: measured minus adjusted; used (n,):
    points that took part; all three are empty without a pose.
    """

    JSON: ClassVar = {
        "path": "image", "exterior_sd": "", "points": "", "residuals": "", "used": "",
        "time": "time", "n_rejected": "n_rejected", "exterior": "", "pose": "exterior",
    }  # fmt: skip

    path: Path | str
    status: str
    reason: str
    n_targets: int
    rejected: tuple[str, ...] = ()
    rms_px: float = float("nan")
    exterior: ExteriorOrientation | None = None
    exterior_sd: Array = field(default_factory=lambda: np.full(6, np.nan))
    points: Array = field(default_factory=lambda: np.empty((0, 2)))
    residuals: Array = field(default_factory=lambda: np.empty((0, 2)))
    used: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))

    @property
    def time(self) -> str | None:
        """The time in its EXIF data, or None."""
        taken = known_photograph(Path(self.path))
        return None if taken is None else taken.moment.isoformat()

    @property
    def n_rejected(self) -> int:
        """The number of rejected targets."""
        return len(self.rejected)

    @property
    def place(self) -> str:
        """X0, Y0, Z0 with their standard deviations, mm; empty without a pose."""
        centre = () if self.exterior is None else self.exterior.centre.tolist()
        return ", ".join(map(with_sd, centre, self.exterior_sd[3:].tolist()))

    @property
    def pose(self) -> dict[str, float] | None:
        """The exterior orientation with `sd_` of each parameter, as in JSON documents."""
        if self.exterior is None:
            return None
        return with_sds(EOP_NAMES, self.exterior.as_array(), self.exterior_sd)


@dataclass(frozen=True, eq=False)
class Photographs:
    """The camera and its photographs.

    status: `ok` if the interior orientation was estimated; estimated: False if `interior` was given
    and held; covariance (16, 16); disagreement: of the photographs (`CommonInterior`).
    """

    JSON: ClassVar = {
        "interior": "", "estimated": "interior_estimated", "covariance": "", "disagreement": "",
        "n_photographs": "n_photographs", "orientation": "interior", "correlations": "correlations",
    }  # fmt: skip

    status: str
    reason: str
    interior: InteriorOrientation | None
    estimated: bool
    covariance: Array
    sigma0: float
    redundancy: int
    photographs: tuple[PhotographResult, ...]
    disagreement: float = 1.0

    @property
    def n_photographs(self) -> int:
        """The number of photographs."""
        return len(self.photographs)

    @property
    def orientation(self) -> dict[str, float] | None:
        """The interior orientation with `sd_` of estimated parameters, as in JSON documents."""
        if self.interior is None:
            return None
        sds = np.sqrt(self.covariance.diagonal()).tolist()
        return asdict(self.interior) | {f"sd_{IOP_NAMES[i]}": sds[i] for i in self._estimated}

    @property
    def correlations(self) -> dict[str, Any] | None:
        """The correlations of the estimated parameters of the interior orientation."""
        if self.interior is None or not self.estimated:
            return None
        free = self._estimated
        matrix = correlations(self.covariance[np.ix_(free, free)])
        return {"names": [IOP_NAMES[i] for i in free], "matrix": matrix}

    @property
    def _estimated(self) -> NDArray[np.int64]:
        """The indices of the estimated parameters of the interior orientation."""
        return np.flatnonzero((self.covariance.diagonal()[:10] > 0) & self.estimated)


def calibrate_photographs(
    paths: Sequence[Path],
    testfield: TestField,
    camera: CameraSpec,
    settings: AdjustmentSettings,
    advance: Callable[[int], None] | None,
) -> Photographs:
    """Measure and calibrate photographs; a file that is no image gets a status and a reason."""
    failures: dict[int, tuple[str, str]] = {}
    copies, usable = find_copies(paths), dict[str, Observations]()
    for k, path in enumerate(paths):
        try:
            if k in copies:
                raise ImageError(f"is a copy of {paths[copies[k]].name}")
            found = measure(decode_grey(path), testfield, camera)
            if same := find_repeated(found.observations, usable):
                raise ImageError(REPEATED.format(Path(same).name))
        except (ImageError, GeometryError) as error:
            word = "bad_image" if isinstance(error, ImageError) else "no_orientation"
            failures[k] = (word, str(error).removeprefix(f"{path}: "))
        else:
            usable[str(path)] = found.observations
            if not found.status.ok:
                failures[k] = (found.status.word, found.status.reason)
        if advance is not None:
            advance(1)
    names = [*map(str, paths)]
    measured = [usable.get(name) for name in names]
    return calibrate_observations(names, measured, failures, testfield, camera, settings)


def calibrate_observations(
    names: Sequence[str],
    measured: Sequence[Observations | None],
    failures: dict[int, tuple[str, str]],
    testfield: TestField,
    camera: CameraSpec,
    settings: AdjustmentSettings,
) -> Photographs:
    """Calibrate from image points; failures: {position: (status, reason)} of unusable ones, to
    which those without a pose are added.
    """
    seen = {k: o for k, o in enumerate(measured) if o is not None}
    usable = {k: o for k, o in seen.items() if k not in failures}
    try:
        if not settings.free:
            held = "" if camera.interior else ", and no --camera gives it"
            raise GeometryError(f"the interior orientation is held (--free none){held}")
        if "c" not in settings.free and not (camera.interior or camera.principal_distance):
            raise GeometryError("the principal distance is held, and no --camera gives it")
        if not usable:
            raise GeometryError(_NO_TARGETS if seen else "none can be read")
        rows, together = _adjust_together(usable, testfield, camera, settings)
        left_out = together.left_out
        failures |= {rows[i]: ("large_residuals", why) for i, why in left_out.items()}
        if together.reasons:
            raise GeometryError("; ".join(together.reasons))
    except GeometryError as error:
        status, reason, interior = "weak_geometry", str(error), camera.interior
        result = Photographs(
            status if settings.free else "held", reason, interior, False, np.zeros((16, 16)),
            float("nan"), 0, (),
        )  # fmt: skip
        poses = {}
        for k in seen.keys() - failures.keys():
            if interior is None:
                failures[k] = status, "without an interior orientation there is no pose"
                continue
            pose = pose_only(camera.sensor, testfield, seen[k], interior, settings)
            if pose.ok:
                used = ~np.isin(pose.targets, pose.rejected)
                poses[k] = used, pose.residuals, pose.exterior, pose.sd[10:]
            else:
                failures[k] = (pose.status, pose.reason)
    else:
        result = Photographs(
            "ok", "", together.interior, True, together.covariance, together.sigma0,
            together.redundancy, (), together.disagreement,
        )  # fmt: skip
        sds = np.sqrt(np.diagonal(together.exterior_covariances, axis1=1, axis2=2))
        each = zip(together.used, together.residuals, together.exteriors, sds, strict=True)
        rows = [k for i, k in enumerate(rows) if i not in left_out]
        poses = dict(zip(rows, each, strict=True))
    photographs = []
    for k, name in enumerate(names):
        n = len(seen[k]) if k in seen else 0
        if k not in poses:
            photographs.append(PhotographResult(name, *failures.get(k, _NO_POSE), n))
            continue
        o, (used, v, exterior, sd) = seen[k], poses[k]
        rms = float(np.sqrt(np.mean(v[used] ** 2)))
        rejected = tuple(testfield.names[t] for t in o.targets[~used])
        photographs.append(
            PhotographResult(name, "ok", "", n, rejected, rms, exterior, sd, o.points, v, used)
        )
    return replace(result, photographs=tuple(photographs))


_NO_TARGETS = (
    "no photograph shows enough targets: do they show this test field, and is its number of "
    "corners or markers right?"
)
_NO_POSE = "no_orientation", "no pose explains its targets"


def _adjust_together(
    usable: dict[int, Observations],
    testfield: TestField,
    camera: CameraSpec,
    settings: AdjustmentSettings,
) -> tuple[list[int], CommonInterior]:
    """Adjust all photographs that have a pose; return their positions too. Else GeometryError."""
    oriented, why = dict[int, ExteriorOrientation](), ""
    # a frontal view, for example, gives a camera with which others have no pose
    for first in sorted(usable, key=lambda k: -len(usable[k]))[:_FIRST]:
        try:
            trial = _first_camera(usable[first], testfield, camera, settings)
        except GeometryError as error:
            why = why or str(error)
            continue
        found = dict[int, ExteriorOrientation]()
        for k, o in usable.items():
            with suppress(GeometryError):
                seen = camera.sensor, testfield.points[o.targets], o.points
                found[k] = approximate_orientation(*seen, interior=trial)[1]
        if len(found) > len(oriented):
            start, oriented = trial, found
        if len(oriented) == len(usable):
            break
    if not oriented:
        raise GeometryError(why or "no pose explains the targets of any photograph")
    chosen = [usable[k] for k in oriented]
    return list(oriented), adjust_common_interior(
        camera.sensor, testfield, chosen, start, list(oriented.values()), settings
    )


def _first_camera(
    o: Observations, testfield: TestField, camera: CameraSpec, settings: AdjustmentSettings
) -> InteriorOrientation:
    """Return an initial camera from one photograph."""
    nominal = camera.principal_distance
    first = cold_start(camera.sensor, testfield, o, settings, nominal, camera.interior)
    start = first.interior or camera.interior
    if start is None:
        points = testfield.points[o.targets]
        start = approximate_orientation(camera.sensor, points, o.points, nominal)[0]
    if not first.ok and camera.interior is None:
        # distortion from a weak photograph is a bad initial value for the others
        start = replace(start, A1=0.0, A2=0.0, A3=0.0, B1=0.0, B2=0.0, x0=0.0, y0=0.0)
    return start


def images_of(given: Sequence[Path]) -> list[Path]:
    """List files as given, and the images of folders by name.

    Raises UsageError if there is none, and for a file that does not exist or is given twice.
    """
    images: list[Path] = []
    for path in given:
        if path.is_file():
            images.append(path)
            continue
        if not path.is_dir():
            raise UsageError(f"{path}: there is no such file")
        # macOS leaves ._IMG_1.jpg, which is no image, beside IMG_1.jpg
        found = sorted(
            p for p in path.iterdir() if p.suffix.lower() in _IMAGES and p.name[0] != "."
        )
        if not found:
            raise UsageError(f"{path}: the folder holds no image ({', '.join(sorted(_IMAGES))})")
        images += found
    if not images:
        raise UsageError("give at least one photograph")
    if twice := next((p for p in images if images.count(p) > 1), None):
        raise UsageError(f"{twice} is given twice")
    return images


def unknown_camera(images: Sequence[Path], pixel_pitch: float | None) -> CameraSpec:
    """Return a camera for photographs without a camera file; pitch None stands for 1 µm.

    Its image size is that of most photographs. Raises ImageError if none can be read.
    """
    sizes: Counter[tuple[int, ...]] = Counter()
    for path in images:
        with suppress(ImageError):
            image = EncodedImage(path)
            sizes[image.size or image.whole().shape[::-1]] += 1
    if not sizes:
        decode_grey(images[0])
    width, height = sizes.most_common(1)[0][0]
    return CameraSpec("camera", Sensor(width, height, pixel_pitch or _ASSUMED_PITCH))
