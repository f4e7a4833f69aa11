"""Reading TOML files into pydantic models with errors that name file, key and what is allowed."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from softloop.wire.errors import BadConfig, BadFile


class Table(BaseModel):
    """Base of every table of a bench or parameter file: unknown keys are errors, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ProcessTable(Table):
    """Base of the tables that make a process run."""

    host: str = Field("", description="which [hosts.NAME] it runs on; empty: a bench of one host")


T = TypeVar("T", bound=BaseModel)
MAX_DEPTH = 50


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file. Raises BadFile with one line that says what is wrong and where."""
    try:
        return _shallow(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise BadFile(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise BadFile(f"{path}: not UTF-8 text (byte {error.start})") from None
    except ValueError as error:  # TOMLDecodeError is one, and so is a number of more digits than Python reads
        raise BadFile(f"{path}: not valid TOML: {error}") from None
    except RecursionError:
        raise BadFile(f"{path}: not read: its tables or lists stand too deep in each other") from None


def _shallow(content: dict[str, Any]) -> dict[str, Any]:
    """The content as it is. Raises RecursionError where what reads it on would run out of stack."""
    level: list[Any] = [content]
    for _ in range(MAX_DEPTH):
        tables = [value.values() if isinstance(value, dict) else value for value in level if isinstance(value, dict | list)]
        level = [inner for values in tables for inner in values]
    if level:
        raise RecursionError
    return content


def load_model(model: type[T], content: dict[str, Any], path: Path | str) -> T:
    """Validate `content` as `model`. Raises BadConfig: one line with file, key, fault and the allowed values."""
    try:
        return validated(model, content)
    except ValidationError as error:
        raise BadConfig(f"{path}: {'; '.join(_say(model, e) for e in _own_errors(error)[:3])}") from None


def validated(model: type[T], content: dict[str, Any]) -> T:
    """Validate TOML's content as it stands: a number in quotes is not a number. Raises pydantic's ValidationError.

    By way of JSON, whose strict mode takes an array for a tuple and a whole number for a float, as TOML means them.
    """
    return model.model_validate_json(json.dumps(content, default=str), strict=True)


def _own_errors(error: ValidationError) -> list[Any]:
    """The errors without those that only follow: a list whose entries are refused has too few of them."""
    errors: list[Any] = error.errors()
    refused = [e["loc"] for e in errors]
    return [e for e in errors if e["type"] != "too_short" or not any(_within(loc, e["loc"]) for loc in refused)]


def _within(inner: tuple[Any, ...], outer: tuple[Any, ...]) -> bool:
    return len(inner) > len(outer) and inner[: len(outer)] == outer


def _say(model: type[BaseModel], error: Any) -> str:
    where = [str(p) for p in error["loc"]]
    name = ".".join(where) or "(file)"
    if error["type"] == "extra_forbidden":
        return f"unknown key '{name}'; allowed here: {', '.join(_allowed(model, where[:-1]))}"
    if error["type"] == "missing":
        return f"key '{name}' is missing"
    shown = repr(error.get("input"))
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    what = " ".join(error["msg"].removeprefix("Value error, ").split())  # a value in it may hold what ends a line
    return f"key '{name}': {what} (got {shown})"


def _allowed(model: type[BaseModel], where: list[str]) -> list[str]:
    current: Any = model
    for part in where:
        field = current.model_fields.get(part) if isinstance(current, type) and issubclass(current, BaseModel) else None
        current = _model_in(field.annotation) if field else _model_in(current)
    return sorted(current.model_fields) if isinstance(current, type) and issubclass(current, BaseModel) else ["(nothing)"]


def _model_in(annotation: Any) -> Any:
    """The pydantic model inside an annotation such as `X | None`, `list[X]` or `dict[str, X]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        found = _model_in(inner)
        if found is not None:
            return found
    return None
