"""Writes the tables of docs/bench-file.md, between its two markers, from the models that check a bench file.

Run it after a change of a config.py: `.venv/bin/python docs/make_bench_reference.py`. A test holds the page up to date.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softloop.deploy.bench import PROCESS_NAMES, Bench
from softloop.devices.protocols.wt931 import BANDWIDTH_CODES, BAUD_CODES, RATE_CODES

PAGE = Path(__file__).with_name("bench-file.md")
BEGIN = "<!-- begin: tables, written by docs/make_bench_reference.py -->"
END = "<!-- end: tables -->"
NONE = "-"

# The unit of a key whose name does not end in it.
UNITS = {
    "bitrate": "bit/s", "baud": "bit/s", "configure_baud": "bit/s", "k_s": "1/s", "k1": "1/s", "k2": "1/s",
    "pressure_gain": "1/s", "epsilon1": "(deg/s)2/s", "epsilon2": "kPa2/s", "delta1": "deg/s2", "delta2": "kPa/s",
    "kp": "kPa/deg", "ki": "kPa/(deg s)", "kd": "kPa s/deg", "kv": "kPa s/deg", "ka": "kPa s2/deg",
}  # fmt: skip
# Endings of names, the longer ones first.
ENDINGS = {
    "_deg_s2": "deg/s2", "_kpa_s": "kPa/s", "_deg_s": "deg/s", "_ma_per_tick": "mA per tick", "_ticks": "ticks of 5 ms",
    "_kpa": "kPa", "_deg": "deg", "_kib": "KiB", "_mib": "MiB", "_ma": "mA", "_hz": "Hz", "_ms": "ms", "_us": "us",
    "_s": "s", "_v": "V", "_ppm": "ppm",
}  # fmt: skip
TYPES = {
    "string": "text",
    "integer": "whole number",
    "number": "number",
    "boolean": "true or false",
    "object": "table",
    "array": "list",
}
# Keys whose values a model's own check holds to what the WT931 can do.
DEVICE_TABLES = ("InclinometerConfig", "PlantConfig")
DEVICE_CODES = {"baud": BAUD_CODES, "configure_baud": BAUD_CODES, "rate_hz": RATE_CODES, "bandwidth_hz": BANDWIDTH_CODES}


@dataclass
class Section:
    """One table of the page: the headings of all tables that share it, what it is, and its keys."""

    headings: list[str]
    text: str
    rows: list[str]


def render() -> str:
    """What stands between the markers."""
    schema = Bench.model_json_schema()
    parts = [_overview(schema)]
    for section in _all_sections(schema):
        parts.append(f"### {', '.join(section.headings)}")
        parts += [section.text] if section.text else []
        parts.append("\n".join(_head("key", "type", "default", "unit", "allowed", "meaning") + section.rows))
    return "\n\n".join(parts)


def updated(page: str) -> str:
    """The page with its tables written anew. Raises ValueError when a marker is missing."""
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n\n{render()}\n\n{END}{after}"


def _overview(schema: dict[str, Any]) -> str:
    rows = []
    for name, given in schema["properties"].items():
        model, heading = _table_in(given, name)
        if model:
            runs = f"process `{name}`" if name in PROCESS_NAMES else "settings; may be left out"
            rows.append(_row(f"`{heading}`", runs, _first_line(schema["$defs"][model])))
    return "\n".join(_head("table", "makes run", "what it is about") + rows)


def _all_sections(schema: dict[str, Any]) -> Iterator[Section]:
    yield Section(["Top of the file"], "", _rows("Bench", schema))
    for name, given in schema["properties"].items():
        model, heading = _table_in(given, name)
        if model:
            yield from _sections(schema, model, heading, heading.strip("[]"))


def _sections(schema: dict[str, Any], model: str, heading: str, path: str) -> Iterator[Section]:
    """A table and those inside it; tables of one kind beside each other share a section."""
    body = schema["$defs"][model]
    yield Section([f"`{heading}`"], _first_line(body), _rows(model, body))
    inner: dict[str, Section] = {}
    for name, given in body["properties"].items():
        found, sub = _table_in(given, f"{path}.{name}")
        if found in inner:
            inner[found].headings.append(f"`{sub}`")
        elif found:
            inner[found] = next(_sections(schema, found, sub, f"{path}.{name}"))
            inner[found].text += f" At most {given['maxItems']}." if "maxItems" in given else ""
    yield from inner.values()


def _rows(model: str, body: dict[str, Any]) -> list[str]:
    rows = []
    for name, given in body["properties"].items():
        if _table_in(given, name)[0]:
            continue
        default = "required" if name in body.get("required", []) else _value(given.get("default", {}))
        meaning = given.get("description", "")
        rows.append(_row(f"`{name}`", _type(given), default, unit(name), _allowed(model, name, given), meaning))
    return rows


def _table_in(given: dict[str, Any], path: str) -> tuple[str, str]:
    """(model, heading) of a key that is a table, or empty texts."""
    kinds = [
        (given, f"[{path}]"),
        (given.get("additionalProperties"), f"[{path}.NAME]"),
        (given.get("items"), f"[[{path}]]"),
        *((option, f"[{path}]") for option in given.get("anyOf", [])),
    ]
    for inner, heading in kinds:
        if isinstance(inner, dict) and "$ref" in inner:
            return inner["$ref"].rsplit("/", 1)[1], heading
    return "", ""


def _first_line(body: dict[str, Any]) -> str:
    """The first paragraph of a model's docstring, without the table's name in front."""
    text = " ".join(body.get("description", "").split("\n\n")[0].split())
    if text.startswith("`["):
        text = text.split("`", 2)[2].lstrip(":. ")
    return text[:1].upper() + text[1:]


def _type(given: dict[str, Any]) -> str:
    options = given.get("anyOf", [given])
    return " or ".join(TYPES[option["type"]] for option in options if option["type"] != "null")


def unit(name: str) -> str:
    """The unit of a key, from its name."""
    return UNITS.get(name) or next((text for end, text in ENDINGS.items() if name.endswith(end)), NONE)


def _allowed(model: str, name: str, given: dict[str, Any]) -> str:
    if model in DEVICE_TABLES and name in DEVICE_CODES:
        return ", ".join(map(str, DEVICE_CODES[name]))
    if "enum" in given:
        return ", ".join(_value(value) for value in given["enum"])
    if "minimum" in given and "maximum" in given:
        return f"{_number(given['minimum'])} to {_number(given['maximum'])}"
    words = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    found = [f"{word} {_number(given[key])}" for key, word in words.items() if key in given]
    found += [f"matches `{given['pattern']}`"] if "pattern" in given else []
    found += ["not empty"] if given.get("minLength") else []
    return ", ".join(found) or NONE


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else str(value)


def _value(value: Any) -> str:
    """As it is written in the file; a key that is not set has none."""
    return NONE if value is None else f"`{json.dumps(value)}`"


def _head(*titles: str) -> list[str]:
    return [_row(*titles), "|" + "---|" * len(titles)]


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
