"""Whether a camera can be true: what was found of it against what is known of lens and sensor.

A pixel pitch that is wrong by a factor scales the principal distance and every drift in mm by it,
and width and height that are exchanged move the principal point; no residual shows either.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from thermocald.photogrammetry.camera.camera_model import Sensor

_RATIO = 1.2  # a lens focused near by is some percent longer, 35 mm equivalents are rounded
_OFF_CENTRE = 0.1  # of the image's diagonal
_PITCH_OPTION = "--pixel-pitch, or pixel_pitch in recording.yaml or the camera file"
_SIZE_OPTION = "width and height in recording.yaml or the camera file"


def doubts_of_interior(
    sensor: Sensor, interior: tuple[float, float, float], nominal: float | None
) -> list[str]:
    """Return a sentence for each reason to doubt an interior orientation that was found.

    interior: c, x0, y0 mm; nominal: the lens's focal length mm, None where it is not known.
    """
    return [*_of_distance(sensor, interior[0], nominal), *_of_centre(sensor, *interior[1:])]


def doubts_of_pitch(pitch: float, known: float | None) -> list[str]:
    """Return a sentence where a pixel pitch (mm) is not what EXIF says of the photographs."""
    if known is None or _alike(pitch, known):
        return []
    doubt = (
        f"a pixel pitch of {pitch:.4g} mm is {pitch / known:.2f} of the {known:.4g} mm that follow "
        "from the EXIF of the photographs: the pixels of an image that was binned or made smaller "
        f"are larger than the sensor's ({_PITCH_OPTION})"
    )
    return [doubt]


def _of_distance(sensor: Sensor, c: float, nominal: float | None) -> Iterator[str]:
    if nominal is None or not np.isfinite(c) or _alike(c, nominal):
        return
    fits = sensor.pixel_pitch * nominal / c
    yield (
        f"the principal distance found, {c:.4g} mm, is {c / nominal:.2f} of the {nominal:.4g} mm "
        f"that the lens is said to have: a pixel pitch of {fits:.3g} mm would fit instead of "
        f"{sensor.pixel_pitch:.4g} mm ({_PITCH_OPTION}); every length in the image and every drift "
        "in mm is wrong by that factor"
    )


def _of_centre(sensor: Sensor, x0: float, y0: float) -> Iterator[str]:
    x, y = x0 / sensor.pixel_pitch, y0 / sensor.pixel_pitch
    diagonal = float(np.hypot(sensor.width, sensor.height))
    away = float(np.hypot(x, y))
    if not away > _OFF_CENTRE * diagonal:
        return
    exchanged = (sensor.height - sensor.width) / 2
    why = (
        f"width and height are exchanged ({_SIZE_OPTION})"
        if np.hypot(x - exchanged, y - exchanged) < 0.05 * diagonal
        else f"were images cropped, or is their size wrong ({_SIZE_OPTION})?"
    )
    yield f"the principal point found lies {away:.0f} px from the centre of the image: {why}"


def _alike(one: float, other: float) -> bool:
    return 1 / _RATIO < one / other < _RATIO
