"""Simulated recordings: temperatures and image points, or frames, of a model and a programme.

The steps are: the heat network's temperatures on the true time axis; the model's orientation and
object points at each frame's time, from the true temperature at the reference thermometer; the
image points with noise, missed targets and gross errors; the thermometers' readings at their own
times. The standard deviations written with the image points are nominal: an effect that defocuses
makes the points scatter more than that.

Each random quantity has its own stream of random numbers, so that a change of one (more missing
readings) does not change the others (the image noise).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.epoch import Epoch
from thermocald.errors import ConfigurationError, GeometryError
from thermocald.numbers import counted
from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation, project
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.physics.history import History
from thermocald.physics.testfields import corner_view
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.physics.device import CameraDevice, Programme
    from thermocald.physics.effect import Prediction
    from thermocald.physics.model import ThermalModel

_CHUNK = 64  # epochs at a time
_MARGIN_PX = 5.0  # a target nearer to the image's edge is not measured
_FEWEST = 3  # targets without which there is nothing to orient the camera by
_FINEST_STEPS = 10  # knots of the true temperature per interval
_LONG = 20_000  # epochs above which there is one knot per interval
_COLDEST, _HOTTEST = -273.15, 220.0  # °C; a recording of hotter ones would be taken for kelvin


@dataclass(frozen=True)
class Simulation:
    """A simulated series of a camera; everything random depends on `seed`."""

    model: ThermalModel
    device: CameraDevice
    field: TestField
    programme: Programme
    seed: int = 0

    def __post_init__(self) -> None:
        if self.model.sensor != self.device.sensor:
            a, b = self.model.sensor, self.device.sensor
            raise ConfigurationError(
                f"the model is of {self.model.camera} ({a.width}×{a.height} px, {a.pixel_pitch:g} "
                f"mm), the camera file of {self.device.name} ({b.width}×{b.height} px, "
                f"{b.pixel_pitch:g} mm); a model belongs to one camera"
            )

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64([self.seed, stream]))

    @cached_property
    def frame_times(self) -> Array:
        """The frames' times (E,) s from the start, ascending from 0."""
        p, rng = self.programme, self._rng(0)
        limit = 0.4 * p.interval
        shift = np.clip(p.jitter * rng.standard_normal(p.epochs), -limit, limit)
        shift[0] = 0.0
        return np.arange(p.epochs) * p.interval + shift

    @cached_property
    def reading_times(self) -> Array:
        """The thermometers' reading times (E,) s from the start, ascending."""
        p = self.programme
        spread = p.reading_spread * self._rng(1).uniform(-1.0, 1.0, p.epochs)
        return np.asarray(np.maximum.accumulate(self.frame_times + p.reading_offset + spread))

    @cached_property
    def exterior(self) -> ExteriorOrientation:
        """The exterior orientation of the model, of the camera file, or before the field."""
        return (
            self.model.exterior
            or self.device.exterior
            or corner_view(self.field, self.device.distance)
        )

    @cached_property
    def true_history(self) -> History:
        """The true temperatures at the thermometers, for the frames' times."""
        frames, p = self.frame_times, self.programme
        steps = _FINEST_STEPS if p.epochs <= _LONG else 1
        last = max(float(frames[-1]), float(self.reading_times[-1]))
        regular = np.arange(0.0, last + p.interval / steps, p.interval / steps)
        grid = np.unique(np.concatenate([frames, regular]))
        initial = p.initial
        if initial is None:
            initial = float(p.boundaries["ambient"].at(0.0))
        bodies = self.device.network.solve(grid, initial, p.sources, p.boundaries)
        channels = {name: bodies[t.body] for name, t in self.device.thermometers.items()}
        for name, T in channels.items():
            if not (T.min() >= _COLDEST and T.max() <= _HOTTEST):
                raise ConfigurationError(
                    f"programme {p.name}: thermometer {name} would be between {T.min():.0f} and "
                    f"{T.max():.0f} °C; check initial, ambient and sources"
                )
        return History(frames, grid, channels, self.device.reference, self.model.T0)

    @cached_property
    def truth(self) -> Prediction:
        """The model's prediction for the frames' times."""
        model = replace(self.model, exterior=self.exterior)
        truth = model.predict(self.true_history, self.field)
        if not (c := truth.iop[:, 0]).min() > 0:
            raise ConfigurationError(
                f"model {model.name or model.camera}: the principal distance would fall to "
                f"{c.min():.3g} mm; check the rate and the effects of c"
            )
        return truth

    @cached_property
    def _doubts(self) -> list[str]:
        """Effects that change nothing in this series, and a camera that turns away from its field.

        Both come of a wrong unit or a time beyond the programme.
        """
        effects, history, out = self.model.effects, self.true_history, []
        for effect in effects:
            others = tuple(e for e in effects if e is not effect)
            without = replace(self.model, effects=others, exterior=self.exterior)
            if without.predict(history, self.field).is_like(self.truth):
                T = history.temperature()
                out.append(
                    f"effect {effect.name} changes nothing in this series, which lasts "
                    f"{self.frame_times[-1]:.0f} s, at {T.min():.1f} to {T.max():.1f} °C; check "
                    "its parameters"
                )
        every = self.programme.epochs
        parts = (slice(k, min(k + _CHUNK, every)) for k in range(0, every, _CHUNK))
        inside = (self.model.sensor.contains(self.image_points(p), _MARGIN_PX) for p in parts)
        if few := sum(int(np.sum(seen.sum(axis=1) < _FEWEST)) for seen in inside):
            out.append(
                f"the camera sees fewer than {_FEWEST} targets in {few} of "
                f"{counted(every, 'epoch')}; check the effects that turn or shift it, and their "
                "units"
            )
        return out

    @cached_property
    def readings(self) -> dict[str, Array]:
        """The thermometers' readings {channel: (E,) °C}, NaN where missing."""
        true = self.true_history
        return {
            name: thermometer.read(
                true.reading_times, true.readings[name], self.reading_times, self._rng(10 + i)
            )
            for i, (name, thermometer) in enumerate(self.device.thermometers.items())
        }

    @property
    def head(self) -> Head:
        """The recording's head, which names the model and the seed."""
        sensor = self.model.sensor
        return Head(
            f"{self.device.name}-{self.programme.series}",
            self.programme.series,
            self.programme.interval,
            CameraSpec(self.device.name, sensor, float(round(self.model.interior.c, 2))),
            {
                name: Channel(t.resolution or None)
                for name, t in self.device.thermometers.items()
            },
            {"simulated": {"model": self.model.name, "version": self.model.version,
                           "programme": self.programme.name, "seed": self.seed}},
        )  # fmt: skip

    def image_points(self, epochs: slice) -> Array:
        """Return the true image points (e, n, 2) px of all targets; NaN behind the camera."""
        t = self.truth
        still = self.field.points
        points = t.points(still, epochs) if t.moves_points else still
        return project(self.model.sensor, t.iop[epochs], t.eop[epochs], points)

    def observations(self) -> Iterator[Observations]:
        """Yield each epoch's measured image points; memory does not grow with the epochs.

        Raises GeometryError if the camera sees fewer than 3 targets at the start.
        """
        measuring, rng = self.device.measuring, self._rng(2)
        n = len(self.field)
        stated = np.full((n, 2), measuring.sigma)
        for begin in range(0, self.programme.epochs, _CHUNK):
            epochs = slice(begin, min(begin + _CHUNK, self.programme.epochs))
            true = self.image_points(epochs)
            count = len(true)
            noise = rng.standard_normal((count, n, 2))
            missed = rng.random((count, n)) < measuring.missed
            gross = rng.random((count, n)) < measuring.gross
            wrong = rng.standard_normal((count, n, 2)) * measuring.gross_size
            factor = measuring.sigma * self.truth.noise_factor[epochs]
            with np.errstate(invalid="ignore"):
                seen = self.model.sensor.contains(true, _MARGIN_PX) & ~missed
            measured = true + factor[:, None, None] * noise + gross[..., None] * wrong
            if begin == 0 and int(seen[0].sum()) < _FEWEST:
                raise GeometryError(
                    f"the camera sees {int(seen[0].sum())} of {n} targets; point it at the field "
                    "(exterior or distance in the camera file)"
                )
            for k in range(count):
                rows = np.flatnonzero(seen[k])
                yield Observations(rows, measured[k, rows], stated[rows])

    def epochs(self, observed: bool = True) -> Iterator[Epoch]:
        """Yield the epochs of the recording, with or without their observations."""
        begin = self.programme.begin
        readings = list(self.readings.items())
        measured = self.observations() if observed else repeat(None, self.programme.epochs)
        for i, observations in enumerate(measured):
            yield Epoch(
                number=i + 1,
                frame_time=float(begin + self.frame_times[i]),
                temperature_time=float(begin + self.reading_times[i]),
                temperatures={name: float(values[i]) for name, values in readings},
                observations=observations,
            )

    def frames(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the rendered frames (H, W)."""
        from thermocald.physics.scene import Scene

        scene = Scene(self.model.sensor, self.field, self.device.look)
        t = self.truth
        for i in range(self.programme.epochs):
            points = t.points(self.field.points, slice(i, i + 1))[0] if t.moves_points else None
            yield scene.render(
                t.iop[i], t.eop[i], points, self.seed * 1_000_003 + i, float(t.blur_factor[i])
            )

    def write(
        self,
        path: Path,
        with_frames: bool = False,
        advance: Callable[[int], None] = lambda _: None,
    ) -> None:
        """Write the recording: either observations, or frames that are yet to be measured.

        advance: called with the number of epochs done. Raises RecordingError if `path` exists.
        """
        import simplejpeg

        frames = self.frames()
        with RecordingWriter(path, self.head, self.field) as writer:
            for epoch in self.epochs(observed=not with_frames):
                jpeg = None
                if with_frames:
                    image = np.ascontiguousarray(next(frames)[:, :, None])
                    jpeg = simplejpeg.encode_jpeg(image, quality=95, colorspace="GRAY")
                writer.append(epoch, jpeg)
                advance(1)

    def as_dict(self) -> dict[str, Any]:
        """Return the document that `simulate` writes with `--json`."""
        truth, model = self.truth, self.model
        temperature = self.true_history.temperature()
        moved = truth.iop - truth.iop[0]
        pitch = model.sensor.pixel_pitch
        return {
            "format": "thermocald-simulation/1",
            "series": self.programme.series,
            "seed": self.seed,
            "epochs": self.programme.epochs,
            "targets": len(self.field),
            "model": {
                "name": model.name or model.camera,
                "version": model.version,
                "effects": [effect.name for effect in model.effects],
            },
            "temperature": {
                "first": float(temperature[0]),
                "last": float(temperature[-1]),
                "lowest": float(temperature.min()),
                "highest": float(temperature.max()),
            },
            "drift": {
                "principal_point_px": float(np.hypot(moved[:, 1], moved[:, 2]).max() / pitch),
                "principal_point_last_px": float(np.hypot(moved[-1, 1], moved[-1, 2]) / pitch),
                "c_mm": float(moved[np.argmax(np.abs(moved[:, 0])), 0]),
            },
            "noise_factor": {"first": float(truth.noise_factor[0]),
                             "highest": float(truth.noise_factor.max())},
            "doubts": self._doubts,
        }  # fmt: skip

    def lines(self) -> list[str]:
        """Return the line that `simulate` prints."""
        document = self.as_dict()
        drift, T = document["drift"], document["temperature"]
        return [
            f"{counted(document['epochs'], 'epoch')}, {document['targets']} targets, "
            f"{T['lowest']:.1f} to {T['highest']:.1f} °C, principal point moved by up to "
            f"{drift['principal_point_px']:.1f} px, principal distance by "
            f"{1000 * drift['c_mm']:z.1f} µm".replace("-", "−")
        ]
