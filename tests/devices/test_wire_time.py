import pytest

from softloop.devices.protocols.wire_time import can_frame_ns, serial_ns


def stuffed_bits(bits):
    """What ISO 11898-1 puts on the wire for `bits`: after five equal bits, one of the other kind."""
    sent, run = [], 0
    for bit in bits:
        run = run + 1 if sent and bit == sent[-1] else 1
        sent.append(bit)
        if run == 5:
            sent.append(1 - bit)
            run = 1
    return sent


@pytest.mark.parametrize(("dlc", "bits"), [(0, 55), (2, 75), (8, 135)])
def test_worst_case_frames_have_the_bits_of_the_schedulability_formula(dlc, bits):
    assert can_frame_ns(dlc, 1_000_000) == bits * 1000
    assert can_frame_ns(dlc, 500_000) == bits * 2000


@pytest.mark.parametrize("dlc", range(9))
def test_the_worst_bit_pattern_needs_exactly_that_long(dlc):
    covered = 34 + 8 * dlc
    worst = [0] * 5 + [1 - (i // 4) % 2 for i in range(covered - 5)]
    assert (len(stuffed_bits(worst)) + 13) * 1000 == can_frame_ns(dlc, 1_000_000)


@pytest.mark.parametrize("dlc", [-1, 9])
def test_other_lengths_are_refused(dlc):
    with pytest.raises(ValueError, match="0 to 8"):
        can_frame_ns(dlc, 500_000)


def test_a_sample_of_the_inclinometer_takes_1_91_ms():
    assert serial_ns(22, 115_200) == 1_909_722
    assert serial_ns(0, 9600) == 0
