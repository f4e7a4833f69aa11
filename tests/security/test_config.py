"""What may stand in [zenoh] and [zenoh.tls]: nothing listens off this machine without TLS."""

import subprocess
import sys

import pytest
from pydantic import ValidationError

from softloop.wire.config import TlsConfig, ZenohConfig

TLS = {"folder": "/nowhere"}


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/192.168.1.2:7447", "tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/127.0.0.1:7447", "ws/10.0.0.1:1"],
)
@pytest.mark.parametrize("tls", [None, TLS])
def test_nothing_else_leaves_this_machine(endpoint, tls):
    with pytest.raises(ValidationError, match="must begin with one of"):
        ZenohConfig(endpoint=endpoint, tls=tls)


@pytest.mark.parametrize(
    "endpoint",
    ["tls/192.168.1.2:7447", "tls/rig.example:7447", "tls/[fe80::1]:7447", "tls/127.0.0.1:7447", "quic/192.168.1.2:7447"],
)
def test_tls_does_with_a_table_for_it_and_not_without(endpoint):
    assert ZenohConfig(endpoint=endpoint, tls=TLS).meeting_point("b") == endpoint
    with pytest.raises(ValidationError, match="needs the table"):
        ZenohConfig(endpoint=endpoint)


@pytest.mark.parametrize("endpoint", ["", "tcp/127.0.0.1:7447", "unixsock-stream//tmp/x.sock"])
def test_tls_never_by_half(endpoint):
    assert ZenohConfig(endpoint=endpoint)
    with pytest.raises(ValidationError, match="must be tls/HOST:PORT or quic/HOST:PORT"):
        ZenohConfig(endpoint=endpoint, tls=TLS)


@pytest.mark.parametrize("name", ["controller", "valves", "router", "launcher", "ca", "", "A", "a.b", "a/b", "*", "a" * 25])
def test_a_person_is_no_process_and_no_wildcard(name):
    with pytest.raises(ValidationError, match="a name is of a-z"):
        TlsConfig(folder="k", operators=[name])
    with pytest.raises(ValidationError, match="a name is of a-z"):
        TlsConfig(folder="k", guests=[name])


def test_nobody_is_operator_and_guest():
    with pytest.raises(ValidationError, match="twice"):
        TlsConfig(folder="k", operators=["ann"], guests=["ann"])
    with pytest.raises(ValidationError, match="is none of"):
        TlsConfig(folder="k", identity="eve")


def test_an_open_listener_is_one_line(tmp_path):
    (tmp_path / "b.toml").write_text('name = "open"\n[zenoh]\nendpoint = "tcp/0.0.0.0:7447"\n')
    command = [sys.executable, "-m", "softloop.deploy.cli", "check", str(tmp_path / "b.toml")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "b.toml: key 'zenoh.endpoint': must begin with one of" in done.stderr
    assert done.stderr.count("\n") == 1
