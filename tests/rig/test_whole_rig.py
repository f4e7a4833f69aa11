"""The whole rig over all its processes. One at a time: two of them would fight for two cores."""

import signal
import socket
import time

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from softloop.deploy.bench import shipped_benches
from softloop.offline.log import open_log
from softloop.offline.metrics import truth_errors, while_armed
from softloop.offline.run_log import open_run
from softloop.wire.channels import CHANNELS
from softloop.wire.messages import constant
from tests.rig.rigs import running, stands_stalls

pytestmark = [pytest.mark.rig, stands_stalls]

# These tests are about what the processes do, on a machine that may be busy: budgets are wide, so that a stall of the machine is
# no fault of the rig's. What the default budgets stand is measured elsewhere.
WIDE = """
[valves]
age_ticks = 16
hold_ticks = 12
driver_silence_ms = 100.0
[plant]
watchdog_ms = 100.0
[run]
report = false
"""
SHORT = """
[controller]
trajectory = "{bench_dir}/short.csv"
approach_s = 2.0
pressure_budget_ms = 100.0
inclination_budget_ms = 100.0
"""
ARMED = "gate armed"


def short_csv(rig_folder):
    times = np.arange(0, 4.01, 0.05)
    rows = np.c_[times, 60 + 10 * np.sin(np.pi * times / 2) ** 2]
    np.savetxt(rig_folder / "short.csv", rows, delimiter=",", header="t_s,angle_deg")


def bench_on(shipped, folder):
    """The text of a bench on a shipped one, with wide budgets and a trajectory of 4 s."""
    short_csv(folder)
    (folder / "wide.toml").write_text(f'base = "{shipped_benches()[shipped]}"\n{WIDE}')
    return f'base = "{folder}/wide.toml"\n' + SHORT.replace("{bench_dir}", str(folder))


@pytest.fixture
def short_bench(tmp_path):
    return bench_on("sim", tmp_path)


@pytest.mark.parametrize("law", ["arc", pytest.param("pid", marks=pytest.mark.long)])
def test_a_run_starts_vented_tracks_logs_everything_and_leaves_nothing_behind(short_bench, law):
    """The monitor may fault the gate, and has no reason to."""
    text = f'{short_bench}law = "{law}"\n[monitor]\nfaults_gate = true\n[run]\nreport = true\n'
    with running(text, name=f"whole-{law}") as rig:
        rig.finish(0)
        assert rig.left_over() == []
        assert list(rig.folder.glob("*.sock*")) == []
        log = open_log(rig.run_dir / "run.mcap")
        assert log.problems == []
        spoken = {c.name for c in CHANNELS if c.logged and c.name not in ("can", "canbus", "clock", "shadow")}
        assert {name for name in spoken if len(log[name])} == spoken
        assert {f"{arbitration_id:x}" for _, arbitration_id in log.can} == {"80", "90", "100"}
        assert {"bench.toml", "rig.dbc", "parameters.toml"} <= set(log.attachments)
        assert truth_errors(log).figures()["max_deg"] < 15.0  # it follows; how well is measured elsewhere
        assert rig.summary()
        assert (rig.run_dir / "report.html").stat().st_size > 50_000
        with (rig.run_dir / "run.mcap").open("rb") as stream:
            decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages(
                ["/softloop/whole-" + law + "/cycle"]
            )
            assert len({m.decoded_message.tick for m in decoded}) == len(log["cycle"])
        truth, monitor = log["truth"], constant("Event", "SOURCE_MONITOR")
        assert truth["chamber_pressure_kpa"][0] < 0.5
        assert truth["angle_deg"][0] == pytest.approx(26.75, abs=3.0)
        assert truth["chamber_pressure_kpa"][-1] < 5.0
        assert truth["charge_coil_ma"][-1] < 1.0
        assert monitor in log["status"]["process"]
        assert monitor not in log["event"]["source"]


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.long), signal.SIGTERM])
def test_ctrl_c_and_sigterm_vent_and_end(short_bench, number):
    with running(short_bench, name="ctrl-c") as rig:
        rig.wait_for_word(ARMED)
        time.sleep(2.5)
        rig.signal(number)
        rig.finish(130)
        assert rig.left_over() == []
        truth = open_log(rig.run_dir / "run.mcap")["truth"]
        assert truth["chamber_pressure_kpa"].max() > 10.0
        assert truth["chamber_pressure_kpa"][-1] < 5.0


def test_a_killed_launcher_takes_all_with_it_and_the_gate_vents_first(short_bench):
    with running(short_bench, name="killed") as rig:
        rig.wait_for_word(ARMED)
        time.sleep(2.5)
        rig.signal(signal.SIGKILL)
        assert rig.left_over() == []
        log = open_log(rig.run_dir / "run.mcap")
        last = log["valves"][-1]
        assert last["output"] != constant("ValveStatus", "OUTPUT_PASS")
        assert last["charge_current_ma"] == 0.0


LESS_OFTEN = [pytest.param(victim, marks=pytest.mark.long) for victim in ("valves", "pressures", "inclinometer")]


@pytest.mark.parametrize("victim", ["controller", *LESS_OFTEN])
def test_a_killed_process_of_the_control_path_ends_in_a_vent_and_is_named(short_bench, victim):
    with running(short_bench, name="lost") as rig:
        rig.wait_for_word(ARMED)
        time.sleep(2.5)
        rig.named(victim).kill()
        rig.finish(1, 4)
        assert victim in rig.output
        log = open_log(rig.run_dir / "run.mcap")
        truth = log["truth"]
        assert truth["charge_coil_ma"][-1] < 1.0
        assert truth["chamber_pressure_kpa"][-1] < 10.0
        if victim != "valves":
            assert constant("ValveStatus", "GATE_FAULT") in log["valves"]["gate"]


def test_a_killed_recorder_comes_back_with_a_part_of_its_own_and_the_run_goes_on(short_bench):
    # A trajectory so long that a busy machine has started the recorder before its end.
    with running(short_bench.replace("approach_s = 2.0", "approach_s = 60.0"), name="reborn") as rig:
        rig.wait_for_word(ARMED)
        time.sleep(1.0)
        rig.named("recorder").kill()
        rig.wait_for_word("recorder is back")
        time.sleep(1.0)
        rig.signal(signal.SIGINT)
        rig.finish(130)
        assert rig.left_over() == []
        parts = [open_log(rig.run_dir / name) for name in ("run.mcap", "run-2.mcap")]
        assert [part.finished for part in parts] == [False, True]
        log = open_run(rig.run_dir)
        assert len(parts[1]["cycle"]) > 100
        assert constant("ValveStatus", "GATE_FAULT") not in log["valves"]["gate"]
        assert (np.diff(log["cycle"]["seq"].astype(int)) >= 1).all()
        events = log["event"][log["event"]["source"] == constant("Event", "SOURCE_LAUNCHER")]
        back = events[events["kind"] == constant("Event", "KIND_PROCESS")][-1]
        assert (back["code"], back["reason"]) == (1, constant("Event", "SOURCE_RECORDER"))
        assert 0.5 <= back["value"] < 60.0
        assert not rig.summary()["evidence_valid"]


@pytest.mark.long
def test_a_stopped_recorder_does_not_hold_the_loop(short_bench):
    with running(short_bench, name="stalled") as rig:
        rig.wait_for_word(ARMED)
        recorder = rig.named("recorder")
        recorder.suspend()
        time.sleep(3.0)
        recorder.resume()
        rig.finish(0)
        log = open_log(rig.run_dir / "run.mcap")
        cycles = while_armed(log, log["cycle"])
        # The ticks of the stall ran, though their records may be missing in the log; a publisher that waits would have stood
        # still for seconds, hundreds of ticks.
        assert cycles["skipped_total"][-1] - cycles["skipped_total"][0] < 100
        assert cycles["tick"][-1] - cycles["tick"][0] == pytest.approx(
            (cycles["stamp_ns"][-1] - cycles["stamp_ns"][0]) / 5e6, abs=1
        )


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_same_over_slcan_and_a_socket_with_no_code_that_knows(tmp_path):
    port = free_port()
    text = bench_on("slcan", tmp_path) + f'[plant]\nserial = "listen://127.0.0.1:{port}"\n'
    text += f'[inclinometer]\nport = "socket://127.0.0.1:{port}"\n'
    with running(text, name="slcan") as rig:
        rig.finish(0)
        log = open_log(rig.run_dir / "run.mcap")
        assert truth_errors(log).figures()["max_deg"] < 15.0
        assert {f"{arbitration_id:x}" for _, arbitration_id in log.can} == {"80", "90", "100"}


@pytest.mark.long
def test_two_benches_on_one_name_are_refused(short_bench):
    with running(short_bench, name="twice") as first:
        first.wait_for_word(ARMED)
        with running(short_bench, name="twice", runtime=first.folder) as second:
            second.finish(3)
            assert len(second.output.splitlines()) == 1
            assert "running already" in second.output
        first.signal(signal.SIGINT)
        first.finish()


def test_an_address_in_use_is_one_line(short_bench):
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        text = short_bench + f'[zenoh]\nendpoint = "tcp/127.0.0.1:{holder.getsockname()[1]}"\n'
        with running(text, name="in-use") as rig:
            rig.finish(3)
            assert "in use" in rig.output.splitlines()[-1]


def test_a_can_channel_nobody_answers_on_is_said_and_nothing_arms(short_bench):
    text = short_bench + '[run]\narm_timeout_s = 3.0\n[plant]\ncan_valves = "elsewhere"\n'
    text += '[can.elsewhere]\ninterface = "zenoh"\nchannel = "other"\n'
    with running(text, name="nobody") as rig:
        assert rig.finish() != 0
        assert "driver" in rig.output
        truth = open_log(rig.run_dir / "run.mcap")["truth"]
        assert truth["charge_coil_ma"].max() < 1.0


def test_the_monitor_can_fault_the_gate(short_bench):
    source = constant("Event", "SOURCE_MONITOR")
    strict = "[monitor]\nfaults_gate = true\nerror_max_deg = 0.001\nerror_s = 0.01\n[controller]"
    with running(short_bench.replace("[controller]", strict), name="strict") as rig:
        rig.finish(1)
        assert "the gate went to FAULT: invariant" in rig.output
        log = open_log(rig.run_dir / "run.mcap")
        events = log["event"][log["event"]["source"] == source]
        assert events["code"][0] == constant("Event", "INVARIANT_ERROR")
        gate = log["event"][log["event"]["reason"] == constant("ValveStatus", "REASON_INVARIANT")]
        assert 0 <= gate["stamp_ns"][0] - events["stamp_ns"][0] < 1_000_000_000
