"""The rig on three computers of a `Network`: its bench file for a network of a given quality, its keys, and its launchers."""

from contextlib import contextmanager

from softloop.deploy.bench import shipped_benches
from tests.net.cable import Way
from tests.rig.fleets import fleet
from tests.security.secured import make

LEADER, BOARD, LOGGER = "desk", "board", "logger"
AHEAD_S = {LEADER: 0, BOARD: 1000, LOGGER: -400}  # of the machine's monotonic clock
SHARES = {"plant": BOARD, "valves": BOARD, "pressures": BOARD, "inclinometer": BOARD, "controller": LEADER, "recorder": LOGGER}
HOLD_TICKS = 12
PORT, SERIAL_PORT = 7447, 7448  # in namespaces of our own: nobody else has them


def bench_text(network, way: Way, *, over="tls", mode="peer", shared_router=False, duration_s=0.0):
    """The shipped T2 bench on three hosts, over TLS on TCP or on QUIC, that declares what the network costs.

    Budgets are wide, as in all tests of whole rigs: a stall of a busy machine is not the network's. On a cable that loses packets
    they are as wide as the gate allows over TCP, where all waits for one that is sent again. Over QUIC the next one is there a
    tick later, and no budget is for loss.
    """
    one_way_ms = way.delay_ms + way.jitter_ms
    waits = way.loss and over == "tls"
    ticks = {"hold_ticks": 20, "age_ticks": 20} if waits else {"hold_ticks": HOLD_TICKS, "age_ticks": 16}
    wait_ms = 100.0 if waits else 80.0
    tables = {
        "zenoh": {"mode": mode, "endpoint": f"{over}/{network.address_of(LEADER)}:{PORT}"},
        "zenoh.tls": {"folder": "{bench_dir}/keys"},
        "run": {"shared_router": shared_router, "duration_s": duration_s, "report": False, "ready_timeout_s": 120.0},
        "clock": {"uncertainty_max_ms": 3.0 + 2.0 * one_way_ms},
        **{f"hosts.{name}": {"address": network.address_of(name)} for name in network.hosts},
        **{process: {"host": host} for process, host in SHARES.items()},
    }
    tables["plant"] |= {"serial": f"listen://127.0.0.1:{SERIAL_PORT}", "watchdog_ms": 100.0}
    tables["inclinometer"] |= {"port": f"socket://127.0.0.1:{SERIAL_PORT}"}
    tables["valves"] |= {"path_delay_ms": 2.0 + 2.0 * one_way_ms, "driver_silence_ms": 100.0, **ticks}
    tables["controller"] |= {
        "actuation_delay_ms": 3.0 + way.delay_ms + way.jitter_ms / 2,
        "pressure_budget_ms": 20.0 + one_way_ms + wait_ms,
        "inclination_budget_ms": 30.0 + one_way_ms + wait_ms,
    }
    head = f'base = "{shipped_benches()["sim_t2"]}"\nname = "net"\n'
    return head + "".join(f"[{name}]\n{lines(keys)}" for name, keys in tables.items())


def lines(keys):
    return "".join(f"{key} = {value_of(value)}\n" for key, value in keys.items())


def value_of(value):
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)


@contextmanager
def rig_on(network, text, *, router_on=""):
    """Keys made, a router where one is wanted, and the launchers of all hosts started, none of which outlives the block."""
    with fleet(text) as rigs:
        make(rigs.bench)
        if router_on:
            rigs.start_router(network.hosts[router_on].inside([]))
        for name, host in network.hosts.items():
            rigs.start(name, inside=host.inside([]))
        yield rigs
