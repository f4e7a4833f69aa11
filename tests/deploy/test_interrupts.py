"""Ctrl-C is KeyboardInterrupt, but not in the middle of a library that cannot be left there."""

import signal
import subprocess
import sys
import time

import pytest

from softloop.deploy.interrupts import NOT_IN, can_be_left, careful_interrupts

INSIDE = """
def work(then):
    try:
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.1)  # the interrupt is tried again and again meanwhile
        return then()
    except KeyboardInterrupt:
        return "torn"
"""


def code_of(module):
    names = {"__name__": module, "signal": signal, "time": time}
    exec(INSIDE, names)
    return names["work"]


def what_an_interrupt_leaves_of(work, then, timeout_s=10.0):
    """What `work(then)` came to; and the interrupt comes after it."""
    came = None
    with careful_interrupts():
        try:
            came = work(then)
            time.sleep(timeout_s)
        except KeyboardInterrupt:
            return came
    raise AssertionError("the interrupt was lost")


@pytest.mark.parametrize("library", NOT_IN)
@pytest.mark.parametrize("deeper", ["", ".within"])
def test_a_library_that_must_not_be_left_ends_what_it_does_first(library, deeper):
    assert what_an_interrupt_leaves_of(code_of(library + deeper), lambda: "whole") == "whole"


def test_nor_is_it_left_from_what_it_calls():
    mine = code_of("somebody.else")
    assert what_an_interrupt_leaves_of(code_of("numba.core"), lambda: mine(lambda: "whole")) == "whole"


@pytest.mark.parametrize("module", ["__main__", "numbas", "softloop.numba", "concurrent.futures.thread", "", None])
def test_any_other_code_is_left_at_once(module):
    with careful_interrupts():
        assert code_of(module)(lambda: "went on") == "torn"


def test_an_interrupt_that_waits_goes_to_who_handles_it_by_then():
    came = []
    with careful_interrupts():
        code_of("numba")(lambda: signal.signal(signal.SIGINT, lambda *_: came.append("theirs")))
        end = time.monotonic() + 10.0
        while not came and time.monotonic() < end:
            time.sleep(0.01)
    assert came == ["theirs"]


def test_all_is_as_before_afterwards():
    before = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGALRM)]
    with careful_interrupts():
        assert signal.getsignal(signal.SIGINT) is not before[0]
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGALRM)] == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_who_ignores_interrupts_goes_on_ignoring_them():
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\nfrom softloop.deploy.interrupts import careful_interrupts\n"
    )
    code += "with careful_interrupts(): signal.raise_signal(signal.SIGINT); print('here')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "here\n", "")


def test_nowhere_is_somewhere_that_can_be_left():
    assert can_be_left(None)
