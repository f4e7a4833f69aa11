"""What breaks in the simulated rig acts where a real fault would, when it is scheduled, and is said."""

import numpy as np
import pytest
from pydantic import ValidationError

from softloop.plant.config import PlantConfig
from softloop.plant.faults import FAULTS
from softloop.plant.records import CHAMBER, EVENT_ANALOG_FRAME, EVENT_DRIVER_FRAME, EVENT_FAULT, EVENT_INCLINOMETER, SUPPLY
from softloop.wire.messages import constant
from tests.plant.rigs import MS, Rig, of_kind

QUIET = {"pressure_noise_kpa": 0.0, "angle_noise_deg": 0.0, "rate_noise_deg_s": 0.0}


def rig_with(*faults, layer="ideal", **plant):
    listed = [{"kind": k, "on_s": on, "off_s": off, "size": size} for k, on, off, size in faults]
    return Rig(layer=layer, faults=listed, **QUIET, **plant)


def test_it_comes_and_goes_with_an_event_each():
    rig = rig_with(("chamber_bias", 0.1, 0.2, 4.0))
    events = of_kind(rig.until(300 * MS), EVENT_FAULT)
    assert events["sample_ns"].tolist() == [100 * MS, 200 * MS]
    assert events["raw"][:, 0].tolist() == [1, 0]
    assert set(events["raw"][:, 1].tolist()) == {FAULTS["chamber_bias"]}
    assert events["value"].tolist() == [4.0, 4.0]


@pytest.mark.parametrize(("kind", "event", "raw", "size"), [
    ("chamber_bias", EVENT_ANALOG_FRAME, 1, 4.0), ("angle_bias", EVENT_INCLINOMETER, 1, 3.0),
    ("rate_bias", EVENT_INCLINOMETER, 0, 9.0),
])  # fmt: skip
def test_a_bias_shifts_what_the_device_sends(kind, event, raw, size):
    faulty, sound = rig_with((kind, 0.1, 0.2, size)), rig_with()
    a, b = of_kind(faulty.until(300 * MS), event), of_kind(sound.until(300 * MS), event)
    at = (a["sample_ns"] >= 100 * MS) & (a["sample_ns"] < 200 * MS)
    assert (a["raw"][at, raw] > b["raw"][at, raw]).all()
    assert (a["raw"][~at] == b["raw"][~at]).all()


@pytest.mark.parametrize(
    ("kind", "event", "raw"), [("chamber_stuck", EVENT_ANALOG_FRAME, 1), ("angle_stuck", EVENT_INCLINOMETER, 1)]
)
def test_a_stuck_sensor_repeats_its_last_reading(kind, event, raw):
    rig = rig_with((kind, 0.1, 0.2, 0.0))
    events = of_kind(rig.hold(120.0, 0.0, 0, 300 * MS), event)
    stuck = events[(events["sample_ns"] >= 100 * MS) & (events["sample_ns"] < 200 * MS)]
    after = events[events["sample_ns"] >= 200 * MS]
    before = events[events["sample_ns"] < 100 * MS]
    assert set(stuck["raw"][:, raw].tolist()) == {before["raw"][-1, raw]}
    assert after["raw"][-1, raw] != before["raw"][-1, raw]


@pytest.mark.parametrize(("kind", "event"), [
    ("analog_silent", EVENT_ANALOG_FRAME), ("inclinometer_silent", EVENT_INCLINOMETER), ("driver_silent", EVENT_DRIVER_FRAME),
])  # fmt: skip
def test_a_silent_device_sends_nothing_and_then_goes_on(kind, event):
    rig = rig_with((kind, 0.1, 0.2, 0.0))
    stamps = of_kind(rig.until(300 * MS), event)["sample_ns"]
    assert not ((stamps >= 100 * MS) & (stamps < 200 * MS)).any()
    assert (stamps < 100 * MS).sum() > 15
    assert (stamps >= 200 * MS).sum() > 15


def test_noise_grows():
    def spread(*faults):
        rig = Rig(layer="ideal", faults=[{"kind": k, "on_s": 0.0001, "size": s} for k, s in faults])
        return np.std(of_kind(rig.until(2000 * MS), EVENT_ANALOG_FRAME)["raw"][:, 1])

    assert spread(("noise", 9.0)) > 4.0 * spread()


def test_lost_commands_end_in_the_drivers_own_vent():
    rig = rig_with(("commands_lost", 0.1, 1.0, 0.0))
    rig.hold(100.0, 0.0, 0, 200 * MS)
    assert rig.state.driver.state == constant("ValveStatus", "DRIVER_WATCHDOG")
    assert rig.state.command_charge_ma == 0.0
    assert rig.state.command_exhaust_ma == pytest.approx(200.0)


@pytest.mark.parametrize("layer", ["ideal", "rig"])
def test_without_power_pressure_is_trapped_and_a_dump_valve_lets_it_out(layer):
    chamber = {}
    for dump in (False, True):
        rig = rig_with(("power_loss", 0.5, 10.0, 0.0), layer=layer, dump_valve=dump)
        rig.hold(150.0, 0.0, 0, 500 * MS)
        before = rig.state.x[CHAMBER]
        rig.hold(150.0, 0.0, 500 * MS, 1500 * MS)
        chamber[dump] = rig.state.x[CHAMBER] / before
        assert rig.state.command_charge_ma == rig.state.command_exhaust_ma == 0.0
    assert chamber[False] > 0.7  # only the leak
    assert chamber[True] < 0.05


@pytest.mark.parametrize("layer", ["ideal", "rig"])
def test_a_burst_hose_and_a_lost_supply_let_the_pressure_go(layer):
    burst = rig_with(("hose_burst", 0.5, 10.0, 5.0), layer=layer)
    burst.hold(150.0, 0.0, 0, 500 * MS)
    before = burst.state.x[CHAMBER]
    burst.hold(0.0, 0.0, 500 * MS, 1000 * MS)
    assert burst.state.x[CHAMBER] < 0.3 * before
    poor = rig_with(("supply_loss", 0.1, 10.0, 0.9), layer=layer)
    poor.hold(200.0, 0.0, 0, 1500 * MS)
    rich = rig_with(layer=layer)
    rich.hold(200.0, 0.0, 0, 1500 * MS)
    assert poor.state.x[CHAMBER] < 0.5 * rich.state.x[CHAMBER]
    if layer == "rig":
        assert poor.state.x[SUPPLY] < 0.2 * rich.state.x[SUPPLY]


@pytest.mark.parametrize("layer", ["ideal", "rig"])
def test_a_stuck_valve_stays_where_it_is(layer):
    rig = rig_with(("charge_stuck", 0.2, 10.0, 0.0), layer=layer)
    rig.hold(150.0, 0.0, 0, 400 * MS)
    rig.hold(0.0, 0.0, 400 * MS, 700 * MS)
    free = rig_with(layer=layer)
    free.hold(150.0, 0.0, 0, 400 * MS)
    free.hold(0.0, 0.0, 400 * MS, 700 * MS)
    assert rig.state.x[CHAMBER] > 1.1 * free.state.x[CHAMBER]


@pytest.mark.parametrize("fault", [
    {"kind": "noise", "on_s": 1.0}, {"kind": "analog_silent", "on_s": 1.0, "size": 1.0}, {"kind": "magic", "on_s": 1.0},
    {"kind": "supply_loss", "on_s": 1.0, "size": 1.5}, {"kind": "hose_burst", "on_s": 1.0, "size": -1.0},
    {"kind": "angle_stuck", "on_s": 2.0, "off_s": 1.0}, {"kind": "hose_burst", "on_s": 1.0, "size": 100.1},
    {"kind": "charge_leak", "on_s": 1.0, "size": 1e18}, {"kind": "chamber_bias", "on_s": 1.0, "size": -1e18},
    {"kind": "angle_bias", "on_s": 1.0, "size": 361.0}, {"kind": "rate_bias", "on_s": 1.0, "size": 1e4},
    {"kind": "noise", "on_s": 1.0, "size": 1e4}, {"kind": "angle_stuck", "on_s": 1e10, "off_s": 1e11},
])  # fmt: skip
def test_a_fault_that_makes_no_sense_is_refused(fault):
    with pytest.raises(ValidationError):
        PlantConfig.model_validate({"faults": [fault]})
