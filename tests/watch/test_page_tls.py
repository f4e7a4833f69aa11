"""The page as it has to be served off loopback: TLS and a token. Tried on loopback, where the same code runs."""

import http.client
import os
import ssl
import subprocess
import sys

import pytest

from tests.watch.benches import write_bench
from tests.wire.rendezvous import short_folder

TOKEN = "a-token-of-enough-letters"


def make_certificate(folder):
    """A key and a certificate for localhost, signed by itself, `k.pem` and `c.pem`."""
    kind = ["-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"]
    name = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    files = ["-keyout", folder / "k.pem", "-out", folder / "c.pem"]
    subprocess.run(["openssl", "req", *kind, *name, *files], check=True, capture_output=True, timeout=60)


@pytest.fixture(scope="module")
def guarded():
    """(port, TLS context) of a `softloop page` with a certificate of its own and a token."""
    with short_folder() as folder:
        make_certificate(folder)
        (folder / "token").write_text(TOKEN)
        table = f'[page]\nport = 0\ncertificate = "{folder}/c.pem"\nkey = "{folder}/k.pem"\ntoken_file = "{folder}/token"\n'
        file = write_bench(folder, f"tls-{os.getpid()}", table)
        command = [sys.executable, "-m", "softloop.deploy.cli", "page", str(file)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                address = process.stdout.readline().split()[-1]
                assert address.startswith("https://")
                yield int(address.rstrip("/").rsplit(":", 1)[1]), ssl.create_default_context(cafile=folder / "c.pem")
            finally:
                process.terminate()
            assert process.wait(20) == 0


def ask(guarded, method, path, **headers):
    port, context = guarded
    connection = http.client.HTTPSConnection("localhost", port, timeout=20, context=context)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer


def test_without_the_token_nothing_is_served(guarded):
    for method, path in (("GET", "/"), ("GET", "/files/page.js"), ("POST", "/stop"), ("POST", "/request/arm")):
        assert ask(guarded, method, path).status == 403
    assert ask(guarded, "GET", "/?token=wrong").status == 403


def test_the_token_becomes_a_cookie_and_leaves_the_address(guarded):
    answer = ask(guarded, "GET", f"/?token={TOKEN}")
    assert (answer.status, answer.getheader("location")) == (303, "/")
    cookie = answer.getheader("set-cookie")
    assert all(word in cookie.lower() for word in ("httponly", "secure", "samesite=strict"))
    assert ask(guarded, "GET", "/", Cookie=cookie.split(";")[0]).status == 200
    assert ask(guarded, "POST", "/stop", Cookie=cookie.split(";")[0]).status == 503  # no bench is there to be stopped


def test_a_page_off_loopback_without_them_is_one_line():
    with short_folder() as folder:
        file = write_bench(folder, "open", '[page]\nhost = "0.0.0.0"\n')
        command = [sys.executable, "-m", "softloop.deploy.cli", "page", str(file)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 2
        assert "host 0.0.0.0 is not loopback: TLS and a token are needed" in done.stderr
        assert done.stderr.count("\n") == 1


def test_a_certificate_that_cannot_be_read_is_one_line():
    with short_folder() as folder:
        (folder / "token").write_text(TOKEN)
        table = f'[page]\nport = 0\ncertificate = "{folder}/c.pem"\nkey = "{folder}/k.pem"\ntoken_file = "{folder}/token"\n'
        command = [sys.executable, "-m", "softloop.deploy.cli", "page", str(write_bench(folder, "nocert", table))]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 3
        assert done.stderr.startswith("softloop: TLS: ")
        assert done.stderr.count("\n") == 1
