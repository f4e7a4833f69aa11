"""One long run that several files look at."""

import pytest
import synthetic


@pytest.fixture(scope="session")
def long_run(tmp_path_factory):
    """The directory of a run of 24 s with dwells; nobody writes into it."""
    folder = tmp_path_factory.mktemp("long")
    synthetic.write_log(folder / "run.mcap", list(synthetic.messages(24.0)))
    return folder
