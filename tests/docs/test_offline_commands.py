"""The documentation's commands that need no running rig and take long: experiments, identification, the reproduction.

They are carried out in the order of the pages, so that each finds what the ones before it left, and with less to do.
"""

import re
import sys

import numpy as np
import pytest
from tests.docs.test_commands_run import OFFLINE, Place
from tests.docs.test_documentation import ALL, ROOT
from tests.wire.rendezvous import short_folder

from softloop.deploy.bench import shipped_benches

sys.path.insert(0, str(ROOT / "tests" / "offline" / "identification"))
import models
import test_valve_flow
import test_venting

pytestmark = pytest.mark.commands

LIMIT_S = 400.0
EXPERIMENT = ("experiment", "pressure")
STANDS_FOR = {"BENCH": "sim", "RUN...": "runs/p/excitation_1hz", "smc,arc_eso": "smc"}
STANDS_FOR |= {"100:120": "100:101", "200": "2", "1000": "2", "0:3": "0:1", "0:20": "0:1", "3": "1"}
SAYS_NO = "--law pressure"  # follows to some 4 kPa, and its page says so
FIRST = [*EXPERIMENT, "sim", "--pace", "batch", "--out", "runs/p"]
ORDER = ("experiments.md", "identification.md", "parity.md", "tracking.md", "real-rig.md")


def commands():
    """The commands, each once, the experiment that others need first."""
    found = [command for page in ORDER for name, command in ALL if name == page and command[0] in OFFLINE]
    unique = [list(words) for words in dict.fromkeys(map(tuple, found))]
    assert FIRST in unique
    return sorted(unique, key=lambda words: words != FIRST)


def less(command):
    """With fewer rigs, at batch pace, and placeholders replaced."""
    words = [STANDS_FOR.get(word, word) for word in command]
    if command[:2] == ["experiment", "valves"] and command[2] in ("BENCH", "my_rig.toml"):
        words[2] = "sim_tank"
    if command[0] == "experiment" and "--pace" not in command and "--over" not in command:
        words += ["--pace", "batch"]
    return [*words, "--rigs", "2", "--seeds", "0:1", "-q"] if command[0] == "reproduce" else words


@pytest.fixture(scope="module")
def place():
    with short_folder() as folder:
        here = Place(folder)
        table = re.search(r"^```toml\n(\[shadow\].*?)^```", (ROOT / "docs" / "parity.md").read_text(), re.S | re.M)[1]
        (folder / "shadowed.toml").write_text(f'base = "{shipped_benches()["sim"]}"\n{table}')
        write_measurements(folder)
        yield here


def write_measurements(folder):
    """The CSV files that the pages name."""
    for name, seed in (("bend1.csv", 1), ("bend2.csv", 2)):
        series = models.measured(models.PAPER, models.values_of(models.PAPER), seed=seed, noise_deg=0.05)
        save(folder / name, "t,p,y", series.time_s, series.pressure_kpa[:, 0], series.angle_deg)
    tank = test_venting.vent(80.0, 0.05)
    save(folder / "tank.csv", "t,p", tank.time_s, tank.pressure_kpa)
    flow = test_valve_flow.flow_tests((100.0, 150.0, 200.0), (0.0, 50.0, 90.0), noise=0.002)
    save(folder / "flow.csv", "i,pu,pd,q", flow.current_ma, flow.upstream_kpa, flow.downstream_kpa, flow.flow_kg_s)


def save(file, head, *columns):
    np.savetxt(file, np.column_stack(columns), delimiter=",", header=head, comments="")


@pytest.mark.parametrize("command", [pytest.param(words, id=" ".join(words)) for words in commands()])
def test_a_command(place, command):
    code, said = place.run(less(command), limit_s=LIMIT_S)
    assert code == (1 if SAYS_NO in " ".join(command) else 0), said


def test_all_that_is_offline_is_here():
    pages = {name for name, command in ALL if command[0] in OFFLINE}
    assert pages <= set(ORDER)
