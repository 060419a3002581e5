"""The overview of a fleet: each camera's delay, rates with temperature, and findings.

A document, as a command's output and as a page, on which the specimens of each type are drawn
together so that an odd one can be seen.

The rates of c, x0 and y0 are slopes of straight lines through epochs that are spread over all that
a camera has measured. They compare specimens; a model for corrections is made by `thermocald fit`.

A finding has a kind and a sentence. `late`: no epoch for a while, because of the station, its
network or its daemon. `sensor`: a thermometer with no readings, the same for hours, or impossible
ones. `calibrate`: no result, an old one, a temperature outside the calibrated range, or a camera
that moved. `odd`: rates unlike those of the other cameras of its type. `clock`: a station's clock
that differs from the server's. `refused`: rows that the server refuses. `twins`: two stations with
the same name or with copies of one store.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter, defaultdict
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.statistics.dependence import dependence
from thermocald.analysis.statistics.random_effects import odd_specimens, population
from thermocald.errors import UsageError
from thermocald.figures import BAND, PALETTE, Figure, label_axes, new_drawing
from thermocald.names import WITH_VALUES
from thermocald.numbers import counted, parameter_label, percent, short_duration, shortened
from thermocald.photogrammetry.linalg import mad_sd
from thermocald.report import Answer, Chapter, Section, Table
from thermocald.result import document_of
from thermocald.store.server.connection import ServerAddress
from thermocald.store.server.fleet_reader import FleetCamera, FleetReader, Rate
from thermocald.store.sources import source_name

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from thermocald.arrays import Array

    Findings = Iterator[tuple[str, str]]

RATED = ("c", "x0", "y0")
ODD = 0.01
"""Probability below which a camera counts as unlike its type."""
_FEWEST_SAMPLES = 6
_FEWEST_SPECIMENS = 4
_RESOLUTION = 0.02  # K, assumed for a thermometer that does not state it
_LEAST_RANGE_K = 2.0


def camera_types(cameras: Sequence[FleetCamera]) -> list[dict[str, Any]]:
    """Return the documents of the types with enough specimens, and set their cameras' `odd`.

    rates: the mean of a type's specimens, its sd, and the specimens' sd about it, mm/K.
    """
    groups: dict[str, list[FleetCamera]] = defaultdict(list)
    for camera in cameras:
        if len(camera.rates) == len(RATED):
            groups[camera.type].append(camera)
    types = []
    for name, group in sorted(groups.items()):
        if len(group) < _FEWEST_SPECIMENS:
            continue
        values = np.array([[c.rates[p].value for p in RATED] for c in group])
        sds = np.array([[c.rates[p].sd for p in RATED] for c in group])
        covariances = np.einsum("ij,jk->ijk", sds**2, np.eye(len(RATED)))
        for camera, odd in zip(group, odd_specimens(values, covariances), strict=True):
            camera.odd = float(odd)
        # without odd specimens, whose scatter would hide them
        like = np.array([c.odd >= ODD for c in group])
        if like.sum() < _FEWEST_SPECIMENS:
            like[:] = True
        specimens = population(values[like], covariances[like])
        between = np.sqrt(np.diag(specimens.between))
        sd_mean = np.sqrt(np.diag(specimens.mean_covariance))
        rates = {
            rated: {"value": mean, "sd": sd, "unit": "mm/K", "sd_between": scatter}
            for rated, mean, sd, scatter in zip(
                RATED, specimens.mean.tolist(), sd_mean.tolist(), between.tolist(), strict=True
            )
        }
        types.append({"type": name, "cameras": [c.name for c in group], "rates": rates})
    return types


def _complete(camera: FleetCamera, now: float) -> None:
    """Fill a camera's fields from its last epochs and its samples; now: s UTC."""
    recent = camera.recent
    reference = _reference(camera)
    known = [t for e in recent if math.isfinite(t := e.temperatures.get(reference, math.nan))]
    on_the_way = [e.received - e.frame_time for e in recent if math.isfinite(e.received)]
    sensor = camera.head.camera.sensor
    # the model that the camera reports, else the size of its images and pixels
    model = str(camera.identity.get("model") or camera.identity.get("card") or "").strip()
    size = f"{sensor.width}×{sensor.height}"
    camera.type = f"{model} {size}" if model else f"{size}, {sensor.pixel_pitch * 1000:g} µm"
    camera.lag_s = now - camera.last_time
    if on_the_way:
        camera.on_the_way_s = float(np.median(on_the_way))
    if recent:
        camera.ok = sum(e.status in WITH_VALUES for e in recent) / len(recent)
    if known:
        camera.temperature = known[0]
    _find_rates(camera)


def _reference(camera: FleetCamera) -> str:
    return next(iter(camera.head.channels), "")


def _find_rates(camera: FleetCamera) -> None:
    """Fill a camera's rates by parameter, and its largest recent shift from their lines."""
    samples = camera.samples[np.isfinite(camera.samples).all(axis=1)]
    if len(samples) < _FEWEST_SAMPLES:
        return
    of = samples[:, 0]
    centred = _about_series_means(samples[:, 2], of)
    if np.ptp(centred) < _LEAST_RANGE_K:
        return
    resolution = next(iter(camera.head.channels.values())).resolution or _RESOLUTION
    rates: dict[str, Rate] = {}
    shift = (0.0, 0.0)
    for name, measured, sds in zip(RATED, samples.T[3::2], samples.T[4::2], strict=True):
        values = _about_series_means(measured, of)
        if not np.ptp(values) > 0:
            return
        line = dependence(values, sds, centred, resolution / math.sqrt(12))
        rates[name] = Rate(line.slope, line.sd_slope)
        shift = max(shift, _shift(values - line.slope * centred), key=lambda s: s[1])
    camera.rates = rates
    camera.shift_px = shift[0] / camera.head.camera.sensor.pixel_pitch
    camera.shift_sds = shift[1]


def _about_series_means(values: Array, of: Array) -> Array:
    """Return values (n,) minus the mean of their series, since each set-up has its own level."""
    centred = values.copy()
    for one in np.unique(of):
        centred[of == one] -= values[of == one].mean()
    return centred


def _shift(residual: Array) -> tuple[float, float]:
    """Return the shift of the last tenth of residuals (n,) from the others: size, and in its sds.

    Medians and the median absolute deviation make it robust against single errors.
    """
    last = max(3, len(residual) // 10)
    before, after = residual[:-last], residual[-last:]
    size = abs(float(np.median(after) - np.median(before)))
    scatter = float(mad_sd(before - np.median(before)))
    sd = 1.2533 * scatter * math.sqrt(1 / len(before) + 1 / last)
    return size, size / sd if sd > 0 else math.inf if size > 0 else 0.0


_LATE_INTERVALS, _LATE_S = 20.0, 900.0
_SILENT_S = 600.0
_CLOCK_S = 5.0
_FUTURE_S = 60.0
_FEWEST = 10
_STUCK_S = 6 * 3600.0
_PLAUSIBLE_C = (-60.0, 125.0)
_POWER_ON_C = 85.0  # a DS18B20's reading before its first measurement
_LEAST_OK = 0.5
_OLD_S = 30 * 86400.0
_OUTSIDE_K = 2.0
_SHIFT_PX, _SHIFT_SDS = 0.3, 6.0


def _late(camera: FleetCamera) -> Findings:
    limit = max(_LATE_INTERVALS * camera.head.interval, _LATE_S)
    if camera.lag_s > limit:
        since = f"no epoch for {short_duration(camera.lag_s)}"
        state = camera.state
        if state.contact is None:
            why = "; its station has never reported"
        elif camera.now - state.contact > _SILENT_S:
            ago = short_duration(camera.now - state.contact)
            why = f"; its station last reported {ago} ago: check its power and network"
        elif state.waiting:
            why = f"; {counted(state.waiting, 'row')} waiting at its station to be sent"
        else:
            why = ", though its station reports: check the camera and its daemon"
        yield "late", since + why
    if camera.state.stores > 1:
        text = (
            f"{camera.state.stores} stores report under its station's name, perhaps from a copied "
            "card; give each station its own name (forward.station)"
        )
        yield "twins", text
    if camera.copied:
        text = (
            "epochs with the same number have different times: its store is used at two stations, "
            "or a backup was restored; move a copied card's store away, so that a new one is made"
        )
        yield "twins", text
    if count := camera.state.refused:
        yield "refused", f"the server refused {counted(count, 'row')} of its station; see its log"


def _sensors(camera: FleetCamera) -> Findings:
    for channel in camera.head.channels:
        if trouble := _trouble(camera, channel):
            yield "sensor", f"{channel}: {trouble}"


def _trouble(camera: FleetCamera, channel: str) -> str:
    """Return what is wrong with a thermometer's last readings; empty if nothing."""
    read = [e.temperatures.get(channel, math.nan) for e in camera.recent]  # newest first
    known = [t for t in read if math.isfinite(t)]
    if len(read) < _FEWEST:
        return ""
    if not known:
        return f"no reading in the last {len(read)} epochs"
    if not any(map(math.isfinite, read[:_FEWEST])):
        return f"has stopped: no reading in the last {_FEWEST} epochs"
    if not _PLAUSIBLE_C[0] < known[0] < _PLAUSIBLE_C[1]:
        return f"reads {known[0]:g} °C, which is impossible"
    if len(known) >= _FEWEST and {*known} == {_POWER_ON_C}:
        return "reads 85 °C, the value of a DS18B20 that has not measured"
    if channel == _reference(camera) and (since := _stuck_for(camera, known)) >= _STUCK_S:
        return f"has read exactly {known[0]:g} °C for {short_duration(since)}"
    return ""


def _stuck_for(camera: FleetCamera, known: Sequence[float]) -> float:
    """Return for how long the reference's reading has been exactly the same, s."""
    if len(known) < _FEWEST or len({*known}) > 1:
        return 0.0
    since = camera.recent[-1].frame_time
    for _, frame_time, temperature, *_ in camera.samples[::-1].tolist():
        if temperature != known[0]:
            break
        since = min(since, frame_time)
    return camera.last_time - since


def _calibration(camera: FleetCamera) -> Findings:
    recent = camera.recent
    if len(recent) >= _FEWEST and camera.ok < _LEAST_OK:
        failed = [e.status for e in recent if e.status not in WITH_VALUES]
        often = max(sorted({*failed}), key=failed.count)
        yield "calibrate", f"{len(failed)} of the last {len(recent)} epochs have no result: {often}"
    if not math.isfinite(camera.last_ok):
        yield "calibrate", "was never calibrated"
        return
    age = camera.now - camera.last_ok
    if age > _OLD_S and camera.lag_s < _OLD_S:
        yield "calibrate", f"the last result is {short_duration(age)} old"
    low, high = camera.temperature_range or (math.nan, math.nan)
    outside = max(low - camera.temperature, camera.temperature - high)
    if outside > _OUTSIDE_K:
        text = (
            f"{camera.temperature:.1f} °C is {outside:.0f} K outside its calibrated range of "
            f"{low:.0f} to {high:.0f} °C"
        )
        yield "calibrate", text
    if not (camera.rates or _trouble(camera, _reference(camera))) and math.isfinite(low):
        text = (
            f"calibrated only from {low:.1f} to {high:.1f} °C, so that its rates are unknown; warm "
            "it up, or use its type's model (fit --type)"
        )
        yield "calibrate", text
    if camera.shift_px > _SHIFT_PX and camera.shift_sds > _SHIFT_SDS:
        yield "calibrate", f"has recently moved by {camera.shift_px:.1f} px from its straight line"


def _odd(camera: FleetCamera, kind: dict[str, Any] | None) -> Findings:
    if kind is None or not camera.odd < ODD:
        return

    def distance(name: str) -> float:
        rate, usual = camera.rates[name], kind["rates"][name]
        scatter = math.hypot(rate.sd, usual["sd_between"], 1e-12)
        return float(abs(rate.value - usual["value"]) / scatter)

    name = max(RATED, key=distance)
    usual = kind["rates"][name]
    text = (
        f"{name} drifts by {camera.rates[name].value * 1e3:+.3f} µm/K, the others "
        f"by {usual['value'] * 1e3:+.3f} ± {usual['sd_between'] * 1e3:.3f} (p = {camera.odd:.1g})"
    )
    yield "odd", text


def _clock(camera: FleetCamera) -> Findings:
    clock = camera.state.clock
    if clock is not None and abs(clock) > _CLOCK_S:
        offset = f"{short_duration(abs(clock))} {'ahead of' if clock > 0 else 'behind'}"
        yield "clock", f"its station's clock is {offset} the server's; epochs have its time"
    elif camera.lag_s < -_FUTURE_S:
        yield "clock", f"its last epoch is {short_duration(-camera.lag_s)} in the future"


# kind of a finding → words for one camera, for several, and what to do
_FINDINGS = {
    "late": ("late", "late", "Late: check the power and network of the station, or its daemon."),
    "sensor": ("dead sensor", "with a dead sensor",
               "Dead sensors: replace the thermometer; frames are still taken."),
    "calibrate": ("needs calibration", "in need of calibration",
                  "Cameras beyond their calibrated range: record there and fit again."),
    "odd": ("unlike its type", "unlike their type",
            "Cameras unlike their type: check whether the lens or the mount is loose."),
    "clock": ("wrong clock", "with a wrong clock",
              "Wrong clocks: synchronise the station before its temperatures are used."),
    "refused": ("rows refused", "with refused rows",
                "Refused rows: see the station's log for the reason."),
    "twins": ("twin", "with a twin", "Twins: give each station its own name and store."),
}  # fmt: skip
_ABSENT = "reports, but has no epoch from 2000 to now: check its daemon and clock"
_MOST_LABELLED = 40
_WIDTH = 80
_MOST_WITHOUT = 40  # cameras without a finding that are printed
_LONGEST_NAME = 34


def fleet_document(sources: Sequence[Path]) -> dict[str, Any]:
    """Return the document of the cameras that addresses select, on several servers as one fleet.

    Raises UsageError, ServerGone, ServerError, StoreVersionError.
    """
    cameras: list[FleetCamera] = []
    absent: list[str] = []
    now = 0.0
    addresses = [ServerAddress.parse(source) for source in sources]
    for source, address in zip(sources, addresses, strict=True):
        with FleetReader(address) as reader:
            now, stations = reader.now(), reader.stations()
            selected = reader.cameras(now)
        part = address.camera or address.series or (address.station and not stations)
        if part and not selected:
            raise UsageError(f"{source_name(source)}: there is no such station, camera or series")
        for camera in selected:
            camera.state = stations.get(camera.station, camera.state)
            _complete(camera, now)
        cameras += selected
        if not (address.camera or address.series):
            absent += sorted({*stations} - {camera.station for camera in selected})
    types = camera_types(cameras)
    type_of = {name: kind for kind in types for name in kind["cameras"]}
    for camera in cameras:
        findings = chain(
            _late(camera), _sensors(camera), _calibration(camera),
            _odd(camera, type_of.get(camera.name)), _clock(camera),
        )  # fmt: skip
        camera.findings = [{"kind": kind, "text": text} for kind, text in findings]
    counts = Counter(kind for c in cameras for kind in {f["kind"] for f in c.findings})
    return {
        "format": "thermocald-fleet/1",
        "servers": [str(address) for address in addresses],
        "time": now,
        "cameras": [document_of(camera) for camera in cameras],
        "types": types,
        "absent": absent,
        "summary": {
            "cameras": len(cameras),
            "stations": len({c.station for c in cameras}),
            "epochs": sum(c.epochs for c in cameras),
            "sound": sum(not c.findings for c in cameras),
            **{kind: counts[kind] for kind in _FINDINGS},
        },
    }


def fleet_lines(document: dict[str, Any]) -> list[str]:
    """Return the lines that `fleet` prints for a document."""
    cameras = document["cameras"]
    absent = [f"{name}: {_ABSENT}" for name in document["absent"]]
    if not cameras:
        return absent or ["no epochs there yet; stations send theirs with `thermocald forward`"]
    summary = document["summary"]
    head = ", ".join([f"{_title(summary)}: {summary['sound']} without findings", *_counts(summary)])
    lines = textwrap.wrap(head, _WIDTH)
    shown = [c for c in cameras if c["findings"]]
    shown += [c for c in cameras if not c["findings"]][:_MOST_WITHOUT]
    labels = _labels([_name(c) for c in shown], _LONGEST_NAME)
    name = max(14, *map(len, labels))
    heads = f"{'last':>7} {'waiting':>7} {'ok':>6} {'°C':>6} {'c µm/K':>16}"
    lines += ["", f"{'station/camera':<{name}} {heads}"]
    for camera, label in zip(shown, labels, strict=True):
        ok = "–" if camera["ok"] is None else percent(camera["ok"])
        lines.append(
            f"{label:<{name}} {short_duration(camera['lag_s']):>7} "
            f"{_known(camera['waiting'], 'd'):>7} {ok:>6} "
            f"{_known(camera['temperature'], '.1f'):>6} {_rate(camera, 'c'):>16}"
        )
        for finding in camera["findings"]:
            lines += textwrap.wrap(
                finding["text"],
                _WIDTH,
                initial_indent=f"  {finding['kind']}: ",
                subsequent_indent="      ",
            )
    if hidden := len(cameras) - len(shown):
        lines.append(f"and {hidden} more without findings (--json has them all)")
    for kind in document["types"]:
        rate = kind["rates"]["c"]
        lines += textwrap.wrap(
            f"type {kind['type']}: {len(kind['cameras'])} cameras, c {rate['value'] * 1e3:+.3f} ± "
            f"{rate['sd'] * 1e3:.3f} µm/K, between cameras ± {rate['sd_between'] * 1e3:.3f}",
            _WIDTH,
            subsequent_indent="  ",
        )
    return lines + absent


def _title(summary: Mapping[str, int]) -> str:
    return f"{counted(summary['cameras'], 'camera')} at {counted(summary['stations'], 'station')}"


def _counts(summary: Mapping[str, int]) -> list[str]:
    return [
        f"{summary[kind]} {words}" for kind, (_, words, _) in _FINDINGS.items() if summary[kind]
    ]


def _rate(camera: Mapping[str, Any], name: str) -> str:
    rate = camera["rates"].get(name)
    return f"{rate['value'] * 1e3:+.3f} ± {rate['sd'] * 1e3:.3f}" if rate else "–"


def _known(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def render_fleet(document: Mapping[str, Any]) -> str:
    """Return the page of a `fleet_document` as HTML text."""
    summary, cameras = document["summary"], document["cameras"]
    findings = tuple(
        (f"{_name(c)}, {_FINDINGS[f['kind']][0]}", f["text"])
        for c in cameras
        for f in c["findings"]
    ) + tuple((name, _ABSENT) for name in document["absent"])
    counts = _counts(summary)
    drawn = [
        (kind, [_drawing(f"type-{number}-{rate}", rate, kind, cameras) for rate in kind["rates"]])
        for number, kind in enumerate(document["types"])
    ]
    proof = drawn[0][1].pop(0) if drawn and drawn[0][1] else None
    title = _title(summary)
    answer = Answer(
        f"{summary['sound']} of {summary['cameras']} cameras have no finding"
        + (f"; {', '.join(counts)}." if counts else "."),
        proof=proof,
        next_steps=tuple(text for kind, (*_, text) in _FINDINGS.items() if summary[kind]),
        not_covered=(
            (
                "Rates are slopes of straight lines with their standard deviations, from epochs "
                "spread over all that a camera has measured: they compare specimens. A model for "
                "corrections is made by thermocald fit."
            ),
        ),
    )
    sections = [
        *([Section("Findings", items=findings)] if findings else []),
        Section("Cameras", tables=(_table(cameras),)),
        *(
            Section(f"Type {kind['type']}: {len(kind['cameras'])} cameras", figures=tuple(figures))
            for kind, figures in drawn
        ),
    ]
    about = (f"From {', '.join(document['servers'])}.",)
    return Chapter(title, answer, tuple(sections), about).page()


def _name(camera: Mapping[str, Any]) -> str:
    return f"{camera['station']}/{camera['camera']}"


def _table(cameras: Sequence[Mapping[str, Any]]) -> Table:
    def calibrated(camera: Mapping[str, Any]) -> str:
        low, high = camera["temperature_range"] or (math.nan, math.nan)
        return f"{low:.0f} … {high:.0f}" if math.isfinite(low) else "–"

    return Table.of(
        "Every camera",
        cameras,
        {
            "station": lambda c: c["station"],
            "camera": lambda c: c["camera"],
            "findings": lambda c: ", ".join(
                dict.fromkeys(_FINDINGS[f["kind"]][0] for f in c["findings"])
            ),
            "last epoch": lambda c: short_duration(c["lag_s"]),
            "on its way": lambda c: short_duration(c["on_the_way_s"]),
            "waiting": lambda c: _known(c["waiting"], "d"),
            "results": lambda c: "–" if c["ok"] is None else percent(c["ok"]),
            "°C now": lambda c: _known(c["temperature"], ".1f"),
            "°C calibrated": calibrated,
            "c µm/K": lambda c: _rate(c, "c"),
            "x₀ µm/K": lambda c: _rate(c, "x0"),
            "y₀ µm/K": lambda c: _rate(c, "y0"),
            "type": lambda c: str(c["type"]),
        },
    )


def _labels(names: Sequence[str], most: int) -> list[str]:
    """Shorten names to `most` letters, or to as many more as tell them apart."""
    for length in range(most, max(map(len, names))):
        labels = [shortened(name, length) for name in names]
        if len(set(labels)) == len(set(names)):
            return labels
    return list(names)


def _drawing(
    name: str, rate: str, kind: Mapping[str, Any], cameras: Sequence[Mapping[str, Any]]
) -> Figure:  # fmt: skip
    """Draw the rates of a type's specimens, in order, and the type's band."""
    specimens = sorted(
        (
            1e3 * c["rates"][rate]["value"],
            1e3 * BAND * c["rates"][rate]["sd"],
            _name(c),
            any(f["kind"] == "odd" for f in c["findings"]),
        )
        for c in cameras
        if _name(c) in kind["cameras"]
    )
    of_type = kind["rates"][rate]
    mean, spread = 1e3 * of_type["value"], 1e3 * BAND * of_type["sd_between"]
    labelled = len(specimens) <= _MOST_LABELLED
    with new_drawing(5.0, 0.9 + (0.2 if labelled else 0.05) * len(specimens)) as drawing:
        axis = drawing.subplots()
        axis.axvspan(mean - spread, mean + spread, color=PALETTE[0], alpha=0.12, lw=0)
        axis.axvline(mean, color=PALETTE[0], lw=1)
        for place, (value, half, _, odd) in enumerate(specimens):
            axis.errorbar(value, place, xerr=half, fmt="o", ms=3, lw=1.2,
                          color=PALETTE[1] if odd else "#333333")  # fmt: skip
        axis.set_yticks(
            range(len(specimens)) if labelled else [],
            _labels([specimen for *_, specimen, _ in specimens], 22) if labelled else [],
        )
        axis.grid(visible=False, axis="y")
        label_axes(axis, f"{parameter_label(rate)} in µm/K")
        if not labelled:
            label_axes(axis, y="cameras, lowest first")
    return Figure(
        name, f"{parameter_label(rate)} of each camera",
        "Bars and band: 95 %, of each camera and of the type; line: the type's mean; orange: "
        "unlike its type.", drawing=drawing,
    )  # fmt: skip
