"""A hundredth of `make mutate`, and that a mutant is what it says."""

import ast
import json
import subprocess
import sys

from tests.campaigns.mutants import mutants_of

SOURCE = '''
def f(a, b):
    """Words stay as they are."""
    if a < b and a != 3:
        a += 1
    return min(a, b)
'''


def test_every_mutant_changes_one_place_and_has_a_name_of_its_own():
    made = list(mutants_of(SOURCE, ["f"]))
    assert len({m.name for m in made}) == len(made)
    assert len({ast.unparse(m.tree) for m in made}) == len(made)
    assert ast.unparse(ast.parse(SOURCE)) not in {ast.unparse(m.tree) for m in made}
    assert all("Words stay as they are." in ast.unparse(m.tree) for m in made)
    names = [m.name for m in made]
    assert "f: if a < b and a != 3: -> if a <= b and a != 3:" in names
    assert "f: return min(a, b) -> return max(a, b)" in names
    assert "f: a += 1 -> pass" in names


def test_a_hundredth_of_the_mutation_campaign(tmp_path):
    command = [sys.executable, "-m", "tests.campaigns.mutate", "--one-in", "100", "--json", str(tmp_path / "m.json")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    found = json.loads((tmp_path / "m.json").read_text())
    assert (done.returncode, found["failures"]) == (0, []), done.stdout
    assert found["counts"]["mutants of gate killed"] >= 2
    assert found["counts"]["mutants of watchdog killed"] >= 1
