"""Makes the synthetic runs importable, whatever the import mode, and one long run that several files look at."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def long_run(tmp_path_factory):
    """The directory of a run of 24 s with dwells; nobody writes into it."""
    import synthetic

    folder = tmp_path_factory.mktemp("long")
    synthetic.write_log(folder / "run.mcap", list(synthetic.messages(24.0)))
    return folder
