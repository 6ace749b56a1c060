import numpy as np

from backend.numerics.reasons import SENTENCES, Reason, count_reasons, reason_sentences


def test_every_reason_is_one_bit_of_uint16_with_a_sentence():
    values = [int(reason) for reason in Reason]
    assert all(value.bit_count() == 1 and value < 1 << 16 for value in values)
    assert len(set(values)) == len(values)
    assert set(SENTENCES) == set(Reason)
    assert all(sentence.endswith(".") for sentence in SENTENCES.values())


def test_the_bits_are_stored_in_maps_and_never_change():
    assert [int(r) for r in (Reason.SATURATED, Reason.DARK, Reason.LOW_MODULATION)] == [1, 2, 4]
    assert int(Reason.OUTLIER) == 1 << 10
    assert int(Reason.CODE_MARGIN) == 1 << 13


def test_counts_count_a_pixel_once_per_reason():
    reasons = np.array([[0, 1, 3], [2, 2, 1 << 13]], dtype=np.uint16)
    counts = count_reasons(reasons)
    assert counts[Reason.SATURATED] == 2
    assert counts[Reason.DARK] == 3
    assert counts[Reason.CODE_MARGIN] == 1
    assert counts[Reason.OUTLIER] == 0
    assert count_reasons(np.zeros((0, 4), np.uint16))[Reason.DARK] == 0


def test_sentences_come_lowest_bit_first():
    assert reason_sentences(int(Reason.DARK | Reason.SATURATED)) == (
        SENTENCES[Reason.SATURATED],
        SENTENCES[Reason.DARK],
    )
