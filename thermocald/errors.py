"""The errors that thermocald raises; every message says what is wrong, where, and what to do.

    ThermocaldError
     ├── UsageError (ValueError)              exit 2: wrong usage
     │    ├── ConfigurationError              exit 2: config.yaml, camera, model or programme file
     │    └── OutputError                     exit 2, or 3 if the disk is full or fails
     ├── DataError (ValueError)               exit 1: the data do not allow what was asked
     │    ├── RecordingError                  a recording is broken
     │    ├── TestFieldError                  a test field is broken
     │    ├── ImageError                      an image cannot be read or used
     │    ├── StoreError                      a store is broken, foreign, or cannot be written
     │    │    ├── StoreBusyError             another program keeps it locked
     │    │    ├── StoreFullError             the disk has no room for it
     │    │    ├── StoreVersionError          a store of a newer program
     │    │    └── ServerError                a server refused a request: a person must act
     │    │         └── ServerGone (ConnectionError)  out of reach; may pass
     │    └── GeometryError                   the geometry is too weak for what was asked
     └── DeviceError (OSError)                exit 3: a device failed
          ├── TransientDeviceError            may pass: the daemon retries with back-off
          │    ├── DeviceTimeout (TimeoutError)
          │    ├── DeviceGone (ConnectionError)     unplugged, offline
          │    └── BadReading                       truncated frame, CRC error, garbage
          └── PermanentDeviceError            retrying cannot help: a person must act
               ├── DeviceNotFound                   no such device
               ├── DeviceDenied (PermissionError)   no permission, unauthorized, permanently busy
               ├── WrongDevice                      identity, size or capability does not fit
               ├── DriverMissing                    an optional library is not installed
               └── DeviceFinished                   no more data will come, which is no fault

An error is also the built-in exception in parentheses.
"""

from __future__ import annotations


class ThermocaldError(Exception):
    """The base class of thermocald's errors; `exit_status` is that of CONVENTIONS §4."""

    exit_status = 1


class UsageError(ThermocaldError, ValueError):
    """A command or a function was used wrongly."""

    exit_status = 2


class ConfigurationError(UsageError):
    """A configuration, camera, model or programme file is wrong."""


class OutputError(UsageError):
    """A file cannot be written; exit status 2 if another place helps, 3 if the disk fails."""

    def __init__(self, message: str, exit_status: int = 2) -> None:
        super().__init__(message)
        self.exit_status = exit_status


class DataError(ThermocaldError, ValueError):
    """The data do not allow what was asked."""


class RecordingError(DataError):
    """A recording is broken; the message names file, row and column."""


class TestFieldError(DataError):
    """A test field is broken or does not fit the observations."""

    __test__ = False  # pytest collects classes by their name


class ImageError(DataError):
    """An image cannot be read, or is not what the camera gives."""


class StoreError(DataError):
    """A store is broken, foreign, or cannot be written."""


class StoreBusyError(StoreError):
    """Another program keeps the store locked; this may pass."""


class StoreFullError(StoreError):
    """The disk is full; what was stored before is not lost."""

    exit_status = 3


class StoreVersionError(StoreError):
    """A store was written by a newer program, or by one that was never published."""


class ServerError(StoreError):
    """A server refused a request; a person must act.

    about_values: whether it refused a row's values, and not the connection or the role.
    """

    about_values = False


class ServerGone(ServerError, ConnectionError):
    """A server is out of reach, full or restarting; this may pass by itself."""


class GeometryError(DataError):
    """The geometry is too weak for what was asked."""


class DeviceError(ThermocaldError, OSError):
    """A device failed."""

    exit_status = 3


class TransientDeviceError(DeviceError):
    """A fault that may pass by itself; the daemon retries with back-off."""


class DeviceTimeout(TransientDeviceError, TimeoutError):
    """The device did not answer in time."""


class DeviceGone(TransientDeviceError, ConnectionError):
    """The device was there and has disappeared."""


class BadReading(TransientDeviceError):
    """The device answered, but not with a usable frame or value."""


class PermanentDeviceError(DeviceError):
    """A fault that retrying cannot mend."""


class DeviceNotFound(PermanentDeviceError):
    """There is no such device."""


class DeviceDenied(PermanentDeviceError, PermissionError):
    """The device is there but may not be used."""


class WrongDevice(PermanentDeviceError):
    """Something else is attached, or it cannot do what is configured."""


class DriverMissing(PermanentDeviceError):
    """An optional library that the driver needs is not installed."""


class DeviceFinished(PermanentDeviceError):
    """The device has delivered all its data, such as a recording played to its end."""
