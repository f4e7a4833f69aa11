"""Good inputs, from which the fuzz campaign makes others: small ones, so that a change meets what matters and a run is short."""

from io import BytesIO

import tomlkit
from pydantic import BaseModel

from softloop.deploy.bench import Bench, shipped_benches
from softloop.dynamics.parameters import load_parameters, shipped
from softloop.wire.channels import CAN, REQUEST, can_key, key
from softloop.wire.mcap_chunks import ChunkedWriter
from softloop.wire.mcap_layout import LIBRARY, MESSAGE_ENCODING, METADATA_NAME, PROFILE, SCHEMA_ENCODING, Origin, topic_of_key
from softloop.wire.messages import message
from tests.offline import synthetic

# The least that the tables of processes ask for beside themselves.
RIG = {"name": "x", "can": {"can0": {}}, "valves": {}, "pressures": {}, "inclinometer": {"port": "x"}, "controller": {}}
NEEDED = {"inclinometer": {"port": "x"}, "calibration": {"tank_ml": 100.0}}
MORE_BENCHES = (
    b'base = "base.toml"\nwithout = ["run"]\n[recorder]\n',
    b'base = "base.toml"\npieces = ["piece.toml"]\n',
    b'name = "x"\n[[faults.injections]]\nkind = "zenoh_drop"\ntarget = "command"\nat_s = 2.0\nprobability = 0.5\n',
    b'name = "x"\n[can.can0]\n[plant]\n[[plant.faults]]\nkind = "chamber_bias"\non_s = 1\noff_s = 2\nsize = 3\n',
    b'name = "x"\n[hosts.a]\naddress = "127.0.0.2"\n[hosts.b]\n[recorder]\nhost = "a"\n[controller]\nhost = "b"\n',
    b'name = "x"\n[zenoh]\nmode = "client"\nendpoint = "tls/10.0.0.1:7447"\n[zenoh.tls]\nfolder = "keys"\n',
    b'name = "x"\n[zenoh]\nendpoint = "quic/10.0.0.1:7447"\n[zenoh.tls]\nfolder = "keys"\n',
)
EVIDENCE = '[evidence]\nrig="r"\nmethod="m"\nsoftloop="0"\nparameters=["a0"]\ncovariance=[[1.0]]\n[[evidence.runs]]\nname="a"\n'
EVIDENCE += f'sha256="{"0" * 64}"\nstart_s=0\nend_s=1\nfit_percent=90\ntrained=true\n'


def bench_files(folder):
    """A file for each key of each table, by its default value; the tables in other forms; and those that come with softloop."""
    (folder / "base.toml").write_text('name = "b"\n[run]\narm = false\n[monitor]\n[controller]\n')
    (folder / "piece.toml").write_text("[controller]\napproach_s = 2.0\n")
    shipped_ones = {path.name: path.read_bytes() for path in shipped_benches().values()}
    for name, content in shipped_ones.items():  # bases of each other
        (folder / name).write_bytes(content)
    tables = [name for name, field in Bench.model_fields.items() if _model_of(field.annotation) is not None]
    return [
        *(text for name in tables for text in _files_of(name)),
        *MORE_BENCHES,
        *shipped_ones.values(),
    ]


def _model_of(annotation):
    """The table a field of the bench holds, or None."""
    found = [
        one for one in (annotation, *getattr(annotation, "__args__", ())) if isinstance(one, type) and issubclass(one, BaseModel)
    ]
    return found[0] if found and not hasattr(annotation, "__origin__") else None


def _files_of(table):
    needed = NEEDED.get(table, {})
    beside = (
        RIG if table in ("plant", "valves", "pressures", "inclinometer", "controller", "monitor", "shadow") else {"name": "x"}
    )
    values = _model_of(Bench.model_fields[table].annotation)(**needed).model_dump(mode="json", exclude_none=True)
    return [tomlkit.dumps(beside | {table: needed | {name: value}}).encode() for name, value in values.items()]


def parameter_files():
    """Single tables, which are read before one hears that others are missing; whole files, short; the shipped one."""
    tables = load_parameters(shipped()).model_dump(exclude_none=True)
    single = [f'name="x"\n{_table(name, values)}' for name, values in tables.items() if name != "name"]
    whole = 'name="x"\n' + "".join(_table(name, values) for name, values in tables.items() if name != "name")
    small = [*single, whole, whole + EVIDENCE, f'name="x"\n{EVIDENCE}']
    return [*(text.encode() for text in small), shipped().read_bytes()]


def _table(name, values):
    return f"[{name}]\n" + "".join(f"{key}={_value(value)}\n" for key, value in values.items())


def _value(value):
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}={number:.3g}" for key, number in value.items()) + "}"
    return f"{value:.3g}"


def log_files(folder):
    """Small logs of two channels, finished and cut off, in two chunks and in one; and, one in fifty, logs of all channels."""
    small = [_small_log(finish, size) for finish in (True, False) for size in (1200, 4000)]
    made = list(synthetic.messages(0.02))
    whole = [
        synthetic.write_log(folder / "seed.mcap", made, finish=f, chunk_bytes=n).read_bytes()
        for f, n in ((True, 600), (False, 4000))
    ]
    return small * 25 + whole


def _small_log(finish, chunk_bytes):
    stream = BytesIO()
    writer = ChunkedWriter(stream, PROFILE, LIBRARY, chunk_bytes)
    writer.add_attachment(1000, "git.json", "application/json", synthetic.GIT)
    writer.add_metadata(METADATA_NAME, Origin("b", 1000, 0).as_metadata())
    lanes = []
    for channel, full_key in ((REQUEST, key("b", REQUEST)), (CAN, can_key("b", "can0", 0x80))):
        kind = message(channel.message)
        schema = writer.add_schema(kind.ros_name, SCHEMA_ENCODING, kind.text.encode())
        lanes.append((kind, writer.add_channel(topic_of_key(full_key), MESSAGE_ENCODING, schema)))
    for seq in range(1, 4):
        for kind, channel_id in lanes:
            writer.add_message(channel_id, 1000 + seq, seq, kind.pack(kind.make(seq=seq, stamp_ns=seq)))
    writer.flush()
    if finish:
        writer.finish()
    return stream.getvalue()
