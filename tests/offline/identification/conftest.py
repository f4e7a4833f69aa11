"""One logged excitation that several files look at."""

import pytest
from logs import excitation_log


@pytest.fixture(scope="session")
def excitation(tmp_path_factory):
    """The log of an ideal rig on bench-a; nobody writes into its folder."""
    return excitation_log(tmp_path_factory.mktemp("excitation") / "run.mcap")
