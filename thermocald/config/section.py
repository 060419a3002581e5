"""What every part of the configuration shares: its base, types of values, errors in words."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, model_validator
from pydantic_core import PydanticCustomError

from thermocald.addresses import without_secrets

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Period = Annotated[float, Field(ge=0.05, le=86400.0)]
Positive = Annotated[float, Field(gt=0.0, le=1e9)]


def relative_to_file(value: Path | None, info: ValidationInfo) -> Path | None:
    """A path of the file, which is relative to its folder."""
    if value is None:
        return None
    folder: Path = (info.context or {}).get("folder", Path())
    return folder / value.expanduser()


class Section(BaseModel):
    """A part of the file: immutable, finite numbers, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _suggest(cls, data: Any) -> Any:
        if isinstance(data, dict) and cls.model_config["extra"] == "forbid":
            for key in data:
                if key not in cls.model_fields:
                    raise _unknown(str(key), list(cls.model_fields))
        return data


def keys(section: type[Section]) -> list[str]:
    """The keys of a section as the file spells them."""
    return [field.alias or name for name, field in section.model_fields.items()]


def wrong(message: str) -> PydanticCustomError:
    """An error of ours, for a validator."""
    return PydanticCustomError("thermocald", "{message}", {"message": message})


def _unknown(key: str, known: list[str]) -> PydanticCustomError:
    return PydanticCustomError(
        "unknown_key", "{message}", {"message": f"unknown{nearest(key, known)}", "key": key}
    )


def nearest(key: str, known: list[str]) -> str:
    """The end of a message: which known key is meant, or which there are."""
    near = difflib.get_close_matches(key, known, 1, 0.5)
    return f"; is {near[0]!r} meant?" if near else f"; known are: {', '.join(known) or 'none'}"


def in_words(path: Path | str, error: ValidationError) -> str:
    """The first error, as file or place (or none), dotted key, value and what is allowed."""
    first = error.errors()[0]
    where = "".join(
        f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]
    ).lstrip(".")
    place = f"{path}: " if str(path) else ""
    context = first.get("ctx", {})
    if first["type"] == "unknown_key":
        where = f"{where}.{context['key']}".lstrip(".")
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    message = without_secrets(first["msg"])
    if first["type"] == "missing":
        return f"{place}{where}: is missing{more}"
    if first["type"] == "value_error":  # of a check that is shared with others
        return f"{place}{where + ': ' if where else ''}{context['error']}{more}"
    if first["type"] in ("thermocald", "unknown_key"):
        return f"{place}{where + ': ' if where else ''}{message}{more}"
    message = message[0].lower() + message[1:]
    return f"{place}{where}: is {_short(first['input'])}; {message}{more}"


def _short(value: Any) -> str:
    text = without_secrets(repr(value))
    return text if len(text) <= 60 else f"{text[:57]}…"
