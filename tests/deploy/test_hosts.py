"""Hosts in the bench file: what is wrong is said in one line; who runs where, and which host leads."""

import json
import re
import shutil
import stat
import sys
import tempfile
from pathlib import Path

import pytest
import zenoh

from softloop.deploy.bench import folders_of, load_bench, shipped_benches
from softloop.deploy.hosts import choose_host, digest, leader, number_of, on_host, share_of, shares
from softloop.deploy.run_dir import keep_bench, make_run_dir
from softloop.deploy.zenohd import find_zenohd, listens, nested, run_zenohd
from softloop.wire.config import ZenohConfig
from softloop.wire.errors import BadConfig, Unavailable
from softloop.wire.session import open_session
from softloop.wire.zenoh_settings import make_config, own_endpoint, settings_of

HOSTS = f"""
base = "{shipped_benches()["sim"]}"
name = "many"
[hosts.bench]
address = "127.0.0.2"
[hosts.desk]
[hosts.log]
[plant]
host = "bench"
[valves]
host = "bench"
[pressures]
host = "bench"
[inclinometer]
host = "bench"
[controller]
host = "desk"
[recorder]
host = "log"
"""


@pytest.fixture
def write(tmp_path):
    def write_bench(text=HOSTS, name="many.toml"):
        file = tmp_path / name
        file.write_text(text)
        return file

    return write_bench


def test_shares_and_who_leads(write):
    bench = load_bench(write())
    assert shares(bench) == {
        "bench": ("plant", "valves", "pressures", "inclinometer"),
        "desk": ("controller",),
        "log": ("recorder",),
    }
    assert leader(bench) == "desk"
    assert [number_of(bench, host) for host in ("bench", "desk", "log")] == [0, 1, 2]
    assert share_of(bench, "desk").recorder is None
    assert share_of(bench, "log").recorder is not None
    assert share_of(bench, "log").controller is None


def test_a_bench_of_one_host_has_no_shares(write):
    bench = load_bench(shipped_benches()["sim"])
    assert shares(bench) == {}
    assert choose_host(bench, None) == ""
    assert share_of(bench, "") is bench
    assert on_host(bench, "") is bench
    with pytest.raises(BadConfig, match="bench 'sim' has no host 'desk'; it has: none, it runs on one"):
        choose_host(bench, "desk")


def test_which_host_this_is_must_be_said(write):
    bench = load_bench(write())
    assert choose_host(bench, "log") == "log"
    with pytest.raises(BadConfig, match=r"runs on several hosts: bench \(plant, .*say with --host which one this is"):
        choose_host(bench, None)
    with pytest.raises(BadConfig, match="has no host 'dsk'; it has: bench"):
        choose_host(bench, "dsk")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('[controller]\nhost = "desk"', '[controller]\nhost = "dsk"', "'controller.host': there is no .hosts.dsk.; there are: "),
        ('[controller]\nhost = "desk"', "[controller]", "key 'controller.host' is missing: this bench runs on the hosts bench, "),
        ("[hosts.log]", "[hosts.log]\n[hosts.idle]", "key 'hosts.idle': no process runs there"),
        ('address = "127.0.0.2"', 'address = "10.0.0.2"', "hosts.bench.address': must be a loopback address"),
        ('address = "127.0.0.2"', 'address = "localhost"', "must be an IP address"),
        ('[pressures]\nhost = "bench"', "[pressures]", "key 'pressures.host' is missing"),
        ('[inclinometer]\nhost = "bench"', '[inclinometer]\nhost = "log"', "key 'plant.serial': .* name a port"),
        ("[hosts.desk]", '[zenoh]\nendpoint = "tcp/127.0.0.1:{port}"\n[hosts.desk]', "key 'zenoh.endpoint': .* name a port"),
        ('name = "many"', 'name = "many"\nwithout = ["controller"]', "a bench on several hosts needs .controller."),
    ],
)
def test_what_cannot_be_is_one_line_with_file_and_key(write, old, new, said):
    text = HOSTS.replace(old, new)
    if "without" in new:
        text = text.replace('[controller]\nhost = "desk"', "").replace("[hosts.desk]", "")
    assert text != HOSTS
    file = write(text)
    with pytest.raises(BadConfig, match=said) as caught:
        load_bench(file)
    assert str(file) in str(caught.value)


def test_a_host_without_hosts_is_refused(write):
    file = write(f'base = "{shipped_benches()["sim"]}"\n[plant]\nhost = "bench"\n')
    with pytest.raises(BadConfig, match=r"key 'plant.host': there is no .hosts.bench.; there are: none"):
        load_bench(file)


def test_the_digest_follows_the_bench_and_not_its_folder(write, tmp_path):
    def of(file):
        return digest(load_bench(file), folders_of(file))

    trajectory = HOSTS.replace('host = "desk"', 'host = "desk"\ntrajectory = "{bench_dir}/mine.csv"')
    (tmp_path / "elsewhere").mkdir()
    assert of(write(trajectory)) == of(write(trajectory, "elsewhere/other.toml"))
    assert of(write()) != of(write(trajectory))
    assert of(write()) != of(write(HOSTS + "[clock]\nuncertainty_max_ms = 3.0\n"))
    assert 0 <= of(write()) < 2**63


def test_run_directories_of_two_hosts_differ_and_the_kept_bench_reads_again(write, tmp_path):
    bench = load_bench(write())
    here = bench.model_copy(update={"run": bench.run.model_copy(update={"folder": str(tmp_path)})})
    first, second = make_run_dir(here, None, "desk"), make_run_dir(here, None, "log")
    assert first.name.startswith("many-desk-")
    assert second.name.startswith("many-log-")
    kept = load_bench(keep_bench(first, load_bench(write(), first)), first)
    assert shares(kept) == shares(bench)


def test_direct_links_are_at_the_hosts_address(write):
    bench = load_bench(write())
    assert on_host(bench, "bench").zenoh.listen == "127.0.0.2"
    assert on_host(bench, "desk").zenoh.listen == ""
    assert own_endpoint("tcp/127.0.0.1:7447", "plant", "127.0.0.2") == "tcp/127.0.0.2:0"
    assert own_endpoint("tcp/127.0.0.1:7447", "plant", "::1") == "tcp/[::1]:0"
    assert own_endpoint("tcp/127.0.0.1:7447", "plant") == "tcp/127.0.0.1:0"


ROUTER = """#!{python}
import json, signal, sys, zenoh
assert sys.argv[1] == "--config"
with zenoh.open(zenoh.Config.from_file(sys.argv[2])):
    signal.sigwait([signal.SIGTERM])
"""


@pytest.fixture
def zenohd(tmp_path, monkeypatch):
    """A stand-in on PATH: a router that takes the same argument, and reads the file as Zenoh does."""
    program = tmp_path / "zenohd"
    program.write_text(ROUTER.format(python=sys.executable))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    return str(program)


def test_zenohd_is_taken_where_it_is_installed(zenohd, monkeypatch):
    assert find_zenohd("auto") == find_zenohd("zenohd") == zenohd
    assert find_zenohd("softloop") is None
    monkeypatch.setenv("PATH", "/nowhere")
    assert find_zenohd("auto") is None
    with pytest.raises(Unavailable, match="there is no program zenohd"):
        find_zenohd("zenohd")


def test_zenohd_is_the_meeting_point_while_the_block_lasts(zenohd, short_dir):
    where = f"unixsock-stream/{short_dir}/z.sock"
    config = ZenohConfig(mode="client", endpoint=where)
    with run_zenohd(zenohd, config, where) as process:
        with open_session(config, "b", "p") as session:
            assert len(session.info.routers_zid()) == 1
        with pytest.raises(Unavailable, match="the address is in use"), run_zenohd(zenohd, config, where):
            pass
    assert process.poll() is not None
    assert not listens(where)


def test_a_zenohd_that_does_not_come_up_is_said(tmp_path, short_dir):
    broken = tmp_path / "broken"
    broken.write_text("#!/bin/sh\nexit 3\n")
    broken.chmod(0o755)
    where = f"unixsock-stream/{short_dir}/z.sock"
    with pytest.raises(Unavailable, match="zenohd does not listen at"), run_zenohd(str(broken), ZenohConfig(), where):
        pass


def test_zenohd_is_given_the_settings_of_our_own_router(tmp_path):
    settings = settings_of("router", ["tcp/127.0.0.1:7999"], [], 5000)
    file = tmp_path / "zenohd.json5"
    file.write_text(json.dumps(nested(settings)))
    read, ours = zenoh.Config.from_file(str(file)), make_config("router", ["tcp/127.0.0.1:7999"], [], 5000)
    assert all(read.get_json(name) == ours.get_json(name) for name in settings)


@pytest.fixture
def short_dir():
    path = Path(tempfile.mkdtemp(prefix="sl-"))
    yield path
    shutil.rmtree(path)


def test_the_pages_bench_is_right(tmp_path):
    page = (Path(__file__).resolve().parents[2] / "docs" / "hosts.md").read_text()
    (tmp_path / "sim.toml").write_text(shipped_benches()["sim"].read_text())
    (tmp_path / "lab.toml").write_text(re.search(r"^```toml\n(.*?)^```", page, re.S | re.M)[1])
    bench = load_bench(tmp_path / "lab.toml")
    assert leader(bench) == "desk"
    for host in re.findall(r"softloop run lab.toml --host (\w+)", page):
        assert choose_host(bench, host) == host
