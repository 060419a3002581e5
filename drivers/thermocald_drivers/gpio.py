"""A status LED and a heating relay on the Raspberry Pi's GPIO pins, through gpiozero.

    outputs:
      - {name: status, driver: led, pin: 17, blink_s: 0.25}   # BCM number
      - name: lamp
        driver: relay
        pin: 27
        active_high: false                         # most relay boards switch on at a low level
        limit_c: 60
        watchdog_s: 30                             # without an epoch for this long: off
        unknown_s: 60                              # without a temperature for this long: off
        channel: temperature                       # the column of the epoch's result
        hysteresis_k: 0.5
        programme: [{seconds: 600, hold_c: null}, {seconds: 1500, hold_c: 45}]

The LED is steady while epochs have results and blinks while they have none.

The relay is fail-safe. It is off before the first result and after the last step, once the limit
was reached (until the configuration is reloaded), without a temperature for `unknown_s`, without a
result for `watchdog_s`, and while closed. The kernel releases the pins of a process that crashes:
wire the relay so that a released pin switches it off. See `heating` for the programme.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from thermocald.errors import DeviceDenied, DeviceNotFound
from thermocald.hal import DriverOptions, Output
from thermocald.names import WITH_VALUES
from thermocald_drivers import support
from thermocald_drivers.heating import HeatingOptions, HeatingOutput

if TYPE_CHECKING:
    from collections.abc import Mapping

GPIO_CLASSES = ("char-gpiochip",)
"""/dev/gpiochipN, which gpiozero opens through lgpio."""

log = logging.getLogger(__name__)


class PinOptions(DriverOptions):
    """A pin, given by its BCM number."""

    pin: Annotated[int, Field(ge=0, le=53)]
    active_high: bool = True


def _pin(kind: str, options: PinOptions) -> Any:
    """Return a gpiozero device; raises its errors as DeviceErrors."""
    pin = options.pin
    gpiozero = support.library("gpiozero", "gpio")
    try:
        return getattr(gpiozero, kind)(pin, active_high=options.active_high, initial_value=False)
    except gpiozero.BadPinFactory as error:
        raise DeviceNotFound(f"GPIO {pin}: this machine has no usable pins ({error})") from error
    except gpiozero.GPIOPinInUse as error:
        raise DeviceDenied(f"GPIO {pin}: in use ({error})") from error
    except gpiozero.PinError as error:
        raise DeviceNotFound(f"GPIO {pin}: {error}") from error
    except OSError as error:
        hint = "check that the user is in the group gpio"
        raise support.fault(error, f"GPIO {pin}", seen=False, hint=hint) from error


class LedOutput(Output):
    """An LED: steady while epochs have results, blinking while they have none, off while closed."""

    device_classes = GPIO_CLASSES

    class Options(PinOptions):
        blink_s: Annotated[float, Field(ge=0.05, le=10.0)] = 0.25

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.where = f"LED at GPIO {self.options.pin}"

    def open(self) -> None:
        self.handle = _pin("LED", self.options)
        self._good: bool | None = None

    def close(self) -> None:
        if self.handle is not None:
            self.handle.off()
        super().close()

    def emit(self, result: Mapping[str, Any]) -> None:
        led = self.opened()
        good = result.get("status") in WITH_VALUES
        if good == self._good:
            return  # restarting the blinking at each epoch would hide it
        self._good = good
        if good:
            led.on()
        else:
            led.blink(on_time=self.options.blink_s, off_time=self.options.blink_s, background=True)


class RelayOutput(HeatingOutput):
    """A relay that heats by a programme; the module's docstring lists when it is off."""

    device_classes = GPIO_CLASSES

    class Options(HeatingOptions, PinOptions):
        watchdog_s: Annotated[float, Field(ge=0.05, le=3600.0)] = 30.0
        channel: support.Text = "temperature"

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.channel = self.options.channel
        self.where = f"relay at GPIO {self.options.pin}"
        self._lock = threading.Lock()
        self._watchdog: threading.Timer | None = None

    def open(self) -> None:
        self.handle = _pin("DigitalOutputDevice", self.options)
        self.begin()

    def close(self) -> None:
        self._stop_watchdog()
        with self._lock:
            if self.handle is not None:
                self.handle.off()
            super().close()

    def measure(self, result: Mapping[str, Any]) -> float:
        self._stop_watchdog()
        return support.number_or_nan(result.get(self.channel))

    def switch(self, heat: bool) -> None:
        with self._lock:
            self.opened().value = heat
        if heat:
            self._watchdog = threading.Timer(self.options.watchdog_s, self._starve)
            self._watchdog.daemon = True
            self._watchdog.start()

    def _stop_watchdog(self) -> None:
        watchdog, self._watchdog = self._watchdog, None
        if watchdog is not None:
            watchdog.cancel()
            watchdog.join()

    def _starve(self) -> None:
        """Switch off until the next result, after `watchdog_s` without one."""
        with self._lock:
            if self.handle is not None:
                self.handle.off()
                self.heating = False
        log.warning("%s: switched off, no result for %g s", self.where, self.options.watchdog_s)
