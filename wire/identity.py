"""The identity of a process on a secured bench: its certificate and key, judged before Zenoh sees them, for a clear word."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from time import gmtime
from typing import TYPE_CHECKING, Any

from softloop.wire.config import TlsConfig, ZenohConfig
from softloop.wire.errors import Unavailable
from softloop.wire.rights import FOLLOWER, LAUNCHER, RIGHTS, Rights, access_control, common_name, rights_of

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
    from cryptography.x509 import Certificate

AUTHORITY = "ca"
SOON = timedelta(days=14)
# A secured bench has some twenty sessions and messages of a few kilobytes: what wants more is not one of its own.
MAX_SESSIONS = 64
MAX_MESSAGE_BYTES = 1 << 20


@dataclass(frozen=True)
class Identity:
    """Who a session is.

    Attributes:
        name: of the identity, such as `controller` or `operator`.
        rights: what it may do.
        settings: what Zenoh is told: certificate and key, and the access rules of the bench.
        warning: one line for a person, or an empty text.
    """

    name: str
    rights: Rights
    settings: dict[str, Any]
    warning: str = ""


def certificate_file(folder: Path, name: str) -> Path:
    """Where an identity's certificate lies."""
    return folder / f"{name}.pem"


def key_file(folder: Path, name: str) -> Path:
    """Where an identity's key lies."""
    return folder / f"{name}.key"


def wall_now() -> datetime:
    """The computer's date and time, which validity is judged by; to the second."""
    return datetime(*gmtime()[:6], tzinfo=UTC)


def identity_of(config: ZenohConfig, bench: str, process: str) -> Identity | None:
    """The identity of a process, or None on a bench without TLS. Raises Unavailable, in one line, when it cannot be used."""
    if config.tls is None:
        return None
    name = _name_of(config.tls, process)
    warning = check_identity(Path(config.tls.folder), bench, name)
    rights = rights_of(name, config.tls.operators, config.tls.guests)
    return Identity(name, rights, settings(config.tls, bench, name), warning)


def _name_of(tls: TlsConfig, process: str) -> str:
    """The identity of a process of the rig, of a launcher, or of a person's command."""
    if process.startswith(f"{LAUNCHER}-"):
        return FOLLOWER
    return process if process in RIGHTS else _person(tls)


def _person(tls: TlsConfig) -> str:
    """Who a person's command is: as the bench file says, or the first whose key is here."""
    people = [tls.identity] if tls.identity else [*tls.operators, *tls.guests]
    here = next((name for name in people if key_file(Path(tls.folder), name).exists()), None)
    if here is None:
        raise Unavailable(f"{tls.folder}: no key of {' or '.join(people) or 'anybody'}; `softloop keys` makes them")
    return here


def settings(tls: TlsConfig, bench: str, name: str) -> dict[str, Any]:
    """What Zenoh is told of an identity: TLS on both ends of a link, and the bench's rules."""
    folder = Path(tls.folder).resolve()
    certificate, key = str(certificate_file(folder, name)), str(key_file(folder, name))
    return {
        "transport/link/tls": {
            "root_ca_certificate": str(certificate_file(folder, AUTHORITY)),
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
        "transport/link/protocols": ["tls", "quic"],
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        "transport/unicast/max_sessions": MAX_SESSIONS,
        "access_control": access_control(bench, tls.operators, tls.guests),
    }


def check_identity(folder: Path, bench: str, name: str) -> str:
    """See that an identity can be used now; returns a warning when it cannot be for much longer.

    Raises:
        Unavailable: a file is missing or open to others; or the certificate is of another bench, authority or time.
    """
    authority, own = load_certificate(folder, AUTHORITY), load_certificate(folder, name)
    _check_key(key_file(folder, name), own)
    where = certificate_file(folder, name)
    wanted, found = common_name(bench, name), own.subject.rfc4514_string().removeprefix("CN=")
    if found != wanted:
        raise Unavailable(f"{where}: is of '{found}', not of '{wanted}'")
    if not issued_by(own, authority):
        raise Unavailable(f"{where}: is not of the authority in {certificate_file(folder, AUTHORITY)}")
    for what, certificate in ((where, own), (certificate_file(folder, AUTHORITY), authority)):
        check_time(what, certificate)
    left = min(own.not_valid_after_utc, authority.not_valid_after_utc) - wall_now()
    return f"identity '{name}' expires in {left.days} days; see `softloop keys --renew`" if left < SOON else ""


def load_certificate(folder: Path, name: str) -> Certificate:
    """The certificate of an identity, or of the authority. Raises Unavailable."""
    from cryptography import x509  # noqa: PLC0415 - a bench without TLS needs none

    file = certificate_file(folder, name)
    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except OSError as error:
        raise Unavailable(f"{file}: cannot be read: {error.strerror}; `softloop keys` makes what is missing") from None
    except ValueError:
        raise Unavailable(f"{file}: is no certificate; {_anew(file)}") from None


def load_key(file: Path) -> PrivateKeyTypes:
    """The key of an identity, or of the authority. Raises Unavailable."""
    from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - as above
    from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415 - as above

    try:
        return load_pem_private_key(file.read_bytes(), None)
    except OSError as error:
        raise Unavailable(f"{file}: cannot be read: {error.strerror}; `softloop keys` makes what is missing") from None
    except (ValueError, TypeError, UnsupportedAlgorithm):
        raise Unavailable(f"{file}: is no key without a password; {_anew(file)}") from None


def is_key_of(key: PrivateKeyTypes, certificate: Certificate) -> bool:
    """Whether a key belongs to a certificate, whose own may be of a kind that nobody here knows."""
    from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - as above

    try:
        return key.public_key() == certificate.public_key()
    except (ValueError, UnsupportedAlgorithm):
        return False


def _anew(file: Path) -> str:
    """What helps where a certificate or a key is no good."""
    if file.stem == AUTHORITY:
        return "bring back the right one, or `softloop keys --renew --authority` makes everybody's keys anew"
    return "`softloop keys --renew` makes it anew"


def issued_by(certificate: Certificate, authority: Certificate) -> bool:
    """Whether the authority signed a certificate."""
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm  # noqa: PLC0415 - as above

    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature, UnsupportedAlgorithm):
        return False
    return True


def _check_key(file: Path, certificate: Certificate) -> None:
    key = load_key(file)
    if stat.S_IMODE(file.stat().st_mode) & 0o077:
        raise Unavailable(f"{file}: others may read it; chmod 600 it, and make it anew if they did")
    if not is_key_of(key, certificate):
        raise Unavailable(f"{file}: is not the key of the certificate beside it; `softloop keys --renew` makes both anew")


def check_time(file: Path, certificate: Certificate) -> None:
    """See that a certificate is good now. Raises Unavailable."""
    now = wall_now()
    if now > certificate.not_valid_after_utc:
        raise Unavailable(f"{file}: expired on {certificate.not_valid_after_utc:%Y-%m-%d}; {_anew(file)}")
    if now < certificate.not_valid_before_utc:
        raise Unavailable(
            f"{file}: is good from {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC only; is this computer's clock right?"
        )
