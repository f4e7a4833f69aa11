"""Options that are numbers: nan and inf, which pass bounds or make nonsense of them, are refused by every command."""

from typing import get_args, get_type_hints

import pytest
import typer

from softloop.deploy import cli
from softloop.deploy.calibrate import Known
from softloop.deploy.cli_app import numbers
from softloop.wire.errors import EXIT_USAGE, BadConfig

NO_NUMBERS = ("nan", "inf", "-inf", "1e999")


def is_float(hint):
    return hint is float or any(map(is_float, get_args(hint)))


def options(command, *path):
    """The words of each command whose function takes a float, and the name by which a person gives it."""
    for name, inner in getattr(command, "commands", {}).items():
        yield from options(inner, *path, name)
    hints = get_type_hints(command.callback) if command.callback else {}
    yield from ((path, parameter.opts[0]) for parameter in command.params if is_float(hints.get(parameter.name)))


ALL = sorted(options(typer.main.get_command(cli.app)))


def test_the_look_finds_the_options_there_are():
    assert len(ALL) >= 19
    assert {(("calibrate",), "--bent-deg"), (("request",), "--for"), (("plot",), "--from")} <= set(ALL)
    assert (("doctor-ticks",), "--seconds") in ALL  # hidden ones too


@pytest.mark.parametrize("text", NO_NUMBERS)
@pytest.mark.parametrize(("path", "option"), ALL, ids=lambda value: value if isinstance(value, str) else " ".join(value))
def test_no_number_is_refused_in_one_line(path, option, text, capsys):
    """The value is judged before arguments that are missing, so nothing is carried out."""
    with pytest.raises(SystemExit) as ended:
        cli.main([*path, f"{option}={text}"])
    said = capsys.readouterr()
    assert (ended.value.code, said.out, said.err.count("\n")) == (EXIT_USAGE, "", 1)
    assert f"Invalid value for '{option}'" in said.err


def test_the_look_sees_arguments_lists_and_groups():
    outer, inner = typer.Typer(), typer.Typer()
    outer.add_typer(inner, name="kiln")

    @inner.command("heat")
    def heat(kelvin: float, name: str, more: list[float] | None = None) -> None: ...

    @inner.command("cool")
    def cool(name: str) -> None: ...

    assert sorted(options(typer.main.get_command(outer))) == [(("kiln", "heat"), "--more"), (("kiln", "heat"), "kelvin")]


@pytest.mark.parametrize("text", ["150,nan,200", "150,inf", "150,,200", "", "much"])
def test_numbers_in_a_text_are_finite_too(text, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["experiment", "valves", "sim", "--supply", text])
    said = capsys.readouterr()
    assert (ended.value.code, said.out, said.err.count("\n")) == (EXIT_USAGE, "", 1)
    assert "give finite numbers with commas between" in said.err
    assert numbers("--supply", "150, 175.5", "1,2") == (150.0, 175.5)


@pytest.mark.parametrize("name", ["rest_deg", "chamber_kpa", "supply_kpa", "bent_deg"])
def test_what_is_known_of_a_rig_is_finite_whoever_says_it(name):
    for text in NO_NUMBERS:
        with pytest.raises(BadConfig, match=f"--{name.replace('_', '-')}: .* is not a finite number"):
            Known(**{name: float(text)}).check()
    Known(**{name: 0.0}).check()
