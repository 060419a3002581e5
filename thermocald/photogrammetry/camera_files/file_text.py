"""Numbers and YAML in the text of a camera file; what is wrong there is an error that names it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from thermocald.errors import ConfigurationError

if TYPE_CHECKING:
    from thermocald.arrays import Array


def yaml_document(text: str, loader: type[yaml.SafeLoader] = yaml.SafeLoader) -> Any:
    """What a YAML text holds; ConfigurationError for a text that is not YAML."""
    try:
        return yaml.load(text, loader)
    except (yaml.YAMLError, ValueError) as cause:
        raise ConfigurationError(f"no valid YAML: {str(cause).splitlines()[0]}") from None


def yaml_text(document: dict[str, Any]) -> str:
    """A document as YAML, one line for each list of numbers."""
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10_000)


def number(value: Any, what: str) -> float:
    """A finite number, or an error that names it."""
    try:
        result = float(value)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{what} is {value!r}, not a number") from None
    except OverflowError:
        raise ConfigurationError(f"{what} is too large a number") from None
    if not math.isfinite(result):
        raise ConfigurationError(f"{what} is {value!r}, not a finite number")
    return result


def numbers(values: Any, what: str, counts: tuple[int, ...]) -> Array:
    """A list of finite numbers of one of some lengths, or an error that names it."""
    if not isinstance(values, list | tuple | np.ndarray):
        raise ConfigurationError(f"{what} is missing or no list")
    result = np.array([number(v, what) for v in np.ravel(np.asarray(values, dtype=object))])
    if len(result) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ConfigurationError(f"{what} has {len(result)} numbers, not {wanted}")
    return result
