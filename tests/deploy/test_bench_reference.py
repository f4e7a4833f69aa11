"""docs/bench-file.md says of every key what the models say."""

import importlib.util
import sys
from pathlib import Path

import pytest

from softloop.deploy.bench import Bench

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def reference():
    spec = importlib.util.spec_from_file_location("make_bench_reference", DOCS / "make_bench_reference.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def keys_of(table):
    """(model, key, field) of every key of a bench that is no table."""
    return [
        (name, key, given)
        for name, model in {**table["$defs"], "Bench": table}.items()
        for key, given in model["properties"].items()
        if "$ref" not in str(given)
    ]


def test_the_page_is_up_to_date(reference):
    page = reference.PAGE.read_text(encoding="utf-8")
    assert page == reference.updated(page), "run: .venv/bin/python docs/make_bench_reference.py"


def test_every_key_has_a_row_and_a_meaning(reference):
    rows = reference.render().splitlines()
    keys = keys_of(Bench.model_json_schema())
    assert len(keys) > 100
    assert [f"{model}.{key}" for model, key, given in keys if not given.get("description")] == []
    for _, key, given in keys:
        meaning = given["description"].replace("|", "\\|")
        assert any(row.startswith(f"| `{key}` |") and row.endswith(f"| {meaning} |") for row in rows), key
    assert {row.count("|") - row.count("\\|") for row in rows if row.startswith("| `") and "` | " in row} == {4, 7}


def test_units_given_by_hand_are_of_keys_that_are_there(reference):
    assert set(reference.UNITS) <= {key for _, key, _ in keys_of(Bench.model_json_schema())}
