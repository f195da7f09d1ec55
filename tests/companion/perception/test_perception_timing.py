from companion.perception.status import WINDOW, StageTimes


def test_quantiles_are_of_the_newest_results() -> None:
    times = StageTimes()
    assert times.quantile_ms(0.5) == {}
    for _ in range(WINDOW):
        times.add({"inference": 1e6})
    for value in range(WINDOW):
        times.add({"inference": float(value), "decode": 2.0})
    assert times.quantile_ms(0.5) == {"inference": WINDOW / 2 - 1, "decode": 2.0}
    assert times.quantile_ms(0.99) == {"inference": 0.99 * WINDOW - 1, "decode": 2.0}
