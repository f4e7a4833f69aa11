"""The page in a real browser, beside a toy rig that obeys. `make test-page` runs these."""

import os
import re
import time

import numpy as np
import pytest

from softloop.deploy.fault_requests import offer_faults
from softloop.plant.fault_request import FaultRequest, unpack_request
from softloop.wire.channels import FAULT
from softloop.wire.questions import Questions
from tests.page.browsing import LIVE, LOST, PHONE, viewing, wait_for
from tests.watch.benches import speaking, write_bench
from tests.watch.pages import served, toy_rig, until
from tests.wire.rendezvous import short_folder

pytestmark = pytest.mark.page


@pytest.fixture(scope="module")
def stage():
    with short_folder() as folder:
        file = write_bench(folder, f"seen-{os.getpid()}")
        with speaking(file) as speaker, toy_rig(speaker) as rig, served(file) as (site, address):
            until(lambda: site.feed.history.head > 100)
            yield site, address, rig


@pytest.fixture
def rig(stage):
    rig = stage[2]
    rig.gate = 0
    rig.requests.clear()
    return rig


def shown(view, name):
    """The text beside a name in the list of numbers."""
    return view.locator(f"#numbers dt:text-is('{name}') + dd").inner_text()


def test_the_numbers_are_those_that_were_sent(chromium, stage, rig):
    with viewing(chromium, stage[1]) as view:
        view.wait_for_timeout(500)
        assert shown(view, "error") == "0.250 deg"
        assert shown(view, "supply pressure") == "198.5 kPa"
        assert shown(view, "desired pressure") == "42.00 kPa"
        assert re.fullmatch(r"\d\d\.\d\d deg", shown(view, "angle"))
        told = view.evaluate("[softloop.state.cycle, softloop.state.start_ns]")
        sent = next(c for c in rig.cycles if c["tick"] == told[0]["tick"])
        assert told[0]["angle_deg"] == sent["angle_deg"]
        columns = view.evaluate(
            "(() => { const v = softloop.store.levels[0].since(softloop.store.last - 2); return v.map((c) => [...c]); })()"
        )
        stamps = np.array([c["stamp_ns"] for c in rig.cycles])
        for t, reference in zip(columns[0], columns[2], strict=True):
            at = np.abs(stamps - told[1] - t * 1e9).argmin()
            assert reference == pytest.approx(rig.cycles[at]["reference_deg"], rel=1e-6)
        assert view.locator("#inputs").inner_text().count("Hz") >= 2
        assert "17" in view.locator("#inputs").inner_text() or "%" in view.locator("#inputs").inner_text()
        assert view.locator("#processes tbody tr").count() == 1


def test_arm_rearm_and_disarm(chromium, stage, rig):
    with viewing(chromium, stage[1]) as view:
        view.click("#arm")
        view.wait_for_selector("#gate[data-gate=armed]")
        assert view.locator("#arm").is_disabled()
        view.click("#disarm")
        view.wait_for_selector("#gate[data-gate=disarmed]")
        rig.gate = 2
        wait_for(view, "document.getElementById('arm').textContent === 'Re-arm'")
        view.click("#arm")
        view.wait_for_selector("#gate[data-gate=armed]")
        assert "gate armed" in view.locator("#events").inner_text()


def test_a_press_of_the_stop_is_with_the_gate_at_once(chromium, stage, rig):
    rig.gate = 1
    with viewing(chromium, stage[1]) as view:
        box = view.locator("#stop").bounding_box()
        assert box["width"] > 120
        assert box["height"] > 45
        view.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        pressed_s = time.monotonic()
        view.mouse.down()
        until(lambda: rig.gate == 2)
        heard_s = next(at for action, at in rig.requests if action == "stop")
        view.mouse.up()
        wait_for(view, "document.getElementById('answer').textContent.startsWith('Stopped')")
        view.wait_for_selector("#gate[data-gate=fault]")
        assert view.locator("#reason").inner_text() == "emergency stop"
        assert heard_s > pressed_s


def test_the_keyboard_alone_will_do(chromium, stage, rig):
    with viewing(chromium, stage[1]) as view:
        view.locator("#arm").focus()
        view.keyboard.press("Enter")
        view.wait_for_selector("#gate[data-gate=armed]")
        view.keyboard.press("4")
        assert view.evaluate("softloop.seconds") == 600
        view.keyboard.press("p")
        assert view.evaluate("softloop.paused") is not None
        view.keyboard.press("Escape")
        until(lambda: rig.gate == 2)


def test_the_stop_works_without_its_script(chromium, stage, rig):
    rig.gate = 1
    with viewing(chromium, stage[1], wait="", java_script_enabled=False) as view:
        view.click("#stop")
        until(lambda: rig.gate == 2)
        assert view.url == stage[1]


def test_two_viewers_agree(chromium, stage):
    with viewing(chromium, stage[1]) as one, viewing(chromium, stage[1]) as two:
        take = "(() => { const v = softloop.store.levels[0].since(softloop.store.last - 5); return [[...v[0]], [...v[1]]]; })()"
        first, second = (dict(zip(*view.evaluate(take), strict=True)) for view in (one, two))
        common = set(first) & set(second)
        assert len(common) > 200
        assert all(first[t] == second[t] for t in common)
        wait_for(one, "document.getElementById('footer').textContent.includes('2 viewers')")


def test_a_small_screen_has_all_of_it(chromium, stage, rig):
    rig.gate = 1
    with viewing(chromium, stage[1], PHONE, has_touch=True) as view:
        assert view.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        view.evaluate("window.scrollTo(0, 900)")
        box = view.locator("#stop").bounding_box()
        assert box["y"] >= 0
        assert box["y"] + box["height"] < PHONE["height"] / 2
        view.touchscreen.tap(box["x"] + 20, box["y"] + 20)
        until(lambda: rig.gate == 2)


def test_ten_minutes_are_kept_and_drawn_in_few_points(chromium, stage):
    with viewing(chromium, stage[1]) as view:
        points = view.evaluate(
            """() => {
              const store = softloop.store, rows = 4000, columns = store.columns.length;
              for (let block = 0; block < 30; block++) {
                const buffer = new ArrayBuffer(16 + 4 * rows * columns), head = new DataView(buffer);
                head.setUint32(0, rows, true); head.setUint32(4, columns, true); head.setFloat64(8, store.last + 0.005, true);
                const values = new Float32Array(buffer, 16);
                for (let r = 0; r < rows; r++) { values[r * columns] = r * 0.005; values[r * columns + 1] = r === 7 ? 999 : 1; }
                store.take(buffer);
              }
              const view = store.view(600, store.last), short = store.view(30, store.last), n = view[0].length;
              return [n, view[0][n - 1] - view[0][0], Math.max(...view[1].slice(200)), short[0].length];
            }"""
        )
        assert points[0] < 2000
        assert points[1] > 598
        assert points[2] == 999  # a spike of one tick is still there
        assert points[3] < 2000


def test_a_silence_of_the_rig_and_a_lost_server_are_shown(chromium):
    with short_folder() as folder:
        file = write_bench(folder, f"lost-{os.getpid()}")
        with served(file) as (site, address):
            port = site.port
            with viewing(chromium, address, wait="document.body.dataset.connection === 'idle'", allow=LOST) as view:
                with speaking(file) as speaker, toy_rig(speaker):
                    wait_for(view, LIVE)
                wait_for(view, "document.body.dataset.connection === 'idle'")
                assert view.locator("#arm").is_disabled()
                wait_for(view, "document.getElementById('gate').innerText === 'gate silent'")
        with viewing(chromium, "about:blank", wait="", allow=LOST) as view:
            with served(file, port=port) as (_, address):
                view.goto(address)
                wait_for(view, "document.body.dataset.connection === 'idle'")
            wait_for(view, "document.body.dataset.connection === 'lost'")
            assert view.locator("#lost").is_visible()
            assert "use the hardware stop" in view.locator("#lost").inner_text()
            view.keyboard.press("Escape")
            wait_for(view, "document.getElementById('answer').textContent.startsWith('NO ANSWER')")
            with served(file, port=port):
                wait_for(view, "document.body.dataset.connection === 'idle'")


def test_experiments_are_started_and_ended_from_the_page(chromium):
    asked = []

    async def start(given):
        asked.append(given)
        return {"error": "the rig is at lunch"} if given["law"] == "pid" else {}

    async def end(given):
        asked.append("end")
        return {}

    with short_folder() as folder:
        file = write_bench(folder, f"lab-{os.getpid()}")
        with served(file, actions={"start": start, "end": end}) as (site, address):
            site.hello["experiments"] = {"law": ["arc", "pid"], "trajectory": ["t1", "t2"]}
            site.feed.more["experiment"] = {"running": False, "text": "none yet"}
            with viewing(chromium, address, wait="softloop.state", allow=("400",)) as view:
                view.wait_for_selector("#experiment:visible")
                view.select_option("[name=law]", "pid")
                view.select_option("[name=trajectory]", "t2")
                view.fill("[name=duration_s]", "12")
                view.click("#start")
                wait_for(view, "document.getElementById('answer').textContent === 'Not started: the rig is at lunch'")
                site.feed.more["experiment"] = {"running": True, "text": "running", "law": "pid", "trajectory": "t2"}
                wait_for(view, "document.getElementById('law').textContent === 'pid on t2'")
                view.click("#end")
                until(lambda: "end" in asked)
    assert asked[0] == {"law": "pid", "trajectory": "t2", "duration_s": 12}


def test_faults_can_be_asked_of_a_simulated_plant_alone(chromium):
    with short_folder() as folder:
        file = write_bench(folder, f"faulty-{os.getpid()}")
        with speaking(file) as speaker, toy_rig(speaker), served(file) as (site, address):
            offer_faults(site)
            with viewing(chromium, address, allow=("400",)) as view:
                wait_for(view, "document.getElementById('fault-state').textContent === 'no simulated plant is running here'")
                assert view.locator("#inject").is_disabled()
                assert view.locator("#mend").is_disabled()
                plant = Questions(speaker.wire, FAULT)
                speaker.say("status", seq=1, pid=77, process=3, state=1)
                view.wait_for_selector("#inject:enabled")
                assert view.locator("#fault-form [name=size]").is_enabled()
                view.select_option("#fault-form [name=kind]", "supply_loss")
                assert view.locator("#fault-unit").inner_text() == "part"
                view.fill("#fault-form [name=size]", "2")
                view.click("#inject")
                wait_for(view, "document.getElementById('answer').textContent.includes('out of range')")
                view.select_option("#fault-form [name=kind]", "angle_stuck")
                assert view.locator("#fault-form [name=size]").is_disabled()
                view.fill("#fault-form [name=duration_s]", "1.5")
                speaker.say("status", seq=2, pid=77, process=3, state=1)
                view.click("#inject")
                asked = []
                until(lambda: asked.extend(plant.take_all()) or asked)
                assert unpack_request(asked[0].payload) == FaultRequest(kind="angle_stuck", duration_s=1.5)
                asked[0].refuse("not at lockstep pace")
                wait_for(view, "document.getElementById('answer').textContent === 'Not done: not at lockstep pace'")
                speaker.say("event", source=3, kind=8, code=1, reason=6)
                speaker.say("status", seq=3, pid=77, process=3, state=1)
                wait_for(view, "document.getElementById('fault-state').textContent === 'broken: angle stuck'")
                assert "fault angle_stuck came" in view.locator("#events").inner_text()
