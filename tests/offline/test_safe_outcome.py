"""What a run under faults came to, from made-up truths whose outcome is known."""

import numpy as np
import pytest

from softloop.offline.safe_outcome import bridged, judge
from softloop.wire.messages import constant, message

MS = 1_000_000
S = 1000 * MS
TRUTH = message("PlantTruth").dtype
WATCHDOG = constant("ValveStatus", "DRIVER_WATCHDOG")
N = 1000  # records, 5 ms apart


def truth(charge=60.0, exhaust=0.0, area=0.0, kpa=40.0):
    """Records of 5 s with the same values in all of them."""
    made = np.zeros(N, TRUTH)
    made["stamp_ns"] = 5 * MS * np.arange(N)
    made["charge_coil_ma"], made["exhaust_coil_ma"], made["exhaust_area_mm2"] = charge, exhaust, area
    made["chamber_pressure_kpa"] = kpa
    return made


def vented(from_s, empty_s=0.4, closed_s=1.0):
    made = truth()
    first, empty, closed = (round(200 * at) for at in (from_s, from_s + empty_s, from_s + closed_s))
    made["charge_coil_ma"][first:] = 0.0
    made["exhaust_coil_ma"][first:closed], made["exhaust_area_mm2"][first:closed] = 200.0, 0.6
    made["chamber_pressure_kpa"][empty:] = 1.0
    return made


def test_a_vent_and_its_two_times():
    found = judge(vented(2.1), 2 * S, 4 * S, stayed_armed=False)
    assert (found.seen, found.chamber_kpa) == ("VENT", 40.0)
    assert (found.vent_s, found.empty_s) == pytest.approx((0.1, 0.5))


def test_a_charge_current_that_comes_back_is_no_vent_until_it_has_gone_for_good():
    made = vented(2.1)
    made["charge_coil_ma"][440:441] = 30.0
    assert judge(made, 2 * S, 4 * S, stayed_armed=False).vent_s == pytest.approx(0.205)
    made["charge_coil_ma"][900] = 30.0
    assert judge(made, 2 * S, 4 * S, stayed_armed=False).seen == "NONE"


def test_pressure_that_comes_back_is_not_gone():
    made = vented(2.1)
    made["chamber_pressure_kpa"][-1] = 6.0
    assert judge(made, 2 * S, 4 * S, stayed_armed=False).empty_s is None


def test_both_coils_without_current_are_dead_even_while_the_exhaust_closes():
    made = truth(charge=60.0, exhaust=80.0, area=0.3)
    made["charge_coil_ma"][410:], made["exhaust_coil_ma"][413:], made["exhaust_area_mm2"][420:] = 0.0, 0.0, 0.0
    found = judge(made, 2 * S, 4 * S, stayed_armed=False)
    assert (found.seen, found.vent_s, found.empty_s) == ("DEAD", None, None)


def test_a_run_that_went_on_is_timed_from_its_planned_end():
    found = judge(vented(4.05), 2 * S, 4 * S, stayed_armed=True)
    assert found.seen == "CONTINUE"
    assert (found.vent_s, found.empty_s) == pytest.approx((0.05, 0.45))
    assert judge(vented(4.05), 2 * S, 4 * S, stayed_armed=False).seen == "NONE"


def test_a_controller_that_lets_air_out_before_the_planned_end_has_not_stopped():
    made = vented(3.7, closed_s=2.0)
    found = judge(made, 2 * S, 4 * S, stayed_armed=True)
    assert (found.seen, found.vent_s) == ("CONTINUE", pytest.approx(0.0))
    assert judge(made, 2 * S, 4 * S, stayed_armed=False).seen == "VENT"


def test_an_exhaust_that_does_not_open_after_the_planned_end_holds_the_pressure_in():
    made = vented(4.05)
    made["exhaust_area_mm2"] = 0.0
    found = judge(made, 2 * S, 4 * S, stayed_armed=True)
    assert (found.seen, found.vent_s) == ("TRAPPED", None)


def test_the_drivers_own_vent_counts_where_the_gate_said_nothing_more():
    made = vented(2.1)
    made["driver"][420:] = WATCHDOG
    assert judge(made, 2 * S, 4 * S, stayed_armed=True).seen == "VENT"


def test_current_in_the_charge_valve_to_the_end_is_none_of_these():
    assert judge(truth(), 2 * S, 4 * S, stayed_armed=False).seen == "NONE"


def test_an_exhaust_that_does_not_open_is_no_vent():
    made = vented(2.1)
    made["exhaust_area_mm2"] = 0.0
    assert judge(made, 2 * S, 4 * S, stayed_armed=False).seen != "VENT"


def without(made, from_s, to_s):
    return made[(made["stamp_ns"] < round(from_s * S)) | (made["stamp_ns"] >= round(to_s * S))]


def test_a_gap_in_the_log_is_bridged_by_what_the_truth_behind_it_says():
    """A router that was away: nobody heard the vent, and both times are known all the same."""
    made = vented(2.1, closed_s=2.0)
    for name, from_s in (("charge_off_ns", 2.1), ("exhaust_open_ns", 2.1), ("empty_ns", 2.5)):
        made[name][made["stamp_ns"] >= round(from_s * S)] = round(from_s * S)
    heard = without(made, 2.02, 3.0)
    found = judge(bridged(heard), 2 * S, 4 * S, stayed_armed=False)
    assert (found.vent_s, found.empty_s) == pytest.approx((0.1, 0.5))
    assert judge(heard, 2 * S, 4 * S, stayed_armed=False).vent_s == pytest.approx(1.0)  # what the log alone could say


def test_nothing_is_put_into_a_log_without_gaps_nor_into_one_in_which_nothing_began():
    made = vented(2.1)
    assert (bridged(made) == made).all()
    assert len(bridged(without(truth(), 2.0, 3.0))) == len(without(truth(), 2.0, 3.0))
    late = vented(3.5)
    late["charge_off_ns"][late["stamp_ns"] >= 3.5 * S] = round(3.5 * S)
    assert len(bridged(without(late, 2.0, 3.0))) == len(without(late, 2.0, 3.0))
