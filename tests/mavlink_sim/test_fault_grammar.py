"""The grammar of faults; invalid input is one line."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.faults.grammar import FaultError, parse_fault
from mavlink_sim.faults.kinds import EFFECTS, KINDS


@pytest.mark.parametrize(
    ("text", "name", "values", "at_s", "duration_s"),
    [
        ("link_delay 0.2", "link_delay", {"seconds": 0.2, "link": "all"}, None, None),
        ("at=20 motor_failure 2", "motor_failure", {"motor": 2}, 20.0, None),
        ("for=5 packet_loss 0.3 link=gcs way=out", "packet_loss", {"share": 0.3, "way": "out"}, None, 5.0),
        ("packet_loss share=0.3", "packet_loss", {"share": 0.3}, None, None),
        ("battery Low", "battery", {"remaining": "low"}, None, None),
        ("battery 0.4", "battery", {"remaining": 0.4}, None, None),
        ("ekf_reset 1 2 yaw=30", "ekf_reset", {"north": 1.0, "east": 2.0, "yaw": 30.0}, None, None),
        ("refuse_mode offboard count=2", "refuse_mode", {"mode": "OFFBOARD", "count": "2"}, None, None),
        ("stall for=2 at=1", "stall", {"pace": 0.0}, 1.0, 2.0),
    ],
)
def test_words_in_any_order(
    text: str, name: str, values: dict[str, object], at_s: float | None, duration_s: float | None
) -> None:
    fault = parse_fault(text, KINDS)
    assert fault.kind.name == name
    assert values.items() <= dict(fault.values).items()
    assert (fault.at_s, fault.duration_s) == (at_s, duration_s)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no fault"),
        ("at=3", "names no fault"),
        ("link_dely 1", "link_delay"),
        ("link_delay", "link_delay SECONDS"),
        ("link_delay x", "0 to 60 s"),
        ("link_delay nan", "expected a number"),
        ("link_delay 1 2 gcs in 5", "unexpected"),
        ("link_delay 1 colour=red", "unexpected 'colour='"),
        ("link_delay 1 way=up", "both, out, in"),
        ("link_delay 1 at=-1", "expected a number, 0"),
        ("link_delay 1 for=0", "above 0 s"),
        ("link_delay 1 for=1 for=2", "for is given twice"),
        ("motor_failure 5", "1 to 4"),
        ("battery full", "low, critical, emergency"),
        ("lost_ack 0", "a whole number, 1 to"),
        ("gps_loss seed=x", "a whole number"),
    ],
)
def test_invalid_faults_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(FaultError) as refusal:
        parse_fault(text, KINDS)
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


@given(
    st.text(max_size=80)
    | st.lists(st.sampled_from([*KINDS, "at=1", "for=2", "0.5", "x", "link=all"])).map(" ".join)
)
def test_any_text_is_a_fault_or_a_refusal(text: str) -> None:
    try:
        fault = parse_fault(text, KINDS)
    except FaultError:
        return
    again = parse_fault(str(fault), KINDS)
    assert again.values == fault.values
    assert again.duration_s == fault.duration_s


def test_every_kind_has_an_effect_and_a_summary() -> None:
    assert set(KINDS) == set(EFFECTS)
    for kind in KINDS.values():
        assert kind.summary
        assert kind.usage.startswith(kind.name)
