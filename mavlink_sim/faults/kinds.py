"""All kinds of faults: their grammar, and the function that begins each: of the same name, in a `*_effects`.

The function gets the vehicle and the `ActiveFault`, and appends to `undo` what restores the state; effects
that depend on time go into `each_step`. docs/faults.md compares each with reality.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable

from mavlink_sim.faults import link_effects, message_effects, vehicle_effects
from mavlink_sim.faults.context import ActiveFault, FaultTarget
from mavlink_sim.faults.grammar import REQUIRED, Field, Kind, choice, number, positive, probability, whole
from mavlink_sim.px4.modes import Mode

Effect = Callable[[FaultTarget, ActiveFault], None]


def _battery(text: str) -> float | str:
    if text.lower() in vehicle_effects.CHARGE_OF_WARNING:
        return text.lower()
    try:
        return number(0.0, 1.0)(text)
    except ValueError:
        raise ValueError("0 to 1, or low, critical, emergency") from None


def _which(text: str) -> str:
    return "all" if text == "all" else str(_positive_whole(text))


_positive_whole = whole(1, 1_000_000)

_LINK = Field("link", str, "all", "onboard, gcs, or all")
_DIRECTION = Field("way", choice("both", "out", "in"), "both", "out: from the vehicle, in: to it, both")


def _on_links(name: str, summary: str, *fields: Field) -> Kind:
    return Kind(name, summary, (*fields, _LINK, _DIRECTION))


_TABLE: tuple[Kind, ...] = (
    _on_links("link_loss", "nothing gets through"),
    _on_links(
        "link_delay",
        "delay everything, in order",
        Field("seconds", number(0.0, 60.0, "s"), REQUIRED, "how late"),
        Field("jitter", number(0.0, 60.0, "s"), 0.0, "random additional delay, up to this many seconds"),
    ),
    _on_links(
        "link_jitter",
        "delay everything by a varying amount, in order",
        Field("seconds", number(0.0, 60.0, "s"), REQUIRED, "greatest delay"),
    ),
    _on_links(
        "packet_loss",
        "lose datagrams at random",
        Field("share", probability, REQUIRED, "probability, 0 to 1"),
    ),
    _on_links(
        "duplicate", "datagrams arrive twice", Field("share", probability, REQUIRED, "probability, 0 to 1")
    ),
    _on_links(
        "reorder",
        "reorder datagrams",
        Field("share", probability, REQUIRED, "probability of being delayed, 0 to 1"),
        Field("hold", number(0.001, 10.0, "s"), 0.05, "delay, seconds"),
    ),
    _on_links(
        "corrupt",
        "change bytes of datagrams",
        Field("share", probability, REQUIRED, "probability for a datagram, 0 to 1"),
    ),
    _on_links(
        "rate_limit",
        "limit the bytes per second, with a radio's small buffer",
        Field("bytes_per_s", number(10.0, 1e9, "bytes/s"), REQUIRED, "a 57600 baud radio: 5760"),
    ),
    Kind("heartbeat_only", "only HEARTBEAT is sent of all streams", (_LINK,)),
    Kind(
        "lost_ack",
        "acknowledgements of commands are not sent",
        (
            Field("which", _which, "all", "all, or N: only the Nth from now"),
            Field("command", whole(0, 65535), 0, "only of this MAV_CMD; 0: of any"),
            _LINK,
        ),
    ),
    Kind("gps_loss", "no fix; the position becomes invalid after 5 s of dead reckoning"),
    Kind(
        "gps_drift",
        "the measured position drifts, and the vehicle with it",
        (
            Field("speed", number(0.01, 50.0, "m/s"), 0.5, "m/s"),
            Field("towards", number(0.0, 360.0, "degrees"), None, "degrees from north; by default seeded"),
            Field("limit", number(0.1, 10000.0, "m"), 100.0, "metres at most"),
        ),
    ),
    Kind(
        "height_drift",
        "the estimated height drifts, as a barometer's; home is set again at arming",
        (
            Field("up", number(-100.0, 100.0, "m"), 0.73, "metres"),
            Field("over", positive, 10.0, "seconds until the whole error is reached"),
        ),
    ),
    Kind(
        "ekf_reset",
        "the estimate jumps, the vehicle does not; reset_counter counts it",
        (
            Field("north", number(-1000.0, 1000.0, "m"), 2.0, "metres"),
            Field("east", number(-1000.0, 1000.0, "m"), 0.0, "metres"),
            Field("down", number(-100.0, 100.0, "m"), 0.0, "metres"),
            Field("yaw", number(-180.0, 180.0, "degrees"), 0.0, "degrees of the heading"),
        ),
    ),
    Kind(
        "battery",
        "remaining charge",
        (Field("remaining", _battery, REQUIRED, "0 to 1, or low, critical, emergency"),),
    ),
    Kind(
        "motor_failure",
        "a rotor gives no thrust",
        (Field("motor", whole(1, 4), REQUIRED, "PX4's number: 1 front right, 2 rear left, 3, 4"),),
    ),
    Kind(
        "wind",
        "add a steady wind",
        (
            Field("speed", number(0.0, 40.0, "m/s"), REQUIRED, "m/s"),
            Field(
                "from",
                number(0.0, 360.0, "degrees"),
                None,
                "degrees from north that it blows from; by default seeded",
            ),
        ),
    ),
    Kind(
        "gust",
        "one gust, rising and falling as a cosine",
        (
            Field("speed", number(0.0, 40.0, "m/s"), REQUIRED, "m/s at its peak"),
            Field(
                "from",
                number(0.0, 360.0, "degrees"),
                None,
                "degrees from north that it blows from; by default seeded",
            ),
        ),
    ),
    Kind(
        "camera_freeze",
        "the camera repeats its last image with new stamps",
        (
            Field("what", choice("all", "image", "depth"), "all", "image, depth, or all"),
            Field("clock", choice("no", "yes"), "no", "yes: a clock in the image goes on"),
        ),
    ),
    Kind(
        "pilot_takeover",
        "a pilot with a remote control switches the mode",
        (Field("mode", choice(*(mode.name for mode in Mode)), "POSCTL", "a mode's name"),),
    ),
    Kind(
        "refuse_mode",
        "requests for a mode are answered TEMPORARILY_REJECTED",
        (
            Field("mode", choice("any", *(mode.name for mode in Mode)), "any", "a mode's name, or any"),
            Field("count", _which, "all", "all, or a number"),
        ),
    ),
    Kind(
        "reboot",
        "the autopilot restarts: motors off, no traffic at first, its clock begins at 0",
        (Field("seconds", positive, 4.0, "of silence"),),
    ),
    Kind(
        "time_jump",
        "the boot clock jumps",
        (Field("seconds", number(-1e5, 1e5, "s"), REQUIRED, "forward; negative: back"),),
    ),
    Kind(
        "second_autopilot",
        "another autopilot on the same links: it sends its streams and answers",
        (Field("system", whole(0, 255), 0, "its system id; 0: the same as this vehicle's"),),
    ),
    Kind(
        "stall",
        "stop the vehicle's time, or slow it down",
        (Field("pace", number(0.0, 0.99), 0.0, "simulated seconds per second"),),
    ),
)

KINDS: dict[str, Kind] = {kind.name: kind for kind in _TABLE}
_FUNCTIONS = ChainMap(vars(link_effects), vars(message_effects), vars(vehicle_effects))
EFFECTS: dict[str, Effect] = {name: _FUNCTIONS[name] for name in KINDS}
