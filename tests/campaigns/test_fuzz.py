"""A hundredth of `make fuzz`."""

import pytest

from softloop.deploy.bench import load_bench
from softloop.dynamics.parameters import load_parameters
from softloop.offline.log import open_log
from softloop.wire.errors import SoftloopError
from tests.campaigns.fuzz import BYTES, campaign
from tests.campaigns.fuzz_corpora import bench_files, log_files, parameter_files


@pytest.mark.parametrize("target", [*BYTES, "gate"])
def test_a_hundredth_of_the_fuzz_campaign(target):
    outcome = campaign([target], 10_000, "own", seed=5)
    assert outcome.failures == []
    assert sum(outcome.counts.values()) >= 10_000 * (0.5 if target == "gate" else 1.0)


def test_the_inputs_that_others_are_made_of_are_good(tmp_path):
    """Of what is refused in its first line no change would show anything."""

    def refusals(read, contents):
        file = tmp_path / "file"
        for content in contents:
            file.write_bytes(content)
            try:
                read(file)
            except SoftloopError as error:
                yield str(error)

    benches, files = bench_files(tmp_path), parameter_files()
    assert len(benches) > 100
    assert list(refusals(load_bench, benches)) == []
    of_tables = list(refusals(load_parameters, files))
    assert len(of_tables) == len(files) - 3
    assert all("is missing" in text for text in of_tables)
    assert list(refusals(open_log, set(log_files(tmp_path)))) == []
