"""The page of code: a tick, a series, a discovery, an effect and a driver, from the source."""

from __future__ import annotations

import inspect
import pkgutil
import textwrap
from pathlib import Path

__all__ = ["PAGES", "page"]

REPOSITORY = Path(__file__).resolve().parents[2]
PAGES = {
    "A tick": (
        (
            "A camera's thread passes a frame on; it is paired with the nearest readings, measured "
            "and adjusted, and the epochs are stored in the order of the frames."
        ),
        "thermocald.acquisition.pipeline:Pipeline.submit",
        "thermocald.acquisition.pipeline:calibrate_frame",
    ),
    "A series": (
        "All epochs are adjusted together, after the data have decided how the camera moved.",
        "thermocald.photogrammetry.series.adjustment:adjust_series",
        "thermocald.photogrammetry.series.adjustment:adjusted",
    ),
    "A discovery": (
        (
            "First moved targets and the measuring noise are determined. Then the search adds "
            "effects while they gain more than their penalty, and removes those that no longer do."
        ),
        "thermocald.discovery.examination:examine_series",
        "thermocald.discovery.search:Search.expand",
        "thermocald.discovery.search:Search.shrink",
    ),
    "An effect": (
        (
            "One class, used forward in the simulation, as columns of a fit, and as words in a "
            "report. Everything in which effects differ is in these classes."
        ),
        "thermocald.physics.effects.heat:ThermalLag",
    ),
    "A driver": (
        (
            "One class for one interface of the HAL. It returns what the hardware reported, with "
            "the time, or raises an error whose type tells whether a retry can help."
        ),
        "thermocald_drivers.i2c:Tmp117Thermometer",
    ),
}
"""{title: (introduction, names of the functions and classes to show …)}."""


def page() -> str:
    """Return the title, the introduction and the source of each of PAGES."""
    parts = []
    for title, (sentence, *names) in PAGES.items():
        parts += [f"## {title}", sentence]
        for name in names:
            found = pkgutil.resolve_name(name)
            file = Path(inspect.getsourcefile(found) or "").resolve().relative_to(REPOSITORY)
            code = textwrap.dedent(inspect.getsource(found)).rstrip()
            parts += [f"`{file.as_posix()}`", f"```python\n{code}\n```"]
    return "\n\n".join(parts)
