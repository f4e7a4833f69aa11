"""`softloop keys`: what it makes, how it is kept, and what is refused before Zenoh is asked."""

import stat
import subprocess
import sys
import time
from datetime import timedelta

import pytest
import zenoh
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
)

from softloop.deploy import keys
from softloop.deploy.bench import load_bench
from softloop.wire import identity as i
from softloop.wire.channels import COMMAND
from softloop.wire.errors import BadConfig, Unavailable
from softloop.wire.identity import certificate_file, check_identity, issued_by, key_file, load_certificate, wall_now
from softloop.wire.session import open_wire
from tests.security.secured import NAME, make, write_secured


@pytest.fixture
def file(tmp_path):
    return write_secured(tmp_path)


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_one_identity_for_each_process_and_person(file, tmp_path):
    folder = tmp_path / "keys"
    said = make(file)
    everybody = keys.identities_of(load_bench(file))
    assert set(everybody) == {
        "router", "launcher", "plant", "valves", "pressures", "inclinometer", "controller", "recorder", "monitor",
        "operator", "guest",
    }  # fmt: skip
    assert all(name in said for name in everybody)
    authority = load_certificate(folder, "ca")
    for name in everybody:
        certificate = load_certificate(folder, name)
        assert certificate.subject.rfc4514_string() == f"CN={NAME}.{name}"
        assert issued_by(certificate, authority)
        assert check_identity(folder, NAME, name) == ""
    assert not issued_by(load_certificate(folder, "guest"), load_certificate(folder, "router"))


def test_keys_are_readable_by_their_owner_alone(file, tmp_path):
    make(file)
    assert stat.S_IMODE((tmp_path / "keys").stat().st_mode) == 0o700
    for path in (tmp_path / "keys").glob("*.key"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert not list((tmp_path / "keys").glob(".*"))
    key_file(tmp_path / "keys", "guest").chmod(0o640)
    with pytest.raises(Unavailable, match="others may read it"):
        check_identity(tmp_path / "keys", NAME, "guest")


def test_a_persons_certificate_is_none_to_be_connected_to(file, tmp_path):
    make(file)
    for name, listens in (("guest", False), ("operator", False), ("router", True), ("valves", True)):
        uses = load_certificate(tmp_path / "keys", name).extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (x509.ExtendedKeyUsageOID.SERVER_AUTH in uses) == listens
    names = load_certificate(tmp_path / "keys", "router").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "localhost" in names.get_values_for_type(x509.DNSName)
    assert "127.0.0.1" in map(str, names.get_values_for_type(x509.IPAddress))


def test_nothing_is_overwritten_without_being_asked(file, tmp_path):
    make(file)
    before = content(tmp_path / "keys")
    with pytest.raises(Unavailable, match="--renew makes them anew"):
        make(file)
    assert content(tmp_path / "keys") == before


def test_only_what_is_missing_is_made(file, tmp_path):
    make(file)
    before = content(tmp_path / "keys")
    key_file(tmp_path / "keys", "guest").unlink()
    assert "guest" in make(file)
    after = content(tmp_path / "keys")
    assert {name for name in before if before[name] != after[name]} == {"guest.key", "guest.pem"}


def test_renewed_identities_are_of_the_same_authority(file, tmp_path):
    make(file)
    before = content(tmp_path / "keys")
    make(file, renew=True, only=["valves"], days=3)
    after = content(tmp_path / "keys")
    assert {name for name in before if before[name] != after[name]} == {"valves.key", "valves.pem"}
    assert "'valves' expires in" in check_identity(tmp_path / "keys", NAME, "valves")
    make(file, renew=True)
    again = content(tmp_path / "keys")
    assert again["ca.pem"] == before["ca.pem"]
    assert all(again[name] != before[name] for name in before if name not in ("ca.pem", "ca.key", "zenohd.json5"))


def test_a_new_authority_makes_all_older_keys_void(file, tmp_path):
    make(file)
    stolen = content(tmp_path / "keys")
    make(file, renew=True, authority=True)
    assert content(tmp_path / "keys")["ca.pem"] != stolen["ca.pem"]
    for name in ("guest.pem", "guest.key"):
        (tmp_path / "keys" / name).write_bytes(stolen[name])
    key_file(tmp_path / "keys", "guest").chmod(0o600)
    with pytest.raises(Unavailable, match="is not of the authority"):
        check_identity(tmp_path / "keys", NAME, "guest")
    assert "guest" in make(file)  # of another authority: as good as missing


def test_a_folder_without_the_authoritys_key_makes_nothing(file, tmp_path):
    make(file)
    key_file(tmp_path / "keys", "ca").unlink()
    with pytest.raises(Unavailable, match="the authority's key is not here"):
        make(file, renew=True)
    assert check_identity(tmp_path / "keys", NAME, "valves") == ""


KEY = ec.generate_private_key(ec.SECP256R1())


def pem(key, password=None):
    shut = BestAvailableEncryption(password) if password else NoEncryption()
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, shut)


def one_line(file, *words):
    """What `softloop keys` says on standard error, with exit code 3."""
    command = [sys.executable, "-m", "softloop.deploy.cli", "keys", str(file), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (3, "", 1), done.stderr
    return done.stderr


@pytest.mark.parametrize(
    ("secret", "said"),
    [
        (b"", "is no key without a password"),
        (b"nonsense", "is no key without a password"),
        (b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n", "is no key without a password"),
        (b"\xff\x00" * 40, "is no key without a password"),
        (pem(KEY, b"secret"), "is no key without a password"),
        (KEY.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo), "is no key without a password"),
        (pem(ed25519.Ed25519PrivateKey.generate()), "is no elliptic-curve key"),
        (pem(KEY), "is not the key of"),
    ],
    ids=["empty", "text", "garbled", "bytes", "password", "public", "ed25519", "another"],
)
def test_an_authoritys_key_that_is_none_is_said_and_nothing_is_made(file, tmp_path, secret, said):
    make(file)
    key_file(tmp_path / "keys", "ca").write_bytes(secret)
    before = content(tmp_path / "keys")
    with pytest.raises(Unavailable, match=f"ca.key: {said}.*bring back"):
        make(file, renew=True)
    assert content(tmp_path / "keys") == before


def test_the_command_says_what_is_wrong_with_an_authority(file, tmp_path):
    make(file)
    key_file(tmp_path / "keys", "ca").write_bytes(b"")
    assert "ca.key: is no key without a password; bring back the right one" in one_line(file, "--renew")
    certificate_file(tmp_path / "keys", "ca").write_bytes(b"")
    assert "ca.pem: is no certificate; bring back the right one" in one_line(file, "--renew")
    make(file, renew=True, authority=True)  # as the line says
    assert check_identity(tmp_path / "keys", NAME, "valves") == ""


@pytest.mark.parametrize("whose", ["ca.key", "guest.pem", "nonsense", "garbled"])
def test_an_authoritys_certificate_that_is_none_is_said_and_nothing_is_made(file, tmp_path, whose):
    make(file)
    folder = tmp_path / "keys"
    good = certificate_file(folder, "ca").read_bytes()
    of = {"nonsense": b"nonsense", "garbled": good.replace(b"\nMII", b"\nAAA")}
    certificate_file(folder, "ca").write_bytes(of.get(whose) or (folder / whose).read_bytes())
    before = content(folder)
    with pytest.raises(Unavailable, match=r"ca.pem(: is no certificate; |; )bring back"):
        make(file, renew=True)
    assert content(folder) == before


def test_an_authority_that_has_expired_makes_nothing(file, tmp_path, monkeypatch):
    make(file)
    before = content(tmp_path / "keys")
    for where in (i, keys):
        monkeypatch.setattr(where, "wall_now", lambda: wall_now() + timedelta(days=keys.AUTHORITY_DAYS + 2))
    with pytest.raises(Unavailable, match=r"ca.pem: expired on .*--renew --authority"):
        make(file, renew=True)
    assert content(tmp_path / "keys") == before


def test_a_key_of_a_kind_that_nobody_here_knows_is_none(tmp_path, monkeypatch):
    def unknown(data, password):
        raise UnsupportedAlgorithm("a curve of tomorrow")

    monkeypatch.setattr("cryptography.hazmat.primitives.serialization.load_pem_private_key", unknown)
    (tmp_path / "ca.key").write_bytes(pem(KEY))
    with pytest.raises(Unavailable, match="is no key without a password"):
        i.load_key(tmp_path / "ca.key")


def test_what_cannot_be_used_is_said_before_zenoh_is_asked(file, tmp_path, monkeypatch):
    folder = tmp_path / "keys"
    with pytest.raises(Unavailable, match=r"cannot be read.*softloop keys"):
        check_identity(folder, NAME, "valves")
    make(file)
    with pytest.raises(Unavailable, match=r"is of 'sec\.valves', not of 'other\.valves'"):
        check_identity(folder, "other", "valves")
    for days, words in ((400, "expired on"), (-3, "clock right")):
        monkeypatch.setattr(i, "wall_now", lambda days=days: wall_now() + timedelta(days=days))
        with pytest.raises(Unavailable, match=words):
            check_identity(folder, NAME, "valves")
    monkeypatch.setattr(i, "wall_now", wall_now)
    key_file(folder, "valves").write_bytes(key_file(folder, "guest").read_bytes())
    with pytest.raises(Unavailable, match="is not the key of the certificate"):
        check_identity(folder, NAME, "valves")
    key_file(folder, "valves").write_bytes(b"nonsense")
    with pytest.raises(Unavailable, match="is no key"):
        check_identity(folder, NAME, "valves")
    certificate_file(folder, "valves").write_bytes(b"nonsense")
    with pytest.raises(Unavailable, match="is no certificate"):
        check_identity(folder, NAME, "valves")


def test_an_identity_is_not_good_for_longer_than_its_authority(file, tmp_path):
    make(file, days=3650)
    authority = load_certificate(tmp_path / "keys", "ca")
    assert load_certificate(tmp_path / "keys", "valves").not_valid_after_utc <= authority.not_valid_after_utc


def test_whom_a_persons_command_is(file, tmp_path):
    make(file)
    zenoh = load_bench(file).zenoh
    who = lambda config: i.identity_of(config, NAME, "request-arm").name  # noqa: E731
    assert who(zenoh) == "operator"
    assert i.identity_of(zenoh, NAME, "valves").name == "valves"
    as_guest = zenoh.model_copy(update={"tls": zenoh.tls.model_copy(update={"identity": "guest"})})
    assert who(as_guest) == "guest"
    key_file(tmp_path / "keys", "operator").unlink()
    assert who(zenoh) == "guest"
    key_file(tmp_path / "keys", "guest").unlink()
    with pytest.raises(Unavailable, match="no key of operator or guest"):
        who(zenoh)


def test_wrong_names_and_benches_without_tls(file, tmp_path):
    with pytest.raises(BadConfig, match="no identity 'eve'"):
        make(file, only=["eve"])
    plain = tmp_path / "plain.toml"
    plain.write_text('name = "plain"\n')
    with pytest.raises(BadConfig, match="no table"):
        make(plain)
    (tmp_path / "blocked").write_text("")
    blocked = tmp_path / "blocked.toml"
    blocked.write_text(file.read_text().replace("/keys", "/blocked"))
    with pytest.raises(Unavailable, match=r"File exists|Not a directory"):
        make(blocked)


def test_the_command_line(file):
    def softloop(*words):
        command = [sys.executable, "-m", "softloop.deploy.cli", "keys", str(file), *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

    assert softloop().returncode == 0
    for words, code in (((), 3), (("--authority",), 2), (("--renew", "--authority", "--only", "guest"), 2), (("--days", "0"), 2)):
        done = softloop(*words)
        assert (done.returncode, done.stderr.count("\n")) == (code, 1), done.stderr
    assert softloop("--renew", "--only", "guest", "--days", "30").returncode == 0


def test_the_file_for_zenohd_is_a_whole_configuration(file, tmp_path):
    make(file)
    bench = load_bench(file)
    with (
        zenoh.open(zenoh.Config.from_file(str(tmp_path / "keys" / keys.ZENOHD))),
        open_wire(bench.zenoh, NAME, "controller") as controller,
        open_wire(bench.zenoh, NAME, "valves") as gate,
    ):
        commands, put = gate.inbox(COMMAND), controller.publisher(COMMAND)
        end = time.monotonic() + 20.0
        while commands.take(0.05) is None:
            put(b"x")
            assert time.monotonic() < end, "nothing passes"
