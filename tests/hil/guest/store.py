"""Print the content of the daemon's store as a line of JSON, with the numbers on its frames.

store.py [DATABASE]
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

sys.path.insert(0, "/mnt/host")

HOME = Path("/var/lib/thermocald")


def number_on(frame):
    """Return the number in the bars of a stored frame, or None without a frame."""
    import cv2
    from tests_hil.bars import number_of

    if frame is None:
        return None
    path = frame if Path(frame).is_absolute() else HOME / "frames" / frame
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return None if image is None else number_of(image)


def plain(value):
    return value if value is None or not isinstance(value, float) or math.isfinite(value) else None


def main():
    from thermocald.store.database.store import Store

    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HOME / "store/thermocald.db"
    found = {"series": {}, "events": []}
    with Store.open(path) as store:
        assert store.examine().damaged == ()
        for series in store.all_series():
            found["series"][series.camera] = [
                {
                    "number": e.epoch.number,
                    "frame_time": e.epoch.frame_time,
                    "temperature_time": plain(e.epoch.temperature_time),
                    "temperatures": {k: plain(v) for k, v in e.epoch.temperatures.items()},
                    "status": None if e.result is None else e.result.status,
                    "values": None if e.result is None else [plain(v) for v in e.result.values],
                    "clock_trusted": e.clock_trusted,
                    "frame": number_on(e.epoch.frame) if series.camera == "river" else None,
                    "note": e.epoch.note,
                }
                for e in store.epochs(series)
            ]
        found["events"] = [{"utc": e.utc, "kind": e.kind, "text": e.text} for e in store.events()]
    print(json.dumps(found))


main()
