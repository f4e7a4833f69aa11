"""A bench with [zenoh.tls] on loopback, its keys, and sessions of those who should not be there."""

import socket
from contextlib import contextmanager, redirect_stdout
from datetime import timedelta
from io import StringIO
from pathlib import Path

import zenoh

from softloop.deploy import keys
from softloop.deploy.bench import load_bench
from softloop.wire.identity import wall_now
from tests.security.attackers import attackers_config
from tests.wire.rendezvous import short_folder

NAME = "sec"


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def zenoh_table(folder, mode="client", over="tls"):
    """[zenoh] with TLS at a port of its own, and keys in `folder`."""
    where = f'mode = "{mode}"\nendpoint = "{over}/127.0.0.1:{free_port()}"'
    return f'[zenoh]\n{where}\n[zenoh.tls]\nfolder = "{folder}/keys"\n'


def write_secured(folder, mode="client", more="", over="tls"):
    """A bench of every process, as a file."""
    file = folder / "b.toml"
    file.write_text(
        f'name = "{NAME}"\n{zenoh_table(folder, mode, over)}[host]\nrealtime_priority = 0\n[can.can0]\n[plant]\n[valves]\n'
        f'[pressures]\n[inclinometer]\nport = "/dev/null"\n[controller]\n[recorder]\n[monitor]\n{more}'
    )
    return file


def make(file, **options):
    """`softloop keys`; what it printed."""
    with redirect_stdout(StringIO()) as said:
        keys.make_keys(file, **{"renew": False, "only": (), "authority": False, "days": None, **options})
    return said.getvalue()


class Secured:
    """A bench, and the folders of those who attack it.

    Attributes:
        bench: with its keys in `keys`.
        wrong: keys of the same names by another authority.
        expired: keys by the right authority, good until yesterday.
    """

    def __init__(self, folder, file):
        self.folder, self.file, self.bench = folder, file, load_bench(file)
        self.keys, self.wrong, self.expired = Path(self.bench.zenoh.tls.folder), folder / "wrong", folder / "expired"
        make(file)
        make(self._elsewhere(self.wrong))
        self.expired.mkdir()
        for name in ("ca.pem", "ca.key"):
            (self.expired / name).write_bytes((self.keys / name).read_bytes())
        now, keys.wall_now = keys.wall_now, lambda: wall_now() - timedelta(days=10)
        try:
            make(self._elsewhere(self.expired), days=9)
        finally:
            keys.wall_now = now

    def _elsewhere(self, keys_folder):
        file = keys_folder.with_suffix(".toml")
        file.write_text(self.file.read_text().replace(str(self.keys), str(keys_folder)))
        return file

    @contextmanager
    def attacker(self, folder, name, mode="client"):
        """A session, or None where none is given."""
        try:
            session = zenoh.open(attackers_config(self.bench, folder, name, mode))
        except zenoh.ZError:
            yield None
            return
        with session:
            yield session


@contextmanager
def secured(mode="client", more="", over="tls"):
    with short_folder() as folder:
        yield Secured(folder, write_secured(folder, mode, more, over))
