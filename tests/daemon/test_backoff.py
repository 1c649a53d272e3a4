import random

from trigpointd.backoff import Backoff


def test_delays_double_up_to_a_limit_and_are_cut_by_up_to_a_half() -> None:
    backoff = Backoff(0.1, 2.0, random.Random(7))
    delays = [backoff.next_s() for _ in range(50)]
    for delay_s, whole_s in zip(delays, [0.1, 0.2, 0.4, 0.8, 1.6, *[2.0] * 45], strict=True):
        assert whole_s / 2 <= delay_s <= whole_s
    assert len(set(delays)) == len(delays)


def test_after_a_success_they_begin_anew() -> None:
    backoff = Backoff(0.1, 2.0)
    for _ in range(5):
        backoff.next_s()
    backoff.reset()
    assert backoff.next_s() <= 0.1
