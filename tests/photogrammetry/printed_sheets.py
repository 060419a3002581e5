"""Simulated photographs of a printed test field, from the PDF itself.

Shares nothing with the drawing or with `thermocald.physics` but the page: the rays of every pixel
are intersected with the sheets' planes, and look up the rasterised page there. Several rays per
pixel and a Gaussian blur imitate a lens.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from thermocald.photogrammetry.camera.camera_model import CameraModel, ExteriorOrientation

GRID_PX = 8
BEYOND = 120.0


@cache
def rasterised(pdf: Path, page: int, dpi: float) -> np.ndarray:
    """Return one page as a grey image (H, W)."""
    pdfium = pytest.importorskip("pypdfium2")
    with pdfium.PdfDocument(pdf) as document:
        bitmap = document[page].render(scale=dpi / 72, grayscale=True)
        return bitmap.to_numpy().copy().reshape(bitmap.height, bitmap.width)


def page_count(pdf: Path) -> int:
    pdfium = pytest.importorskip("pypdfium2")
    with pdfium.PdfDocument(pdf) as document:
        return len(document)


@dataclass(frozen=True)
class Sheet:
    """A page in space: image (H, W), size mm, its lower left corner (3,) mm, axes x, y (2, 3)."""

    image: np.ndarray
    size: tuple[float, float]
    origin: np.ndarray
    axes: np.ndarray


def photograph(
    sheets: list[Sheet],
    camera: CameraModel,
    exterior: ExteriorOrientation,
    *,
    blur: float = 0.7,
    noise: float = 1.5,
    seed: int = 0,
    paper: float = 205.0,
    ink: float = 35.0,
    finer: int = 3,
) -> np.ndarray:
    """Take a frame (H, W), 8 bit, from a place where no sheet hides another.

    finer: rays per pixel in each direction; two suffice for circles.
    """
    w, h = camera.sensor.width, camera.sensor.height
    image = np.full((h * finer, w * finer), BEYOND, np.float32)
    coarse, step = _coarse_rays(camera), GRID_PX * finer
    for sheet in sheets:
        if (exterior.centre - sheet.origin) @ np.cross(*sheet.axes) <= 0:
            continue
        page = _smoothed(sheet, camera, exterior, finer)
        page = page * np.float32((paper - ink) / 255) + np.float32(ink)
        rows, columns = sheet.image.shape
        for k in range(len(coarse) - 2):  # bands, small enough for the processor's cache
            band, cells = image[k * step : (k + 1) * step], coarse[k : k + 3]
            u, v = _on_sheet(sheet, exterior, cells[..., 0], cells[..., 1])
            if not (np.abs(u / columns - 0.5) + np.abs(v / rows - 0.5) < 1.2).any():
                continue
            x, y = (
                cv2.resize(np.ascontiguousarray(cells[..., i]), None, fx=step, fy=step)
                [step : step + len(band), step : step + w * finer]
                for i in (0, 1)
            )  # fmt: skip
            u, v = _on_sheet(sheet, exterior, x, y)
            hit = (u >= -0.5) & (v >= -0.5) & (u <= columns - 0.5) & (v <= rows - 0.5)
            seen = cv2.remap(page, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            np.copyto(band, seen, where=hit)
    image = cv2.GaussianBlur(image, (0, 0), blur * finer)
    small = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA)
    if noise:
        small += np.random.default_rng(seed).standard_normal(small.shape, np.float32) * noise
    return np.clip(np.rint(small), 0, 255).astype(np.uint8)


def _smoothed(
    sheet: Sheet, camera: CameraModel, exterior: ExteriorOrientation, finer: int
) -> np.ndarray:
    """Return the sheet's image, smoothed to the spacing of the rays where it is seen smallest.

    The rays would skip finer details, and corners would be off by a hundredth of a pixel.
    """
    corners = sheet.origin + np.array([(0, 0), (1, 0), (0, 1), (1, 1)]) * sheet.size @ sheet.axes
    view = exterior.centre - corners
    distance = np.linalg.norm(view, axis=1)
    cosine = view @ np.cross(*sheet.axes) / distance
    rays_mm = finer * camera.interior.c / camera.sensor.pixel_pitch * (cosine / distance).min()
    apart = sheet.image.shape[1] / sheet.size[0] / rays_mm
    return cv2.GaussianBlur(sheet.image.astype(np.float32), (0, 0), max(0.35 * apart, 0.3))


def _coarse_rays(camera: CameraModel) -> np.ndarray:
    """Return the rays (rows, columns, 2) of a grid of pixels, with a cell more on every side.

    Rays are interpolated in it (distortion is smooth: to 3e-4 px). Places on the sheet are not:
    they would be 0.01 px off in an oblique view.
    """
    sides = (camera.sensor.width, camera.sensor.height)
    at = [np.arange(-1, -(-n // GRID_PX) + 1) * GRID_PX + (GRID_PX - 1) / 2 for n in sides]
    u, v = np.meshgrid(*at)
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    return (rays[:, :2] / rays[:, 2:]).reshape(*u.shape, 2)


def _on_sheet(
    sheet: Sheet, exterior: ExteriorOrientation, x: np.ndarray, y: np.ndarray
) -> list[np.ndarray]:
    """Return the places on the sheet's image (px) of rays (x, y, 1): quotients of linear forms.

    Rays go along -z; one that meets the plane behind the camera gets a place far away.
    """
    rotation, from_origin = exterior.rotation, exterior.centre - sheet.origin
    normal = np.cross(*sheet.axes)
    below = rotation.T @ normal
    denominator = below[0] * x + below[1] * y + below[2]
    rows, columns = sheet.image.shape
    found = []
    for axis, scale, offset in (
        (sheet.axes[0], columns / sheet.size[0], -0.5),
        (-sheet.axes[1], rows / sheet.size[1], rows - 0.5),
    ):
        form = (axis @ from_origin) * below - (from_origin @ normal) * (rotation.T @ axis)
        above = scale * form + offset * below
        with np.errstate(divide="ignore", invalid="ignore"):
            place = (above[0] * x + above[1] * y + above[2]) / denominator
        away = ~(denominator * (from_origin @ normal) > 0) | ~np.isfinite(place)
        found.append(np.where(away, -1e6, place).clip(-1e6, 1e6).astype(np.float32))
    return found


def put_up(pdf: Path, page_mm: tuple[float, float], trim: float, dpi: float = 150.0) -> list[Sheet]:
    """Return a printed PDF as a flat sheet or, cut along the crop marks, as a corner.

    The corner's sheets are floor, left wall, right wall. trim: mm outside the crop marks.
    """
    pages = [rasterised(pdf, i, dpi) for i in range(min(page_count(pdf), 3))]
    if len(pages) < 3:
        return [Sheet(pages[0], page_mm, np.array([-trim, -trim, 0.0]), np.eye(3)[:2])]
    w, h = (side - 2 * trim for side in page_mm)
    sizes = [(w, min(w, h)), (w, h), (w, h)]
    mm = [image.shape[1] / page_mm[0] for image in pages]
    cut = []
    for image, px, (wide, high) in zip(pages, mm, sizes, strict=True):
        low, top, right = (round(length * px) for length in (trim, trim + high, trim + wide))
        cut.append(image[-top - 1 : -low, low : right + 1])
    e = np.eye(3)
    places = [
        (np.zeros(3), e[:2]),
        (np.array([w, 0.0, 0.0]), np.stack([-e[0], e[2]])),
        (np.zeros(3), e[1:]),
    ]
    return [
        Sheet(np.ascontiguousarray(image), (image.shape[1] / px, image.shape[0] / px), *place)
        for image, px, place in zip(cut, mm, places, strict=True)
    ]
