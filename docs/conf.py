"""Sphinx: `make docs`. Warnings are errors. The reference pages are written here, from the command line and the messages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from softloop.deploy.cli import app as command_line
from softloop.wire.channels import CHANNELS, FAULT
from softloop.wire.messages import MSG_DIR, message_names

HERE = Path(__file__).resolve().parent
GENERATED = HERE / "generated"

project = "softloop"
author = "the softloop authors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = "softloop"
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath", "amsmath"]
suppress_warnings = ["myst.xref_missing"]  # links out of the documentation, such as ../README.md, stand as they are
exclude_patterns = ["_build"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
html_show_sphinx = False
highlight_language = "none"


def commands() -> str:
    """Every command with its arguments and options, from the command line itself."""
    group: Any = typer.main.get_command(command_line)
    parts = ["# Commands", "`softloop COMMAND --help` says the same."]
    for name, command in sorted(group.commands.items()):
        if not command.hidden:
            parts += [f"## softloop {name}", command.help or "", *_parameters(command)]
    return "\n\n".join(parts) + "\n"


def _parameters(command: Any) -> Iterator[str]:
    rows = []
    for parameter in command.params:
        if parameter.name == "help":
            continue
        shown = " ".join(parameter.opts) if parameter.param_type_name == "option" else str(parameter.metavar or parameter.name)
        default = "" if parameter.default in (None, False) or callable(parameter.default) else str(parameter.default)
        rows.append(f"| `{shown}` | {getattr(parameter, 'help', '') or ''} | {f'`{default}`' if default else ''} |")
    if rows:
        yield "\n".join(["| argument or option | meaning | default |", "|---|---|---|", *rows])


def messages() -> str:
    """Every channel and every message definition, from the table and the files."""
    rows = [f"| `{c.name}` | {c.message} | {c.rate_hz:g} | {'yes' if c.logged else 'no'} |" for c in (*CHANNELS, FAULT)]
    parts = ["# Channels and messages", "\n".join(["| channel | message | Hz | logged |", "|---|---|---|---|", *rows])]
    for name in message_names():
        parts += [f"## {name}", f"```\n{(MSG_DIR / f'{name}.msg').read_text().rstrip()}\n```"]
    return "\n\n".join(parts) + "\n"


def setup(_app: Any) -> None:
    """Sphinx calls this before it reads the pages."""
    GENERATED.mkdir(exist_ok=True)
    for name, text in (("commands", commands()), ("messages", messages())):
        (GENERATED / f"{name}.md").write_text(text, encoding="utf-8")
