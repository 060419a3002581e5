"""The reference, generated from the code: commands, configuration, effects, drivers, modules."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import typing
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import typer
    from pydantic import BaseModel

__all__ = ["GENERATORS", "api_pages", "commands", "packages"]

ROOTS = ("thermocald", "thermocald_drivers")


def packages() -> list[str]:
    """Return the names of the packages except `cli`: commands have a page of their own."""
    found = []
    for root in ROOTS:
        package = importlib.import_module(root)
        found.append(root)
        walked = pkgutil.walk_packages(package.__path__, f"{root}.")
        found += [m.name for m in walked if m.ispkg and m.name != "thermocald.cli"]
    return found


def api_pages() -> dict[str, str]:
    """Return {address: page} of the packages: their modules, for mkdocstrings."""
    pages = {}
    for name in packages():
        package = importlib.import_module(name)
        modules = [
            m.name
            for m in pkgutil.iter_modules(package.__path__)
            if not m.ispkg and not m.name.startswith("_")
        ]
        text = [f"# `{name}`", (inspect.getdoc(package) or "").strip()]
        text += [f"::: {name}.{module}" for module in modules]
        pages[f"reference/api/{name}.md"] = "\n\n".join(text) + "\n"
    return pages


# commands


def commands(app: typer.Typer | None = None, above: str = "thermocald") -> Iterator[Any]:
    """Yield (name, function) of every command, including those of groups."""
    if app is None:
        from thermocald.cli import application

        app = application()
    for command in app.registered_commands:
        callback = command.callback
        assert callback is not None
        yield f"{above} {command.name or callback.__name__.replace('_', '-')}", callback
    for group in app.registered_groups:
        assert group.typer_instance is not None
        name = group.name or group.typer_instance.info.name
        yield from commands(group.typer_instance, f"{above} {name}")


def _command_page() -> str:
    found = sorted(commands())
    parts = [" · ".join(f"[{name.split(' ', 1)[1]}](#{_anchor(name)})" for name, _ in found)]
    for name, function in found:
        text = inspect.getdoc(function) or ""
        text, *examples = text.split("Example: ")
        parts.append(f"## {name}\n\n{text.strip()}")
        if examples:
            parts.append("\n".join(["```text", *(" ".join(e.split()) for e in examples), "```"]))
        parts.append(_table(("argument or option", "value", "default", "meaning"), _rows(function)))
    return "\n\n".join(parts)


def _anchor(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower())


def _rows(function: Callable[..., Any]) -> Iterator[tuple[str, ...]]:
    hints = typing.get_type_hints(function, include_extras=True)
    for parameter in inspect.signature(function).parameters.values():
        kind, info, default = hints[parameter.name], parameter.default, parameter.default
        if typing.get_origin(kind) is typing.Annotated:
            kind, info = typing.get_args(kind)[:2]
            # with Annotated, the first name of an option is in the place of the default
            names = (info.default, *(info.param_decls or ()))
        else:
            default, names = info.default, info.param_decls or ()
        required = default in (inspect.Parameter.empty, ...)
        shown = "required" if required else f"`{default}`" if default else ""
        declared = [d for d in names if isinstance(d, str) and d.startswith("-")]
        if type(info).__name__ == "ArgumentInfo":
            declared = [info.metavar or parameter.name.upper()]
        elif not declared:
            option = "--" + parameter.name.replace("_", "-")
            flag = isinstance(default, bool)
            declared = [f"{option} / --no-{option[2:]}" if flag else option]
        label = ", ".join(f"`{d}`" for d in declared)
        meaning = f"(advanced) {info.help}" if info.rich_help_panel else info.help or ""
        yield label, _values(kind, info), shown, _cell(meaning)


def _values(kind: Any, info: Any) -> str:
    inner = [a for a in typing.get_args(kind) if a is not type(None)]
    if typing.get_origin(kind) is list:
        return f"{_values(inner[0], info)}, repeatable"
    if typing.get_origin(kind) is tuple:
        return " ".join(_values(part, info) for part in inner)
    if inner:
        return _values(inner[0], info)
    if kind is bool:
        return ""
    low, high = info.min, info.max
    words = {int: "integer", float: "number", Path: "path", str: "text"}
    name = words.get(kind, getattr(kind, "__name__", str(kind)))
    return name + _bounds(low, high)


def _bounds(low: Any, high: Any) -> str:
    if low is None and high is None:
        return ""
    if high is None:
        return f", at least {low:g}"
    most = f"{high:g}" if high < 1e6 else f"{high:,.0f}"
    return f", at most {most}" if low is None else f", {low:g} to {most}"


# configuration


def _configuration_page() -> str:
    from thermocald import config

    sections = [
        ("The file", config.Config),
        ("`cameras`, a list", config.CameraConfig),
        ("`thermometers`, a list", config.ThermometerConfig),
        ("`outputs`, a list", config.OutputConfig),
        ("`sensor` of a camera", config.SensorConfig),
        ("`calibration`", config.CalibrationConfig),
        ("`priors` of a calibration", config.Prior),
        ("`store`", config.StoreConfig),
        ("`frames`", config.FramesConfig),
        ("`dashboard`", config.DashboardConfig),
        ("`forward`", config.ForwardConfig),
        ("`logging`", config.LoggingConfig),
    ]
    parts = []
    for title, model in sections:
        about = (inspect.getdoc(model) or "").split("\n\n")[0]
        parts.append(f"### {title}\n\n{' '.join(about.split())}")
        parts.append(_table(("key", "value", "default", "meaning"), _keys(model)))
    return "\n\n".join(parts)


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Return {field: the text below it in the source}; a subclass has precedence."""
    found: dict[str, str] = {}
    for cls in model.__mro__:
        if not cls.__module__.startswith("thermocald"):
            continue
        (body,) = ast.parse(inspect.getsource(cls)).body
        assert isinstance(body, ast.ClassDef)
        for field, text in pairwise(body.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                found.setdefault(ast.unparse(field.target), ast.literal_eval(text.value))
    return found


def _keys(model: type[BaseModel]) -> Iterator[tuple[str, ...]]:
    texts = meanings(model)
    for name, row in zip(model.model_fields, _values_of(model), strict=True):
        yield *row, _cell(texts[name])


def _values_of(model: type[BaseModel]) -> Iterator[tuple[str, ...]]:
    """Yield (key, permitted values, default) of each key."""
    schema = model.model_json_schema(by_alias=True)
    for name, field in model.model_fields.items():
        key = field.alias or name
        if field.is_required():
            default = "required"
        else:
            value = field.get_default(call_default_factory=True, validated_data={})
            section = hasattr(type(value), "model_fields") or isinstance(value, dict) or value == ()
            default = "" if value is None or section else f"`{_yaml(value)}`"
        values = _schema(schema["properties"][key], schema.get("$defs", {}))
        yield f"`{key}`", values, default


def _yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(str, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _schema(part: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Return the permitted values in words."""
    if "anyOf" in part:
        kinds = [_schema(p, definitions) for p in part["anyOf"]]
        return " or ".join("null" if k == "null" else k for k in kinds)
    if "$ref" in part:
        return "see below"
    if "enum" in part:
        return ", ".join(f"`{v}`" for v in part["enum"])
    kind = part.get("type", "anything")
    if kind == "array":
        inner = _schema(part["items"], definitions)
        return f"list of {inner}" if inner != "see below" else "list, see below"
    if kind == "object":
        return "mapping"
    if part.get("format") == "path":
        return "path"
    words = {"number": "number", "integer": "integer", "boolean": "`true`, `false`"}
    low = part.get("minimum")
    high = part.get("maximum")
    above, below = part.get("exclusiveMinimum"), part.get("exclusiveMaximum")
    text = words.get(kind, {"string": "text"}.get(kind, kind))
    if above is not None:
        text += f" above {above:g}"
        if high is not None or below is not None:
            text += _bounds(None, high) if high is not None else f" and below {below:g}"
        return text
    return text + _bounds(low, high)


# effects and drivers


def _effect_page() -> str:
    from thermocald.physics import catalogue
    from thermocald.physics.effect import EXPERIMENTS

    parts = []
    for name in catalogue.names():
        effect = catalogue.get(name)
        parts.append(f"## `{name}`\n\n{_prose(type(effect))}")
        rows = [
            (
                f"`{key}`",
                p.unit,
                "a name" if p.text else f"searched from {p.low:g} to {p.high:g}",
                "belongs to one series" if key in effect.fresh else "",
            )
            for key, p in effect.nonlinear.items()
        ]
        usual = [f"`{key}` {effect.linear[key]}" for key in effect.usual if key in effect.linear]
        if rows:
            parts.append(_table(("parameter", "unit", "values", ""), iter(rows)))
        if effect.linear:
            others = [f"`{key}`" for key in effect.linear if key not in effect.usual]
            coefficients = f"Coefficients: {', '.join(usual)}"
            parts.append(coefficients + (f"; also {', '.join(others)}." if others else "."))
        behaviour = "\n".join(f"- {EXPERIMENTS[k]}: it {v}" for k, v in effect.behaviour.items())
        if behaviour:
            parts.append(f"How it differs from other effects:\n\n{behaviour}")
        parts.append(f"Kind: `{effect.kind}`.")
    return "\n\n".join(parts)


def _driver_page() -> str:
    from importlib.metadata import entry_points

    parts = []
    for kind in ("cameras", "thermometers", "outputs"):
        parts.append(f"## {kind.capitalize()}")
        points = [
            point
            for point in entry_points(group=f"thermocald.{kind}")
            if point.value.startswith("thermocald_drivers")
        ]
        points.sort(key=lambda point: (point.module, point.name))
        for module, group in groupby(points, key=lambda point: point.module):
            drivers = list(group)  # the drivers of one module share its text
            parts.append(f"### {', '.join(f'`{point.name}`' for point in drivers)}")
            parts.append(_prose(importlib.import_module(module)))
            for point in drivers:
                cls = point.load()
                parts.append(f"Options of `{point.name}`: {_prose(cls)}")
                parts.append(_table(("option", "value", "default"), _values_of(cls.Options)))
    return "\n\n".join(parts)


# Markdown


def _prose(documented: Any) -> str:
    """Return a docstring as Markdown, with its indented examples as code blocks."""
    lines, inside = [], False
    for line in (inspect.getdoc(documented) or "").splitlines():
        block = line.startswith("    ")
        if block and not inside:
            lines.append("```yaml")
        elif inside and line.strip() and not block:
            while lines[-1] == "":
                lines.pop()
            lines += ["```", ""]
        inside = block or (inside and not line.strip())
        lines.append(line[4:] if block else line)
    if inside:
        lines.append("```")
    return "\n".join(lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _table(head: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines)


# the public names


def _python_page() -> str:
    import thermocald

    functions = [n for n in thermocald.__all__ if n[0].islower()]
    nouns = [n for n in thermocald.__all__ if n[0].isupper()]
    parts = ["## Functions"]
    parts += [_public(name, getattr(thermocald, name), "###") for name in functions]
    parts.append("## Classes")
    for name in nouns:
        noun = getattr(thermocald, name)
        parts.append(_public(name, noun, "###"))
        parts += [
            _public(f"{name}.{member}", value, "####")
            for member, value in inspect.getmembers(noun)
            if not member.startswith("_") and inspect.getdoc(value) and _is_own(noun, member)
        ]
    return "\n\n".join(parts)


def _is_own(noun: type, member: str) -> bool:
    """Return whether a member is a method or a property that a class of ours defines."""
    for base in noun.__mro__:
        if member in vars(base):
            value = vars(base)[member]
            return base.__module__.startswith("thermocald") and (
                callable(value) or isinstance(value, property | classmethod)
                or hasattr(value, "func")
            )  # fmt: skip
    return False


def _public(name: str, value: Any, level: str) -> str:
    """Return a heading, the signature of a callable, and the docstring with its examples."""
    text = [f"{level} `{name}`"]
    if callable(value) and not isinstance(value, type):
        signature = inspect.signature(value)
        taken = [p for p in map(str, signature.parameters.values()) if p != "self"]
        written = f"({', '.join(taken)}) -> {signature.return_annotation}"
        if len(written) > 70:
            written = written.replace(", ".join(taken), "\n    " + ",\n    ".join(taken) + ",\n")
        written = written.replace("'", "")
        text.append(f"```text\n{name.rsplit('.', 1)[-1]}{written}\n```")
    if hasattr(value, "func"):  # a cached property
        value = value.func
    docstring = (inspect.getdoc(value) or "").strip()
    plain, mark, example = docstring.partition("\n>>> ")
    text.append(plain)
    if mark:
        text.append(f"```pycon\n>>> {example}\n```")
    return "\n\n".join(text)


GENERATORS: dict[str, Callable[[], str]] = {
    "reference/cli.md": _command_page,
    "reference/python.md": _python_page,
    "reference/config.md": _configuration_page,
    "reference/effects.md": _effect_page,
    "reference/drivers.md": _driver_page,
}
"""{page: the function that returns its generated part}."""
