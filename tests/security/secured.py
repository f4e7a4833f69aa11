"""A bench with [zenoh.tls] on loopback, its keys, and sessions of those who should not be there."""

import json
import socket
from contextlib import contextmanager, redirect_stdout
from datetime import timedelta
from io import StringIO
from pathlib import Path

import zenoh

from softloop.deploy import keys
from softloop.deploy.bench import load_bench
from softloop.wire.identity import Identity, identity_of, settings, wall_now
from softloop.wire.session import make_config
from tests.wire.rendezvous import short_folder

NAME = "sec"


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def write_secured(folder, mode="client", more="", tls="", name=NAME):
    """A bench of every process, at a port of its own; `more` is TOML behind its tables."""
    file = folder / "b.toml"
    file.write_text(
        f'name = "{name}"\n[zenoh]\nmode = "{mode}"\nendpoint = "tls/127.0.0.1:{free_port()}"\n'
        f'[zenoh.tls]\nfolder = "{folder}/keys"\n{tls}\n[host]\nrealtime_priority = 0\n[can.can0]\n[plant]\n[valves]\n'
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
        bench: with its keys, in `keys`.
        wrong: keys of the same names by another authority.
        expired: keys by the right authority, good until yesterday.
    """

    def __init__(self, folder, mode, more=""):
        self.folder = folder
        self.file = write_secured(folder, mode, more)
        self.bench = load_bench(self.file)
        make(self.file)
        self.wrong, self.expired = folder / "wrong", folder / "expired"
        make(self._elsewhere(self.wrong))
        self.expired.mkdir()
        for name in ("ca.pem", "ca.key"):
            (self.expired / name).write_bytes((folder / "keys" / name).read_bytes())
        now, keys.wall_now = keys.wall_now, lambda: wall_now() - timedelta(days=10)
        try:
            make(self._elsewhere(self.expired), days=9)
        finally:
            keys.wall_now = now

    def _elsewhere(self, keys_folder):
        file = keys_folder.with_suffix(".toml")
        file.write_text(self.file.read_text().replace(f"{self.folder}/keys", str(keys_folder)))
        return file

    def config(self, folder, name, mode="client"):
        """Zenoh's configuration of an attacker: certificate and key of an identity, and no rules. `name` "": no certificate."""
        tls = self.bench.zenoh.tls.model_copy(update={"folder": str(folder)})
        told = settings(tls, NAME, name or "guest")
        del told["access_control"]
        if not name:
            own = ("connect_certificate", "connect_private_key", "enable_mtls")
            told["transport/link/tls"] = {k: v for k, v in told["transport/link/tls"].items() if k not in own}
        identity = Identity(name, identity_of(self.bench.zenoh, NAME, "router").rights, told)
        listen = [] if mode == "client" else ["tls/127.0.0.1:0"]
        config = make_config(mode, listen, [self.bench.zenoh.endpoint], 5000, listen_must_work=False, identity=identity)
        config.insert_json5("connect/timeout_ms", json.dumps(1500))
        return config

    @contextmanager
    def attacker(self, folder, name, mode="client"):
        """A session, or None where none is given."""
        try:
            session = zenoh.open(self.config(folder, name, mode))
        except zenoh.ZError:
            yield None
            return
        with session:
            yield session

    @property
    def keys(self):
        return Path(self.bench.zenoh.tls.folder)


@contextmanager
def secured(mode="client", more=""):
    with short_folder() as folder:
        yield Secured(folder, mode, more)
