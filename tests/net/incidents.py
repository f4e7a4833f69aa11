"""A cut cable, and a router that is killed: the gate vents, no process is restarted, and one word of a person goes on."""

import signal
import subprocess
import sys
import time

from softloop.offline.run_log import open_run
from softloop.wire.messages import constant
from tests.net.cable import Way
from tests.net.figures import COIL_OFF_MA, first_after, gate_events
from tests.net.hosts import HOLD_TICKS, LEADER, LOGGER, bench_text, rig_on
from tests.rig.fleets import CLI

ARMED, FAULT = constant("ValveStatus", "GATE_ARMED"), constant("ValveStatus", "GATE_FAULT")
AWAY_S = 2.0
DURATION_S = 40.0  # armed, with what is cut out of it
# From the cut to no current: the budget of silence, the tick that finds it, its frame on the bus, the coil; two ticks of a busy
# machine on top.
VENT_MS = (HOLD_TICKS + 1) * 5.0 + 5.0 + 5.0 + 10.0
BACK_S = 2.0
UNSEEN_NS = 100_000_000  # the log begins again only with the router: what it shows then is no time of a vent
OPEN_MA = 150.0  # the exhaust valve vents; the law holds it lower
WAITS = "it waits to be armed again"


def cut_cable(network, over):
    """The controller's cable is out for `AWAY_S`; the devices and the recorder hear each other meanwhile, so it is logged."""
    way = Way()
    with rig_on(network, bench_text(network, way, over=over, duration_s=DURATION_S)) as rigs:
        rigs.wait_for_word(LEADER, "phase track")
        before = pids(rigs)
        time.sleep(1.0)
        network.cable(LEADER, plugged=False)
        cut_ns = time.monotonic_ns()  # of the leader's clock, and so of the rig's
        time.sleep(AWAY_S)
        network.cable(LEADER, plugged=True)
        back_ns = time.monotonic_ns()
        rigs.wait_for_word(LEADER, WAITS)
        said_s = (time.monotonic_ns() - back_ns) * 1e-9
        return concluded(network, rigs, f"cut cable ({over})", before, cut_ns, back_ns, waits_s=said_s)


def killed_router(network, over):
    """A router of its own, through which all goes, is killed with SIGKILL and started again."""
    text = bench_text(network, Way(), over=over, mode="client", shared_router=True, duration_s=DURATION_S)
    with rig_on(network, text, router_on=LEADER) as rigs:
        rigs.wait_for_word(LEADER, "phase track")
        before = pids(rigs)
        time.sleep(1.0)
        rigs.routers[-1].send_signal(signal.SIGKILL)
        rigs.routers[-1].wait()
        killed_ns = time.monotonic_ns()
        rigs.wait_for_word(LEADER, "the meeting point is lost")
        time.sleep(AWAY_S)
        rigs.start_router(network.hosts[LEADER].inside([]))
        back_ns = time.monotonic_ns()
        rigs.wait_for_word(LEADER, WAITS)
        return concluded(network, rigs, f"killed router ({over})", before, killed_ns, back_ns)


def concluded(network, rigs, name, before, lost_ns, back_ns, **found):
    """Arm again, let the run end by itself, and read what its log says."""
    restarted = sorted(what for what, pid in pids(rigs).items() if before.get(what) != pid)
    armed = subprocess.run(network.hosts[LEADER].inside([*CLI, "request", str(rigs.bench), "arm"]), env=rigs.environment,
                           capture_output=True, text=True, timeout=60, check=False)  # fmt: skip
    codes = rigs.finish()
    if armed.returncode or any(codes.values()):
        sys.stderr.write(f"{armed.stderr}{rigs.report()}\n")
    log = open_run(rigs.hosts[LOGGER].run_dir)
    found |= {"incident": name, "codes": codes, "restarted": restarted, "left_over": rigs.left_over()}
    found |= {
        "armed_again": armed.returncode == 0,
        "vented_ms": vented_ms(log, lost_ns, back_ns),
        "back_s": max(first_after(log, back_ns).values()),
    }
    found["charge_back_ma"] = charge_back_ma(log, back_ns)
    found["gate"] = [state for _, state in gate_events(log)]
    return found | {"failed": failures(found)}


def vented_ms(log, lost_ns, back_ns):
    """From the loss until the valves vented, by the plant's truth; rig clock. Infinite where nothing was logged meanwhile."""
    truth = log["truth"][(log["truth"]["stamp_ns"] > lost_ns) & (log["truth"]["stamp_ns"] < back_ns)]
    off = truth[(truth["charge_coil_ma"] < COIL_OFF_MA) & (truth["exhaust_coil_ma"] > OPEN_MA)]
    if not len(off) or truth["stamp_ns"][0] - lost_ns > UNSEEN_NS:
        return float("inf")
    return float(off["stamp_ns"][0] - lost_ns) * 1e-6


def charge_back_ma(log, back_ns):
    """Current in the charge coil in the first truth after the return."""
    after = log["truth"][log["truth"]["stamp_ns"] > back_ns]
    return float(after["charge_coil_ma"][0]) if len(after) else float("inf")


def failures(found):
    """The bounds that an incident does not keep, one line each."""
    checks = (
        (
            found["incident"].startswith("cut cable") and found["vented_ms"] > VENT_MS,
            f"vented {found['vented_ms']} ms after the loss",
        ),
        (found["charge_back_ma"] > COIL_OFF_MA, f"{found['charge_back_ma']} mA in the charge coil on the return"),
        (found["restarted"], f"restarted: {found['restarted']}"),
        (not found["armed_again"], "not armed again"),
        (found["gate"].count(ARMED) < 1, "never armed in the log"),
        (found["back_s"] > BACK_S, f"all back after {found['back_s']:.2f} s"),
        (any(found["codes"].values()), f"exit codes {found['codes']}"),
        (found["left_over"], f"left over: {found['left_over']}"),
    )
    return [text for bad, text in checks if bad]


def pids(rigs):
    return {key: process.pid for key, process in rigs.family().items()}
