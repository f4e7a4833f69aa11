import tomllib

import numpy as np
import pytest
import tomlkit

from softloop.dynamics.parameters import load_parameters, model_record, shipped
from softloop.wire.errors import BadConfig, BadFile


def changed(tmp_path, *change):
    content = tomlkit.parse(shipped().read_text())
    *path, value = change
    table = content
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = value
    file = tmp_path / "p.toml"
    file.write_text(tomlkit.dumps(content))
    return file


def test_table_1_and_its_bounds_with_the_signs_turned():
    model = model_record(load_parameters(shipped()))
    assert model.theta[:9].tolist() == [89.9733, 0.1875, 2.8943e-4, 15.4547, 6.964e-2, 8.0505e-5, 5.0667e-7, 2277.8173, 64.3797]
    assert (model.theta_min[1], model.theta_max[1]) == (0.1736, 0.2015)
    assert (model.theta_min[4], model.theta_max[4]) == (0.055935, 0.083345)
    assert np.all(model.theta_min <= model.theta)
    assert np.all(model.theta <= model.theta_max)


def test_five_free_valve_numbers_not_six():
    content = tomllib.loads(shipped().read_text())
    for valve in (content["charge"], content["exhaust"]):
        assert valve["k_v2_pa"] / valve["k_v4_pa"] == pytest.approx(valve["k_v3_m2_pa"] / valve["k_v5_m2_pa"])


def test_impossible_bounds_name_file_and_key(tmp_path):
    file = changed(tmp_path, "bending", "a0", {"value": 1.0, "min": 2.0, "max": 3.0})
    with pytest.raises(BadConfig, match=r"p\.toml: key 'bending\.a0': impossible bounds"):
        load_parameters(file)
    file = changed(tmp_path, "bending", "b0", {"value": 1.0, "min": -1.0, "max": 3.0})
    with pytest.raises(BadConfig, match="must stay above 0"):
        load_parameters(file)
    file = changed(tmp_path, "charge", "k_v2_pa", 1.0)
    with pytest.raises(BadConfig, match="k_v2 times the supply"):
        load_parameters(file)


def test_unknown_keys_and_missing_files_are_named(tmp_path):
    with pytest.raises(BadConfig, match=r"unknown key 'bending\.a9'; allowed here: a0, a1, a2, b0"):
        load_parameters(changed(tmp_path, "bending", "a9", 1.0))
    with pytest.raises(BadFile, match="cannot be read"):
        load_parameters(tmp_path / "none.toml")
