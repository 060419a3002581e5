"""Reading YAML files written by hand: one clear error, no key twice, no code run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import yaml

from thermocald.errors import ConfigurationError, ThermocaldError

if TYPE_CHECKING:
    from collections.abc import Hashable
    from pathlib import Path


_MOST_VALUES = 100_000
_MOST_BYTES = 20_000_000
_DEEPEST = 60

# What PyYAML's constructors let through on hostile scalars (`!!bool x`, `!!int ""`, 2020-99-99).
_CONSTRUCTION = (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, which also refuses a key that is duplicated."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"key {key.value!r} is duplicated", key.start_mark
                    )
                seen.add(key.value)
        mapping: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return mapping


def read_yaml(path: Path, error: type[ThermocaldError] = ConfigurationError) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises `error`, naming the file and where there is one the line, if the file is missing, is no
    YAML, holds a key twice, or holds something else than a mapping with text keys.
    """
    try:
        if path.exists() and not path.is_file():
            raise error(f"{path}: is not a file")
        if path.exists() and path.stat().st_size > _MOST_BYTES:
            raise error(f"{path}: is larger than {_MOST_BYTES // 1_000_000} MB")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as cause:
        what = cause.strerror if isinstance(cause, OSError) else "is not UTF-8 text"
        raise error(f"{path}: cannot be read: {what}") from cause
    try:
        if _is_too_deep(text):
            raise error(f"{path}: is nested deeper than {_DEEPEST} levels")
        document = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as cause:
        mark = cause.problem_mark
        where = "" if mark is None else f", line {mark.line + 1}, column {mark.column + 1}"
        raise error(f"{path}{where}: {cause.problem or cause.context}") from cause
    except yaml.YAMLError as cause:
        raise error(f"{path}: is no YAML: {' '.join(str(cause).split())}") from cause
    except RecursionError as cause:
        raise error(f"{path}: is nested too deeply") from cause
    except _CONSTRUCTION as cause:
        raise error(f"{path}: holds a value that is no YAML: {cause}") from cause
    if document is None:
        raise error(f"{path}: is empty")
    if not isinstance(document, dict):
        raise error(f"{path}: must hold `key: value` lines, not a {type(document).__name__}")
    for key in document:
        if not isinstance(key, str):
            raise error(f"{path}: key {key!r} must be text")
    if _is_too_large(document):
        raise error(f"{path}: holds more than {_MOST_VALUES} values, or aliases without end")
    return document


def _is_too_deep(text: str) -> bool:
    """Whether lists and mappings are nested so deep that building them would exhaust the stack."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _DEEPEST:
                return True
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
    return False


def _is_too_large(document: dict[str, Any]) -> bool:
    """A few aliases (`*a`) can stand for billions of values, or for themselves."""
    left, waiting = _MOST_VALUES, [document]
    while waiting and left > 0:
        value: Any = waiting.pop()
        left -= 1
        if isinstance(value, dict | list):
            waiting.extend(value.values() if isinstance(value, dict) else value)
    return left <= 0


def dump_yaml(document: dict[str, Any]) -> str:
    """YAML text that keeps the order of the keys and writes short mappings on one line."""
    text: str = yaml.safe_dump(
        document, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )
    return text
