"""What several files of this room's tests share."""

import pytest

from softloop.deploy.bench import load_bench, shipped_benches


@pytest.fixture
def bench(tmp_path):
    """The bench of a file's text over the shipped simulated one."""

    def load_text(text="", base="sim"):
        file = tmp_path / "b.toml"
        file.write_text(f'base = "{shipped_benches()[base]}"\nname = "examined"\n{text}')
        return load_bench(file, tmp_path)

    return load_text
