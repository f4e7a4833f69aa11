"""What a campaign keeps: its counts when it is interrupted, and where it goes on."""

import json
import signal
import subprocess
import sys

import pytest

SCRIPT = """
import sys, time
from tests.campaigns.outcome import carried_out, options
given = options("A toy.", resumable=True, items=10).parse_args()

def run(outcome):
    for number in range(outcome.counts.get("items", 0), given.items):
        outcome.count("items")
        print("item", number, flush=True)
        time.sleep(0.01)
    if given.seed == 13:
        outcome.fail("of bad luck")

sys.exit(carried_out("toy", given, run))
"""


@pytest.fixture
def toy(tmp_path):
    def start(*arguments):
        command = [sys.executable, "-c", SCRIPT, "--json", str(tmp_path / "toy.json"), *map(str, arguments)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    return start, tmp_path / "toy.json"


def finish(process):
    out, _ = process.communicate(timeout=60)
    return process.returncode, out.strip().splitlines()[-1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_campaign_says_what_it_counted_and_goes_on_from_there(toy, number):
    start, file = toy
    process = start("--items", 100_000)
    while process.stdout.readline() != "item 5\n":
        assert process.poll() is None
    process.send_signal(number)
    code, word = finish(process)
    assert code == 130
    assert word.startswith("toy: 0 failures in ")
    assert word.endswith(", interrupted")
    kept = json.loads(file.read_text())
    assert (kept["ended"], kept["failures"]) == ("interrupted", [])
    done = kept["counts"]["items"]
    assert done >= 6
    process = start("--items", done + 3, "--resume")
    assert process.stdout.readline() == f"item {done}\n"
    assert finish(process)[0] == 0
    assert json.loads(file.read_text())["counts"]["items"] == done + 3


def test_counts_of_other_code_are_not_gone_on_from(toy):
    start, file = toy
    assert finish(start("--resume")) == (
        3,
        f"toy: {file}: no counts to go on from: [Errno 2] No such file or directory: '{file}'",
    )
    assert finish(start())[0] == 0
    file.write_text(file.read_text().replace('"commit": "', '"commit": "0'))
    code, word = finish(start("--resume", "--items", 12))
    assert code == 3
    assert word.endswith("begin anew")


def test_a_failure_is_exit_code_1(toy):
    start, file = toy
    assert finish(start("--seed", 13))[0] == 1
    assert json.loads(file.read_text())["failures"] == ["of bad luck"]
