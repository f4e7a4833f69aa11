"""devices' tables of the bench file, and what follows from them together."""

import pytest

from softloop.devices.config import (
    InclinometerConfig,
    PressuresConfig,
    SensorConfig,
    ValvesConfig,
    age_budget_ns,
    pressures_process,
    valves_process,
)
from softloop.wire.benchfile import load_model
from softloop.wire.can_config import CanConfig
from softloop.wire.errors import BadConfig

MS = 1_000_000


@pytest.mark.parametrize(
    ("model", "content", "message"),
    [
        (ValvesConfig, {"vent_current_ma": 221}, "vent_current_ma must be at most current_max_ma .220."),
        (ValvesConfig, {"vent_again_kpa": 2}, "vent_again_kpa must be above vent_done_kpa .2."),
        (ValvesConfig, {"vent_again_kpa": 190}, "vent_again_kpa must be below pressure_max_kpa .190."),
        (ValvesConfig, {"angle_min_deg": 200}, "angle_min_deg must be below angle_max_deg .200."),
        (ValvesConfig, {"current_max_ma": 656}, "'current_max_ma': .*less than or equal to 655.35"),
        (ValvesConfig, {"current_max_mA": 1}, "unknown key 'current_max_mA'; allowed here: .*current_max_ma"),
        (PressuresConfig, {"supply": {"full_v": 0}}, "full_v must be above zero_v .0."),
        (
            PressuresConfig,
            {"supply": {"span": 1}},
            "unknown key 'supply.span'; allowed here: full_v, margin_kpa, span_kpa, zero_v",
        ),
        (InclinometerConfig, {}, "key 'port' is missing"),
        (InclinometerConfig, {"port": "x", "baud": 1200}, "baud must be one of 4800, 9600, .* .got 1200."),
        (InclinometerConfig, {"port": "x", "rate_hz": 1000}, "rate_hz must be one of 10, 20, 50, 100, 200"),
        (InclinometerConfig, {"port": "x", "baud": 38400}, "baud 38400 is too slow for 200 samples of 22 bytes per second"),
        (InclinometerConfig, {"port": "x", "configure_baud": 1}, "configure_baud must be one of"),
    ],
)
def test_errors_say_what_is_allowed(model, content, message):
    with pytest.raises(BadConfig, match=f"^bench.toml: .*{message}"):
        load_model(model, content, "bench.toml")


def test_defaults_agree_with_each_other():
    process = valves_process(ValvesConfig(), PressuresConfig(), InclinometerConfig(port="x"), {"can0": CanConfig()})
    assert process.bus == CanConfig()
    # 5 ms sample period, the wire, 2 ms path, 3 ticks
    assert process.pressure_age_ns == 5 * MS + 270_000 + 2 * MS + 15 * MS
    assert process.inclination_age_ns == 5 * MS + 1_909_722 + 2 * MS + 15 * MS


def test_budgets_follow_the_chain():
    valves = ValvesConfig(can="fast", path_delay_ms=7, age_ticks=1)
    slow = InclinometerConfig(port="x", rate_hz=50, baud=38400)
    process = valves_process(
        valves, PressuresConfig(can="slow", rate_hz=100), slow, {"fast": CanConfig(), "slow": CanConfig(bitrate=250_000)}
    )
    assert process.pressure_age_ns == 10 * MS + 540_000 + 7 * MS + 5 * MS
    assert process.inclination_age_ns == 20 * MS + 5_729_166 + 7 * MS + 5 * MS
    assert age_budget_ns(1, 20, 300, 4000) == 4321


def test_tables_that_do_not_fit_together_are_refused():
    inclinometer = InclinometerConfig(port="x")
    with pytest.raises(BadConfig, match=r"key 'valves.can': there is no \[can.b\]; there are: can0"):
        valves_process(ValvesConfig(can="b"), PressuresConfig(), inclinometer, {"can0": CanConfig()})
    with pytest.raises(BadConfig, match=r"key 'pressures.can': there is no \[can.can0\]; there are: \(none\)"):
        pressures_process(PressuresConfig(), {})
    small = PressuresConfig(chamber=SensorConfig(span_kpa=100))
    with pytest.raises(BadConfig, match=r"'valves.pressure_max_kpa': must be below what the chamber sensor can read \(105 kPa\)"):
        valves_process(ValvesConfig(), small, inclinometer, {"can0": CanConfig()})
