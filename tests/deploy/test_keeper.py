import pytest

from softloop.deploy.keeper import FIRST_WAIT_S, LIVED_S, LONGEST_WAIT_S, BackOff, Keeper, Kept
from softloop.deploy.node import KEPT_PROCESSES, PROCESSES


class Toy:
    """A child that runs until it is given a code."""

    name = "toy"

    def __init__(self):
        self.code = None

    def exit_code(self):
        return self.code

    def epitaph(self):
        return f"process 'toy' ended with code {self.code}"


class Watched:
    def __init__(self, *, needed=True, comes_up=True):
        self.said, self.told, self.made = [], [], [Toy()]
        self.up = comes_up
        self.keeper = Keeper(self.said.append, lambda *word: self.told.append(word))
        self.kept = Kept(self.made[0], self.start, lambda: self.up, needed=needed)
        self.keeper.keep(self.kept, 0.0)

    def start(self):
        self.made.append(Toy())
        return self.made[-1]

    def dies(self, at_s, code=-9):
        self.made[-1].code = code
        self.keeper.look(at_s)


def test_waits_double_up_to_a_limit_and_begin_again_after_a_life():
    back_off = BackOff()
    waits = [back_off.after(0.1) for _ in range(9)]
    assert waits[:4] == [0.5, 1.0, 2.0, 4.0]
    assert waits[-1] == LONGEST_WAIT_S
    assert back_off.after(LIVED_S) == FIRST_WAIT_S


def test_one_that_dies_is_started_after_its_wait_and_is_back_once_it_has_come_up():
    toy = Watched(comes_up=False)
    toy.dies(10.0)
    assert toy.told == [("toy", False, 0.0)]
    toy.keeper.look(10.4)
    assert len(toy.made) == 1
    toy.keeper.look(10.5)
    assert len(toy.made) == 2
    toy.keeper.look(11.0)
    assert len(toy.told) == 1
    toy.up = True
    toy.keeper.look(12.0)
    toy.keeper.look(12.1)
    assert toy.told[1:] == [("toy", True, 2.0)]
    assert toy.said == ["process 'toy' ended with code -9; it is started again in 0.5 s", "process 'toy' is back"]


def test_one_that_dies_again_before_it_was_back_waits_longer_and_is_one_loss():
    toy = Watched(comes_up=False)
    toy.dies(10.0)
    toy.keeper.look(10.5)
    toy.dies(10.6)
    assert "in 1 s" in toy.said[-1]
    assert toy.told == [("toy", False, 0.0)]


@pytest.mark.parametrize(("code", "lived_s", "again"), [(3, 1.0, False), (0, 100.0, False), (-9, 1.0, True), (3, 6.0, True)])
def test_a_viewer_that_cannot_start_or_was_ended_in_good_order_is_left_alone(code, lived_s, again):
    toy = Watched(needed=False)
    toy.dies(lived_s, code)
    toy.keeper.look(lived_s + 100.0)
    assert len(toy.made) == (2 if again else 1)
    assert ("goes on without it" in toy.said[0]) == (not again)


def test_what_is_needed_comes_back_however_it_ended():
    for code in (0, 3, -9):
        toy = Watched()
        toy.dies(0.1, code)
        toy.keeper.look(1.0)
        assert len(toy.made) == 2


def test_only_what_listens_is_kept():
    assert not [p.name for p in PROCESSES if p.realtime and p.name in KEPT_PROCESSES]
