"""From recordings to a camera of ROS at 10 and 40 °C."""

import sys
from pathlib import Path

import thermocald as tc


def main(recordings: list[str], folder: Path) -> None:
    series: list[tc.Series] = [tc.open(name) for name in recordings]
    epochs: tc.Epochs = series[0].calibrate()
    change, sd = 1000 * (epochs.c[-1] - epochs.c[0]), 1000 * epochs.sd_c[0]
    print(f"{len(epochs)} epochs, c changed by {change:.1f} ± {sd:.1f} µm")
    camera: tc.ThermalCamera = tc.fit(*series)
    for temperature in (10.0, 40.0):
        now: tc.Camera = camera.at(temperature, extrapolate=True)
        now.write(folder / f"ros-{temperature:.0f}.yaml", "ros")
        print(now, f"± {now.object_error(10_000.0).max():.2f} mm at 10 m")


main(sys.argv[1:-1], Path(sys.argv[-1]))
