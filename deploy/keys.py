"""`softloop keys`: the certificate authority of a bench, and one identity for each of its processes and people."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from softloop.deploy.bench import PROCESS_NAMES, Bench, find_bench, load_bench
from softloop.deploy.zenohd import nested
from softloop.wire.config import TlsConfig
from softloop.wire.errors import EXIT_OK, BadConfig, Unavailable
from softloop.wire.identity import (
    AUTHORITY,
    Identity,
    certificate_file,
    check_time,
    is_key_of,
    issued_by,
    key_file,
    load_certificate,
    load_key,
    settings,
    wall_now,
)
from softloop.wire.rights import FOLLOWER, LAUNCHER, RIGHTS, ROUTER, common_name
from softloop.wire.zenoh_settings import settings_of

ZENOHD = "zenohd.json5"
AUTHORITY_DAYS = 3650
# The clocks of a bench's computers may differ before they are set: what is made now was good yesterday.
EARLIER = timedelta(days=1)
HERE = ("localhost", "127.0.0.1", "::1")


def identities_of(bench: Bench) -> list[str]:
    """Everybody who is somebody on a bench: the meeting point, its processes, its people. Raises BadConfig without TLS."""
    tls = _tls(bench)
    processes = (name for name in PROCESS_NAMES if getattr(bench, name) is not None)
    launchers = [LAUNCHER, FOLLOWER] if bench.hosts else [LAUNCHER]
    return [ROUTER, *launchers, *processes, *tls.operators, *tls.guests]


def make_keys(bench_file: Path, *, renew: bool, only: Collection[str], authority: bool, days: int | None) -> int:
    """Make what is missing, or with `renew` everything (or those in `only`) anew.

    Raises:
        BadConfig: the bench has no `[zenoh.tls]`, or no such identity.
        Unavailable: all is there already, or a file cannot be written.
    """
    bench = load_bench(find_bench(bench_file))
    tls, everybody = _tls(bench), identities_of(bench)
    unknown = sorted(set(only) - set(everybody))
    if unknown:
        raise BadConfig(f"bench '{bench.name}' has no identity '{unknown[0]}'; it has: {', '.join(everybody)}")
    maker = _Maker(bench, tls, days or tls.valid_days)
    wanted = [name for name in everybody if not only or name in only]
    with _told(maker.folder):
        maker.begin(anew=renew and authority)
        made = [name for name in wanted if renew or not maker.is_there(name)]
        if not made:
            raise Unavailable(f"{maker.folder}: all {len(wanted)} identities are there; --renew makes them anew")
        for name in made:
            maker.make(name)
        maker.write_router()
    print(f"{maker.folder}: {', '.join(made)}; good until {maker.until:%Y-%m-%d}", flush=True)
    return EXIT_OK


def _tls(bench: Bench) -> TlsConfig:
    if bench.zenoh.tls is None:
        raise BadConfig(f"bench '{bench.name}' has no table [zenoh.tls] and no need of keys; see docs/security.md")
    return bench.zenoh.tls


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """Errors of the file system in one line."""
    try:
        yield
    except OSError as error:
        raise Unavailable(f"{error.filename or folder}: {error.strerror or error}") from None


class _Maker:
    """Makes identities in a folder; the authority's key is read once."""

    def __init__(self, bench: Bench, tls: TlsConfig, days: int) -> None:
        self.bench, self.tls, self.days = bench, tls, days
        self.folder = Path(tls.folder)
        self.until = wall_now()

    def begin(self, *, anew: bool) -> None:
        """Have an authority: the one in the folder, or a new one, with which every older identity is void."""
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if anew or not certificate_file(self.folder, AUTHORITY).exists():
            self._make_authority()
        self.authority = load_certificate(self.folder, AUTHORITY)
        check_time(certificate_file(self.folder, AUTHORITY), self.authority)
        self.authority_key = self._authority_key()

    def _authority_key(self) -> ec.EllipticCurvePrivateKey:
        file = key_file(self.folder, AUTHORITY)
        if not file.exists():
            raise Unavailable(f"{file}: the authority's key is not here; identities are made where it is kept")
        key = load_key(file)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise Unavailable(f"{file}: is no elliptic-curve key; bring back the one that `softloop keys` made")
        if not is_key_of(key, self.authority):
            raise Unavailable(
                f"{file}: is not the key of {certificate_file(self.folder, AUTHORITY)}; bring back the two of one pair"
            )
        return key

    def _make_authority(self) -> None:
        key = ec.generate_private_key(ec.SECP256R1())
        name = _name(f"{self.bench.name} authority")
        usage = x509.KeyUsage(
            digital_signature=False, content_commitment=False, key_encipherment=False, data_encipherment=False,
            key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
        )  # fmt: skip
        builder = _builder(name, name, key, wall_now() + timedelta(days=AUTHORITY_DAYS))
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(usage, critical=True)
        self._write(AUTHORITY, key, builder.sign(key, SHA256()))

    def is_there(self, name: str) -> bool:
        """Whether an identity of this authority is in the folder."""
        if not (certificate_file(self.folder, name).exists() and key_file(self.folder, name).exists()):
            return False
        return issued_by(load_certificate(self.folder, name), self.authority)

    def make(self, name: str) -> None:
        """One identity. A person's is good for connecting alone: nobody can be the meeting point with it."""
        key = ec.generate_private_key(ec.SECP256R1())
        self.until = min(wall_now() + timedelta(days=self.days), self.authority.not_valid_after_utc)
        builder = _builder(_name(common_name(self.bench.name, name)), self.authority.subject, key, self.until)
        uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if name in RIGHTS else [])]
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        builder = builder.add_extension(x509.SubjectAlternativeName(list(self._hosts())), critical=False)
        own = x509.AuthorityKeyIdentifier.from_issuer_public_key(self.authority_key.public_key())
        self._write(name, key, builder.add_extension(own, critical=False).sign(self.authority_key, SHA256()))

    def _hosts(self) -> Iterator[x509.GeneralName]:
        where = self.bench.zenoh.endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
        machines = [machine.address for machine in self.bench.hosts.values() if machine.address]
        for host in dict.fromkeys((where, *machines, *self.tls.names, *HERE)):
            try:
                yield x509.IPAddress(ip_address(host))
            except ValueError:
                yield x509.DNSName(host)

    def _write(self, name: str, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
        secret = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        _put(key_file(self.folder, name), secret, 0o600)
        _put(certificate_file(self.folder, name), certificate.public_bytes(Encoding.PEM), 0o644)

    def write_router(self) -> None:
        """The configuration of a `zenohd` at the meeting point; softloop's own processes have the rules from the table itself."""
        zenoh = self.bench.zenoh
        identity = Identity(ROUTER, RIGHTS[ROUTER], settings(self.tls, self.bench.name, ROUTER))
        told = settings_of("router", [zenoh.endpoint], [], zenoh.lease_ms, identity=identity)
        _put(self.folder / ZENOHD, json.dumps(nested(told), indent=1).encode(), 0o644)


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _builder(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, until: datetime) -> x509.CertificateBuilder:
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number()).not_valid_before(wall_now() - EARLIER).not_valid_after(until)
    return builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)


def _put(file: Path, data: bytes, mode: int) -> None:
    """Write a file that is whole or not there, and never open to more than `mode` says."""
    new = file.with_name(f".{file.name}.{os.getpid()}")
    fd = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    with os.fdopen(fd, "wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(fd)
    new.replace(file)
