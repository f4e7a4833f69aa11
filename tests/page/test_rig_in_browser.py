"""The page beside a whole rig: what it shows is what is logged, and its stop button vents, by the log."""

import time
from pathlib import Path

import numpy as np
import pytest

from softloop.deploy.bench import shipped_benches
from softloop.offline.log import open_log
from softloop.watch.page.history import COLUMNS
from softloop.wire.messages import constant
from tests.page.browsing import LOST, PHONE, viewing, wait_for
from tests.rig.rigs import running
from tests.rig.test_whole_rig import WIDE

pytestmark = [pytest.mark.page, pytest.mark.rig]

LIMIT_MS = 100.0
MS = 1_000_000
NOTE_PRESS = "document.addEventListener('pointerdown', (e) => { window.pressedAt = [e.timeStamp, performance.now()]; }, true)"
OUTPUT_VENT, GATE_FAULT = constant("ValveStatus", "OUTPUT_VENT"), constant("ValveStatus", "GATE_FAULT")
TRACKED = "softloop.state && softloop.state.phase === 'track' && softloop.state.trajectory_s > 12"
ALL_KEPT = "(() => { const v = softloop.store.levels[0].since(softloop.store.last - 8); return v.map((c) => [...c]); })()"


def address_of(rig):
    word = "live page: "
    rig.wait_for_word(word)
    return rig.output.split(word)[1].split()[0]


def test_what_the_page_shows_is_logged_and_its_stop_vents(chromium, request, tmp_path):
    shots = request.config.getoption("--screenshots")
    waves_csv(tmp_path / "waves.csv")
    text = f'base = "{shipped_benches()["sim"]}"\n[page]\nport = 0\n{WIDE}[controller]\ntrajectory = "{tmp_path}/waves.csv"\n'
    with running(text, name="seen-rig", arguments=("--page", "--no-report")) as rig:
        address = address_of(rig)
        with viewing(chromium, address, allow=LOST) as view:
            wait_for(view, TRACKED)
            rows = np.array(view.evaluate(ALL_KEPT))
            start_ns = view.evaluate("softloop.state.start_ns")
            if shots:
                view.screenshot(path=Path(shots) / "page.png", full_page=True)
            box = view.locator("#stop").bounding_box()
            view.mouse.move(box["x"] + 20, box["y"] + 20)
            view.evaluate(NOTE_PRESS)
            origin_ns = clock_origin_ns(view)
            asked_ns = time.monotonic_ns()
            view.mouse.down()
            pressed_ms, handled_ms = view.evaluate("window.pressedAt")
            clicked_ns = max(asked_ns, origin_ns + int(pressed_ms * 1e6))
            in_page_ms = handled_ms - pressed_ms
            rig.finish(1)
            wait_for(view, "document.body.dataset.connection === 'lost'")
            assert view.evaluate("softloop.state.gate.state") in ("fault", "silent")
            if shots:
                view.set_viewport_size(PHONE)
                view.screenshot(path=Path(shots) / "page_lost_phone.png")
        log = open_log(rig.run_dir / "run.mcap")
    compare_rows(rows, start_ns, log["cycle"])
    vented_ms = vent_delay_ms(log, clicked_ns)
    asked_ms = (clicked_ns - asked_ns) / MS
    print(f"the test asked {asked_ms:.1f} ms before the browser had the press, its page was told {in_page_ms:.1f} ms after")
    print(f"from the click to the first vent frame: {vented_ms:.1f} ms")
    assert 0 < vented_ms < LIMIT_MS


def test_a_fault_from_the_page_is_shown_and_logged_and_the_gate_reacts(chromium, tmp_path):
    waves_csv(tmp_path / "waves.csv")
    text = f'base = "{shipped_benches()["sim"]}"\n[page]\nport = 0\n{WIDE}[controller]\ntrajectory = "{tmp_path}/waves.csv"\n'
    with running(text, name="faulty-rig", arguments=("--page", "--no-report")) as rig:
        with viewing(chromium, address_of(rig), allow=LOST) as view:
            wait_for(view, "softloop.state && softloop.state.phase === 'track'")
            view.select_option("#fault-form [name=kind]", "noise")
            view.fill("#fault-form [name=size]", "1")
            view.click("#inject")
            wait_for(view, "document.getElementById('fault-state').textContent === 'broken: noise'")
            view.click("#mend")
            wait_for(view, "document.getElementById('fault-state').textContent === 'nothing is broken'")
            assert view.evaluate("softloop.state.gate.state") == "armed"
            view.select_option("#fault-form [name=kind]", "inclinometer_silent")
            view.click("#inject")
            wait_for(view, "document.getElementById('events').textContent.includes('fault inclinometer_silent came')")
            wait_for(view, "document.getElementById('events').textContent.includes('gate fault (')")
            rig.finish(1)
        log = open_log(rig.run_dir / "run.mcap")
    events = log["event"]
    came = events[(events["kind"] == constant("Event", "KIND_FAULT")) & (events["source"] == constant("Event", "SOURCE_PLANT"))]
    noise, silent = constant("Event", "FAULT_NOISE"), constant("Event", "FAULT_INCLINOMETER_SILENT")
    assert [(int(e["code"]), int(e["reason"])) for e in came] == [(1, noise), (0, noise), (1, silent)]
    gate = events[(events["kind"] == constant("Event", "KIND_GATE")) & (events["code"] == GATE_FAULT)]
    assert 0 < (gate["stamp_ns"][0] - came["stamp_ns"][-1]) / MS < 1000.0


def waves_csv(target):
    """A trajectory that lasts until somebody presses the button, also on a machine that is busy."""
    times = np.arange(0, 90.01, 0.05)
    angle_deg = 75 + 25 * np.sin(2 * np.pi * times / 12) + 8 * np.sin(2 * np.pi * times / 3.1)
    np.savetxt(target, np.c_[times, angle_deg], delimiter=",", header="t_s,angle_deg")


def compare_rows(rows, start_ns, cycles):
    """The rows of the page are logged cycles, and their values those of the log to the precision of f32.

    On a busy machine page and recorder each lose some records of their own; those that both have are compared.
    """
    stamps = cycles["stamp_ns"]
    wanted = start_ns + rows[0] * 1e9
    at = np.minimum(np.searchsorted(stamps, wanted - 2_500_000), len(stamps) - 1)
    both = np.abs(stamps[at] - wanted) < 2_000
    assert both.sum() > 800
    assert both.mean() > 0.8
    for column, values in zip(COLUMNS[1:], rows[1:], strict=True):
        np.testing.assert_allclose(values[both], cycles[column][at[both]], rtol=1e-6, atol=1e-6)


def clock_origin_ns(view):
    """The monotonic clock at time 0 of the page's own clock, by which the browser stamps a click; not later than it was."""
    looks = []
    for _ in range(20):
        before_ns = time.monotonic_ns()
        looks.append(before_ns - int(view.evaluate("performance.now()") * 1e6))
    return max(looks)


def vent_delay_ms(log, pressed_ns):
    """From the click on the button to the gate's first vent frame, by the stamps of the log (one monotonic clock)."""
    valves = log["valves"]
    later = valves[valves["stamp_ns"] > pressed_ns]
    after = later[(later["gate"] == GATE_FAULT) & (later["output"] == OUTPUT_VENT)]
    requests = [(int(r["action"]), (int(r["stamp_ns"]) - pressed_ns) * 1e-6) for r in log["request"]]
    print(f"stop requests stamped after the press, ms: {[round(at, 1) for _, at in requests if at > 0][:6]}")
    assert len(after), f"no vent frame in the log: {len(later)} frames after the press, requests at {requests}, {log.problems}"
    assert (after["reason"] == constant("ValveStatus", "REASON_EMERGENCY_STOP")).all()
    return (after["stamp_ns"][0] - pressed_ns) * 1e-6
