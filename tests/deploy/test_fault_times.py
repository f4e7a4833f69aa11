"""What a bench injects after its run is over is refused when it is launched, by what the command line says too."""

import pytest

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.fault_times import check_times, over_s
from softloop.deploy.launcher import Options, launch
from softloop.wire.errors import BadConfig

DROP = '[[faults.injections]]\nkind = "can_drop"\ntarget = "analog"\nat_s = {at_s}\n'
BREAK = '[[plant.faults]]\nkind = "angle_stuck"\non_s = {at_s}\n'


@pytest.fixture
def bench(tmp_path):
    """A function that gives a bench and its file: the shipped simulated one with more tables."""

    def make(text):
        file = tmp_path / "b.toml"
        file.write_text(f'base = "{shipped_benches()["sim"]}"\n{text}')
        return load_bench(file), file

    return make


RUN = "[run]\nduration_s = 2.0\nvent_timeout_s = 1.0\nstop_timeout_s = 4.0\nsettle_s = 0.3\nready_timeout_s = 20.0\n"
LOCKSTEP = '[pace]\nmode = "lockstep"\n'
ARMED = '[plant]\nfaults_from = "armed"\n'


@pytest.mark.parametrize(("text", "injected", "key", "end_s"), [
    (RUN, DROP, "faults.injections.0.at_s", 7.0),
    (RUN + LOCKSTEP, DROP, "faults.injections.0.at_s", 3.005),
    (RUN + ARMED, BREAK, "plant.faults.0.on_s", 7.0),
    (RUN, BREAK, "plant.faults.0.on_s", 37.3),  # from the plant's start: up to 20 s until all are alive, 10 s to arm
    (RUN + LOCKSTEP, BREAK, "plant.faults.0.on_s", 3.305),
])  # fmt: skip
def test_what_begins_after_the_end_is_refused_and_what_begins_before_is_not(bench, text, injected, key, end_s):
    check_times(*bench(text + injected.format(at_s=end_s - 0.001)))
    late, file = bench(text + injected.format(at_s=end_s + 0.001))
    with pytest.raises(BadConfig) as caught:
        check_times(late, file)
    assert str(caught.value).startswith(f"{file}: key '{key}': the run is over by then: armed for 2 s, vented in 1 s")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", RUN.replace("2.0", "0.0", 1), RUN + "shared_router = true\n"])
def test_a_run_whose_end_nobody_knows_has_nothing_too_late(bench, text):
    made, file = bench(text + DROP.format(at_s=1e6))
    assert over_s(made) is None
    check_times(made, file)


def test_the_launcher_refuses_it_and_the_command_lines_duration_has_its_say(bench):
    _, file = bench(RUN + DROP.format(at_s=50))
    with pytest.raises(BadConfig, match=r"b\.toml: key 'faults\.injections\.0\.at_s': the run is over by then: armed for 2 s"):
        launch(file, Options())
    with pytest.raises(BadConfig, match="armed for 3 s"):
        launch(file, Options(duration_s=3.0))
    with pytest.raises(BadConfig, match="has no host 'elsewhere'"):  # so it came past the times
        launch(file, Options(duration_s=60.0, host="elsewhere"))
