"""Every command in the documentation: understood by the command line, and those that need no running rig carried out."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from softloop.deploy.bench import load_bench
from softloop.deploy.cli import app

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "offline"))
import synthetic

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
# What follows from a log alone, or from a bench file.
WITHOUT_RIG = ("plot", "report", "compare", "check")
STANDS_FOR = {"runs/first": "first", "runs/second": "second", "runs/RUN": "first", "runs/RUN_A": "first", "runs/RUN_B": "second"}


def commands_in(page):
    """The words of each command line in the code blocks of a page, fenced or indented."""
    text = page.read_text()
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", text, re.S | re.M)
    blocks += re.findall(r"\n\n((?:    .*\n)+)", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M))
    for line in "".join(blocks).splitlines():
        words = line.strip().removeprefix("$ ").removeprefix(".venv/bin/")
        if words.startswith("softloop ") and ":" not in words.split(" ")[1]:
            yield shlex.split(words, comments=True)[1:]


ALL = [(page.name, command) for page in PAGES for command in commands_in(page)]


def test_there_are_commands():
    assert len(ALL) > 20
    assert {"tutorial.md", "watching.md", "live-page.md"} <= {name for name, _ in ALL}


@pytest.mark.parametrize(("page", "command"), ALL, ids=lambda value: value if isinstance(value, str) else " ".join(value))
def test_a_command_is_understood(page, command):
    """Its name, arguments and options are parsed as they are written; nothing is carried out."""
    group = typer.main.get_command(app)
    name, *arguments = [word.replace("<run>", "RUN") for word in command]
    assert name in group.commands, f"{page}: no command {name}"
    found = group.commands[name]
    while arguments and hasattr(found, "commands"):  # a group, such as `log`
        found, arguments = found.commands[arguments[0]], arguments[1:]
    context = found.make_context(name, arguments)
    assert context.args == []


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("docs")
    for name, moving in (("first", False), ("second", True)):
        (folder / name).mkdir()
        synthetic.write_log(folder / name / "run.mcap", list(synthetic.messages(12.0, moving=moving)))
    return folder


def tutorial_commands():
    for name, command in ALL:
        if command[0] in WITHOUT_RIG and name in ("tutorial.md", "watching.md"):
            yield pytest.param(command, id=f"{name} {' '.join(command)}")


@pytest.mark.commands
@pytest.mark.parametrize("command", list(tutorial_commands()))
def test_a_command_without_a_rig_does_what_the_page_says(command, runs):
    words = [str(runs / STANDS_FOR[word]) if word in STANDS_FOR else word for word in command]
    done = subprocess.run(
        [sys.executable, "-m", "softloop.deploy.cli", *words], cwd=runs, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_tutorials_bench_is_right(tmp_path):
    text = (ROOT / "docs" / "tutorial.md").read_text()
    bench = re.search(r"^```toml\n(.*?)^```", text, re.S | re.M)[1]
    (tmp_path / "pid.toml").write_text(bench)
    shutil.copy(ROOT / "deploy" / "benches" / "sim.toml", tmp_path / "sim.toml")
    command = [sys.executable, "-m", "softloop.deploy.cli", "check", "pid.toml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr


def test_the_benches_of_a_real_rig_are_right(tmp_path):
    """Its first one as it stands; what is shown after it, each laid over that one."""
    first, *more = re.findall(r"^```toml\n(.*?)^```", (ROOT / "docs" / "real-rig.md").read_text(), re.S | re.M)
    for name in ("sim", "real"):
        shutil.copy(ROOT / "deploy" / "benches" / f"{name}.toml", tmp_path)
    (tmp_path / "my_rig.toml").write_text(first)
    bench = load_bench(tmp_path / "my_rig.toml")
    assert (bench.valves.pressure_max_kpa, bench.plant) == (60.0, None)
    assert len(more) == 2
    for text in more:
        (tmp_path / "more.toml").write_text(f'base = "my_rig.toml"\n{text}')
        assert load_bench(tmp_path / "more.toml").name == "my_rig"


def test_the_pages_build_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(ROOT / "docs"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    index = (tmp_path / "index.html").read_text()
    for page in ("tutorial.html", "generated/commands.html", "generated/messages.html"):
        assert page in index
    assert "softloop compare" in (tmp_path / "generated" / "commands.html").read_text()
