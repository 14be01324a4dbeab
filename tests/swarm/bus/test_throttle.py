"""The throttled copy of a fast key."""

from swarm.bus.throttle import Throttle


class Notes:
    """What was published."""

    def __init__(self) -> None:
        self.told: list[tuple[str, object]] = []

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        self.told.append((key, message))


def test_a_throttled_copy_keeps_its_rate_whatever_that_of_the_key_is() -> None:
    bus = Notes()
    copy = Throttle(bus, "swarm/r0/balancer/state", 0.2)  # type: ignore[arg-type]
    for tick in range(251):  # 25 Hz, and after 5 s a second of silence
        copy.publish(tick, 100.0 + 0.04 * tick + (1.0 if tick > 125 else 0.0))
    assert {key for key, _ in bus.told} == {"swarm/r0/balancer/state/throttled"}
    assert 50 <= len(bus.told) <= 52
    gaps = [b - a for (_, a), (_, b) in zip(bus.told, bus.told[1:], strict=False)]  # type: ignore[operator]
    assert set(gaps) <= {1, 4, 5, 6}
    assert gaps.count(5) >= 40


def test_a_message_that_is_news_does_not_wait_for_the_period() -> None:
    bus = Notes()
    copy = Throttle(bus, "k", 0.2)  # type: ignore[arg-type]
    for t, news in ((0.0, False), (0.04, True), (0.08, False), (0.2, False), (0.24, False), (0.4, False)):
        copy.publish(t, t, news=news)
    assert [message for _, message in bus.told] == [0.0, 0.04, 0.2, 0.4]
