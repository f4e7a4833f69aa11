from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from softloop.wire.benchfile import Table, load_model, read_toml
from softloop.wire.errors import BadConfig, BadFile


class Inner(Table):
    depth: int = Field(1, ge=0, le=9)


class Outer(Table):
    name: str
    inner: Inner = Inner()
    many: dict[str, Inner] = Field(default_factory=dict)


def fault(content):
    with pytest.raises(BadConfig) as caught:
        load_model(Outer, content, Path("b.toml"))
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("b.toml: ")
    return text


def test_an_unknown_key_is_named_with_what_is_allowed():
    assert "unknown key 'nmae'; allowed here: inner, many, name" in fault({"name": "x", "nmae": 1})
    assert "unknown key 'inner.dept'; allowed here: depth" in fault({"name": "x", "inner": {"dept": 1}})
    assert "unknown key 'many.a.dept'; allowed here: depth" in fault({"name": "x", "many": {"a": {"dept": 1}}})


def test_wrong_type_range_and_missing_key_are_named():
    assert "key 'inner.depth'" in fault({"name": "x", "inner": {"depth": "deep"}})
    assert "valid integer (got '7')" in fault({"name": "x", "inner": {"depth": "7"}})
    assert "less than or equal to 9 (got 10)" in fault({"name": "x", "inner": {"depth": 10}})
    assert "key 'name' is missing" in fault({})
    assert "key 'inner'" in fault({"name": "x", "inner": 3})


class Listed(Table):
    inners: tuple[Inner, ...] = Field(min_length=2)


def test_a_list_with_a_wrong_entry_is_not_too_short_besides():
    for content, said in (
        ([{"depth": 10}, {"depth": 1}], "b.toml: key 'inners.0.depth': Input should be less than or equal to 9 (got 10)"),
        ([{"depth": 1}], "b.toml: key 'inners': Tuple should have at least 2 items after validation, not 1 (got [{'depth': 1}])"),
    ):
        with pytest.raises(BadConfig) as caught:
            load_model(Listed, {"inners": content}, "b.toml")
        assert str(caught.value) == said


def test_files_that_are_missing_or_not_toml_are_one_line(tmp_path):
    with pytest.raises(BadFile, match="cannot be read"):
        read_toml(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("name = ")
    with pytest.raises(BadFile, match="not valid TOML"):
        read_toml(tmp_path / "bad.toml")
    (tmp_path / "latin.toml").write_bytes(b"name = '\xe9'")
    with pytest.raises(BadFile, match="not UTF-8"):
        read_toml(tmp_path / "latin.toml")


DEEP = [f"a = {'[' * 100_000}", f"{'a.' * 50_000}b = 1", f"{'a.' * 50}b = 1", f"a = {'[' * 60}{']' * 60}"]


@pytest.mark.parametrize("text", [f"a = {'1' * 5000}", *DEEP])
def test_what_no_reader_takes_is_one_line(tmp_path, text):
    (tmp_path / "b.toml").write_text(text)
    with pytest.raises(
        BadFile, match="too deep in each other" if text in DEEP else "not valid TOML: Exceeds the limit"
    ) as caught:
        read_toml(tmp_path / "b.toml")
    assert str(caught.value).startswith(f"{tmp_path}/b.toml: ")
    assert len(str(caught.value)) < 300


def test_tables_that_stand_less_deep_are_read(tmp_path):
    (tmp_path / "b.toml").write_text(f"{'a.' * 40}b = [[1]]")
    assert read_toml(tmp_path / "b.toml")["a"]["a"]["a"]


@given(st.binary(max_size=200))
def test_any_bytes_give_a_model_or_one_line(tmp_path_factory, data):
    file = tmp_path_factory.getbasetemp() / "fuzz.toml"
    file.write_bytes(data)
    complaint = str(file)
    try:
        load_model(Outer, read_toml(file), file)
    except (BadFile, BadConfig) as error:
        complaint = str(error)
    assert str(file) in complaint
    assert "\n" not in complaint


JSONISH = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["name", "inner", "depth", "many", "x"]), inner),
    max_leaves=8,
)


@given(st.dictionaries(st.sampled_from(["name", "inner", "many", "y"]), JSONISH))
def test_any_content_gives_a_model_or_one_line(content):
    complaint = "b.toml: "
    try:
        load_model(Outer, content, "b.toml")
    except BadConfig as error:
        complaint = str(error)
    assert complaint.startswith("b.toml: ")
