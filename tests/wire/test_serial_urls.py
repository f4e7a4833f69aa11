"""Serial ports by URL: `pty://` and `listen://`, as pyserial and python-can's slcan use them."""

from __future__ import annotations

import os
import select
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import can
import pytest
import serial
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from softloop.wire.errors import Unavailable
from softloop.wire.serial_urls import open_serial

WAIT_S = 5.0


@pytest.fixture
def folder():
    path = Path(tempfile.mkdtemp(prefix="sl", dir="/tmp"))
    yield path
    assert list(path.iterdir()) == []  # each port takes away what it made
    shutil.rmtree(path)


@pytest.fixture(params=["pty", "listen"])
def two_ends(request, folder):
    """The opener's end and the other one."""
    url = f"pty://{folder}/port" if request.param == "pty" else "listen://127.0.0.1:0"
    with serial.serial_for_url(url, baudrate=115200, timeout=WAIT_S) as ours:
        other_url = str(folder / "port") if request.param == "pty" else ours.client_url
        with serial.serial_for_url(other_url, baudrate=115200, timeout=WAIT_S) as theirs:
            yield ours, theirs


def wait_for(condition):
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_all_byte_values_pass_both_ways_unchanged(two_ends):
    ours, theirs = two_ends
    data = bytes(range(256)) * 4
    assert theirs.write(data) == len(data)
    assert ours.read(len(data)) == data
    assert ours.write(data) == len(data)
    assert theirs.read(len(data)) == data


def test_waiting_flushing_and_descriptors(two_ends):
    ours, theirs = two_ends
    assert ours.in_waiting == 0
    theirs.write(b"abc")
    wait_for(lambda: select.select([ours.fileno()], [], [], 0)[0])
    wait_for(lambda: ours.in_waiting == 3)
    assert ours.read(1) == b"a"
    ours.reset_input_buffer()
    assert ours.in_waiting == 0
    assert not select.select([ours.fileno()], [], [], 0)[0]
    ours.flush()
    ours.reset_output_buffer()
    ours.rts = ours.dtr = False
    assert (ours.cts, ours.dsr, ours.cd, ours.ri) == (True, True, True, False)


def test_timeouts(two_ends):
    ours, theirs = two_ends
    ours.timeout = 0
    assert ours.read(5) == b""
    ours.timeout = 0.5
    start = time.monotonic()
    theirs.write(b"xy")
    assert ours.read(5) == b"xy"
    assert time.monotonic() - start >= 0.49
    ours.timeout = None
    writer = threading.Timer(0.05, theirs.write, [b"z"])
    writer.start()
    assert ours.read(1) == b"z"
    writer.join(WAIT_S)


def test_cancel_read(two_ends):
    ours, _ = two_ends
    ours.timeout = None
    threading.Timer(0.05, ours.cancel_read).start()
    assert ours.read(1) == b""


def test_a_reader_that_does_not_read_never_stalls_the_writer(two_ends):
    ours, theirs = two_ends
    lines = [b"%08d\n" % i for i in range(400_000)]  # 3.6 MB: more than any buffer between the two
    start = time.monotonic()
    for at in range(0, len(lines), 100):
        block = b"".join(lines[at : at + 100])
        assert ours.write(block) == len(block)
    assert time.monotonic() - start < 30  # it would be for ever
    lost = ours.overflows if hasattr(ours, "overflows") else ours.lost_bytes
    assert lost > 0
    theirs.timeout = 0.2
    while theirs.read(1_000_000):
        pass
    theirs.timeout = WAIT_S
    ours.write(b"fresh\n")
    assert theirs.read(6) == b"fresh\n"


def test_a_closed_port_says_so(two_ends):
    ours, _ = two_ends
    ours.close()
    ours.close()
    for use in (lambda: ours.write(b"x"), ours.read, ours.fileno if not isinstance(ours, serial.Serial) else ours.read):
        with pytest.raises(serial.SerialException):
            use()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(st.lists(st.binary(min_size=1, max_size=50), max_size=20))
def test_any_pieces_arrive_as_one_stream(two_ends, pieces):
    ours, theirs = two_ends
    for piece in pieces:
        ours.write(piece)
    assert theirs.read(sum(map(len, pieces))) == b"".join(pieces)


def test_pty_keeps_the_newest_bytes(folder):
    with serial.serial_for_url(f"pty://{folder}/p") as ours:
        written = 0
        while not ours.overflows:
            written += ours.write(b"%08d\n" % written)
        with serial.serial_for_url(f"{folder}/p", timeout=0.2) as theirs:
            ours.write(b"last\n")
            assert theirs.read(1_000_000).endswith(b"last\n")


def test_pty_without_anybody_at_the_other_end(folder):
    with serial.serial_for_url(f"pty://{folder}/p", timeout=0.05) as ours:
        assert ours.read(1) == b""
        assert ours.write(b"lost") == 4
        with serial.serial_for_url(f"{folder}/p", timeout=WAIT_S) as first:
            first.write(b"1")
            assert ours.read(1) == b"1"
        assert ours.read(1) == b""  # the other end may go
        with serial.serial_for_url(f"{folder}/p", timeout=WAIT_S) as second:  # and another one come
            ours.write(b"2")
            assert second.read(1) == b"2"


def test_pty_link_in_use_is_refused_and_two_ports_live_side_by_side(folder):
    with open_serial(f"pty://{folder}/a", 115200, 0.1), open_serial(f"pty://{folder}/b", 115200, 0.1):
        for path in (f"{folder}/a", f"{folder}/../{folder.name}/a"):
            with pytest.raises(Unavailable, match="another process holds this port"):
                open_serial(f"pty://{path}", 115200, 0.1)
        assert (folder / "a").is_symlink()


def test_pty_can_be_opened_again(folder):
    port = serial.serial_for_url(f"pty://{folder}/a", do_not_open=True)
    for _ in range(2):
        port.open()
        assert (folder / "a").is_symlink()
        assert port.name == f"pty://{folder}/a"
        port.close()
        assert not (folder / "a").is_symlink()


def test_pty_link_of_a_killed_process_is_replaced(folder):
    code = (
        "import sys, softloop.wire.serial_urls as s; p = s.open_serial(sys.argv[1], 9600, 30); print('up', flush=True); p.read()"
    )
    process = subprocess.Popen([sys.executable, "-c", code, f"pty://{folder}/p"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "up\n"
        with pytest.raises(Unavailable, match="another process holds this port"):
            open_serial(f"pty://{folder}/p", 115200, 0.1)
    finally:
        process.kill()
        process.wait(WAIT_S)
        process.stdout.close()
    assert (folder / "p").is_symlink()
    with open_serial(f"pty://{folder}/p", 115200, WAIT_S) as ours, open_serial(f"{folder}/p", 115200, WAIT_S) as theirs:
        theirs.write(b"k")
        assert ours.read(1) == b"k"


def test_pty_leaves_what_is_not_its_own(folder):
    (folder / "file").write_text("keep me")
    (folder / "link").symlink_to(folder / "file")
    for name, word in (("file", "a file with this name"), ("link", "a link to something else")):
        with pytest.raises(Unavailable, match=word):
            open_serial(f"pty://{folder}/{name}", 115200, 0.1)
    assert (folder / "link").read_text() == "keep me"
    (folder / "link").unlink()
    (folder / "file").unlink()
    port = open_serial(f"pty://{folder}/p", 115200, 0.1)
    (folder / "p").unlink()
    (folder / "p").symlink_to("/dev/null")
    port.close()
    assert os.readlink(folder / "p") == "/dev/null"
    (folder / "p").unlink()


def test_listen_tells_its_port_and_takes_one_client_after_another():
    with serial.serial_for_url("listen://127.0.0.1:0", timeout=0.5) as ours:
        assert ours.client_url == f"socket://127.0.0.1:{ours.bound_port}"
        assert not ours.connected
        assert ours.write(b"nobody") == 6
        assert ours.lost_bytes == 6
        address = ("127.0.0.1", ours.bound_port)
        with socket.create_connection(address, WAIT_S) as first:
            wait_for(lambda: ours.connected)
            with socket.create_connection(address, WAIT_S) as second:
                assert not ours.read(1)
                assert second.recv(1) == b""  # closed at once
            first.sendall(b"one")
        with socket.create_connection(address, WAIT_S) as third:
            third.sendall(b"two")
            ours.timeout = WAIT_S
            assert ours.read(6) == b"onetwo"
            ours.write(b"hello")
            third.settimeout(WAIT_S)
            assert third.recv(5) == b"hello"
        wait_for(lambda: not ours.connected)


def test_listen_survives_a_client_that_breaks_off():
    with serial.serial_for_url("listen://127.0.0.1:0", timeout=0.2) as ours:
        for _ in range(3):
            client = socket.create_connection(("127.0.0.1", ours.bound_port), WAIT_S)
            wait_for(lambda: ours.connected)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # close with a reset
            client.close()
            ours.write(b"x" * 100)
            ours.write(b"x" * 100)
            assert ours.read(1) == b""
            assert not ours.connected


@pytest.mark.parametrize(
    ("url", "word"),
    [
        ("/dev/no-such-device", "there is no such device"),
        ("nonsense://x", "no such kind of URL"),
        ("pty://relative/path", "expected pty:///path"),
        ("pty:///", "expected pty:///path"),
        ("pty:///no-such-folder/x", "there is no folder /no-such-folder"),
        ("listen://:5000", "expected listen://HOST:PORT"),
        ("listen://127.0.0.1", "expected listen://HOST:PORT"),
        ("listen://127.0.0.1:99999", "expected listen://HOST:PORT"),
        ("listen://127.0.0.1:x", "expected listen://HOST:PORT"),
        ("listen://0.0.0.0:5000", "would listen off this machine"),
        ("listen://192.168.1.2:5000", "would listen off this machine"),
        ("listen://rig.example:5000", "would listen off this machine"),
        ("socket://127.0.0.1:1", "refused"),
        ("/dev/null", "."),
    ],
)
def test_what_cannot_be_opened_is_one_line(url, word):
    with pytest.raises(Unavailable, match=word) as caught:
        open_serial(url, 115200, 0.1)
    assert str(caught.value).startswith(f"serial port {url}: ")
    assert "\n" not in str(caught.value)


def test_ports_in_use_are_one_line(folder):
    with open_serial("listen://127.0.0.1:0", 115200, 0.1) as ours, pytest.raises(Unavailable, match="in use"):
        open_serial(f"listen://127.0.0.1:{ours.bound_port}", 115200, 0.1)
    path = f"{folder}/p"
    with open_serial(f"pty://{path}", 115200, 0.1), open_serial(path, 115200, 0.1), pytest.raises(Unavailable, match="in use"):
        open_serial(path, 115200, 0.1)


@pytest.mark.parametrize("kind", ["pty", "listen"])
def test_slcan_frames_both_ways(kind, folder):
    url = f"pty://{folder}/can1" if kind == "pty" else "listen://127.0.0.1:0"
    ours = can.Bus(interface="slcan", channel=url, bitrate=500000, sleep_after_open=0, ignore_config=True)
    other = f"{folder}/can1" if kind == "pty" else ours.serialPortOrig.client_url
    theirs = can.Bus(interface="slcan", channel=other, bitrate=500000, sleep_after_open=0, ignore_config=True)
    try:
        if kind == "listen":
            wait_for(lambda: ours.serialPortOrig.connected)
        for i in range(50):
            for sender, receiver in ((ours, theirs), (theirs, ours)):
                extended = bool(i % 2)
                msg = can.Message(arbitration_id=0x100 + i, is_extended_id=extended, data=bytes([i] * (i % 9)))
                sender.send(msg, timeout=0.1)
                got = receiver.recv(WAIT_S)
                assert got.equals(msg, timestamp_delta=None, check_channel=False)
        notified = can.BufferedReader()
        with can.Notifier(theirs, [notified], timeout=0.05):
            ours.send(can.Message(arbitration_id=1, is_extended_id=False))
            assert notified.get_message(WAIT_S).arbitration_id == 1
    finally:
        theirs.shutdown()
        ours.shutdown()
