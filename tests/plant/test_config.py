import pytest

from softloop.dynamics.parameters import shipped
from softloop.plant.config import PlantConfig, plant_process
from softloop.plant.setup import WireTimes, plant_record
from softloop.wire.benchfile import load_model
from softloop.wire.can_config import CanConfig
from softloop.wire.errors import BadConfig, BadFile


@pytest.mark.parametrize(
    ("table", "word"),
    [
        ({"layer": "perfect"}, "layer"),
        ({"seed": -1}, "seed"),
        ({"step_us": 5000}, "step_us"),
        ({"baud": 1200}, "baud must be one of 4800"),
        ({"rate_hz": 150}, "rate_hz must be one of"),
        ({"loads": [{"kind": "payload", "on_s": 2.0, "off_s": 1.0, "size": 1.0}]}, "on_s must be before off_s"),
        ({"loads": [{"kind": "payload", "on_s": 0.0, "size": 1.0}] * 17}, "loads"),
        ({"chamber_sensor": {"zero_v": 5.0, "full_v": 5.0}}, "full_v must be above zero_v"),
        ({"sped": 1}, "unknown key 'sped'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(table, word):
    with pytest.raises(BadConfig, match=word) as caught:
        load_model(PlantConfig, table, "bench.toml")
    assert "\n" not in str(caught.value)


def test_an_unknown_bus_is_named():
    with pytest.raises(BadConfig, match=r"plant\.can_analog.*can0"):
        plant_process(PlantConfig(can_analog="can7"), {"can0": CanConfig()})


def test_a_missing_parameter_file_is_named():
    with pytest.raises(BadFile, match="nowhere"):
        plant_record(PlantConfig(parameters="/tmp/nowhere.toml"))


def test_a_parameter_file_may_be_named_by_path():
    by_path = plant_record(PlantConfig(parameters=str(shipped())))
    assert by_path.tobytes() == plant_record(PlantConfig()).tobytes()


def test_wires_and_overrides_reach_the_record():
    sensor = {"zero_v": 1.0, "full_v": 5.0, "span_kpa": 400.0}
    config = PlantConfig(watchdog_ms=30.0, command_delay_ms=1.5, pressure_noise_kpa=0.0, chamber_sensor=sensor)
    electrical = plant_record(config.model_copy(update={"layer": "ideal"}), WireTimes(1_000_000, 250_000)).electrical
    assert (electrical.watchdog_ns, electrical.command_delay_ns) == (30_000_000, 1_500_000)
    assert (electrical.driver_frame_ns, electrical.analog_frame_ns) == (135_000, 540_000)
    assert (electrical.chamber.gain, electrical.chamber.zero_v, electrical.chamber.noise_v) == (0.01, 1.0, 0.0)
