"""What a person sees of an error."""

from hypothesis import given
from hypothesis import strategies as st

from softloop.wire.errors import BadFile, SoftloopError


@given(st.text(st.characters(codec=None, exclude_categories=())))
def test_an_error_is_one_line_that_any_terminal_can_show(said):
    shown = str(SoftloopError(said))
    assert shown.isprintable()
    shown.encode()
    assert len(shown.splitlines()) <= 1


def test_what_can_be_shown_is_shown_as_it_is():
    assert str(BadFile("Prüfstand.toml: 5 °C, \u00b5A")) == "Prüfstand.toml: 5 °C, \u00b5A"
    assert str(BadFile("a\nb\ud800\x07")) == r"a\nb\ud800\x07"
