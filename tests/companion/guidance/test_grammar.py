import json
import math
from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance import (
    Approach,
    FigureEight,
    Follow,
    FollowPath,
    Gimbal,
    Goto,
    Hold,
    Land,
    Mission,
    Orbit,
    Patrol,
    Policy,
    Rtl,
    Seek,
    Stop,
    Takeoff,
)
from companion.guidance.command import COMMANDS, NO_CONTEXT, Command, GrammarError, arguments_of
from companion.guidance.grammar import describe, json_schema, parse
from companion.guidance.objects.tracked_object import Subject

NAMES = ("person", "bicycle", "car", "truck", "boat", "dog", "chair", "traffic light", "fire_hydrant")


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("takeoff 5", Takeoff(5.0)),
        ("takeoff", Takeoff(2.5)),
        ("takeoff altitude=7.5m", Takeoff(7.5)),
        ("TAKEOFF 5", Takeoff(5.0)),
        ("seek car", Seek("car")),
        ("seek class=car laps=1", Seek("car", laps=1.0)),
        ("approach person distance=3", Approach(Subject("person"), distance_m=3.0)),
        ("orbit radius=10 speed=2", Orbit(radius_m=10.0, speed_mps=2.0)),
        (
            "orbit radius=10m speed=2m/s direction=counterclockwise",
            Orbit(None, 10.0, 2.0, 0.0, "counterclockwise"),
        ),
        ("orbit car radius=8", Orbit(Subject("car"), 8.0)),
        ("hold", Hold()),
        ("  land \n", Land()),
        ("rtl", Rtl()),
        ("stop", Stop()),
        ('seek "traffic light"', Seek("traffic light")),
        ("seek traffic_light", Seek("traffic light")),
        ("seek Traffic-Light", Seek("traffic light")),
        ("seek traffic light", Seek("traffic light")),
        ("seek fire hydrant laps=3", Seek("fire_hydrant", laps=3.0)),
        ('approach class="traffic light"', Approach(Subject("traffic light"))),
        ("seek car sweep=-60deg sweep_rate=10", Seek("car", sweep_deg=-60.0, sweep_rate_dps=10.0)),
        ("gimbal pitch=-30", Gimbal(-30.0)),
        ("gimbal -30deg 15", Gimbal(-30.0, 15.0)),
        ("gimbal", Gimbal(0.0, 0.0)),
        ("follow track=17", Follow(Subject(track_id=17))),
        ("follow track=17 distance=6", Follow(Subject(track_id=17), distance_m=6.0)),
        ("approach track=17", Approach(Subject(track_id=17))),
        ("approach marker=0", Approach(Subject(marker_id=0))),
        ("orbit track=17 radius=8", Orbit(Subject(track_id=17), radius_m=8.0)),
        ("gimbal track=17", Gimbal(subject=Subject(track_id=17))),
        ("goto north=10 east=5", Goto(10.0, 5.0)),
        (
            "goto altitude=8 forward=5 right=0 heading=90",
            Goto(altitude_m=8.0, forward_m=5.0, right_m=0.0, heading_deg=90.0),
        ),
        ("goto latitude=47.397742 longitude=8.5", Goto(latitude_deg=47.397742, longitude_deg=8.5)),
        ('follow-path "0,0 10,0,6" laps=0', FollowPath("0,0 10,0,6", laps=0.0)),
        ("follow-path 0,0 10,0 10,10,4", FollowPath("0,0 10,0 10,10,4")),
        ("figure-eight radius=8 yaw_mode=hold", FigureEight(8.0, yaw_mode="hold")),
    ],
)
def test_parse_commands(text: str, command: Command) -> None:
    assert parse(text, NAMES) == command
    assert parse(str(command), NAMES) == command
    assert command.build(NO_CONTEXT).name == command.word


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["no command", "takeoff"]),
        ("   ", ["no command"]),
        ("sek car", ["'sek'", "seek"]),
        ("fly", ["unknown command 'fly'"]),
        ("find", ["unknown command 'find'; known: takeoff, "]),
        ("launch", ["unknown command 'launch'; known: takeoff, "]),
        ("laand", ["unknown command 'laand'; did you mean land?"]),
        ("seek", ["class is missing", "seek CLASS"]),
        ("seek trcuk", ["unknown class 'trcuk'", "truck"]),
        ("seek zebra", ["unknown class 'zebra'", "person"]),
        ("approach person distance=0", ["distance", "1 to 100 m", "0"]),
        ("approach person distance=near", ["distance", "1 to 100 m", "'near'"]),
        ("approach person distance=nan", ["distance", "nan"]),
        ("approach person distnce=3", ["unknown argument 'distnce'", "distance"]),
        ("takeoff 500", ["altitude", "1 to 50 m", "500"]),
        ("takeoff 5 6", ["'6'", "unexpected argument"]),
        ("takeoff 5 altitude=6", ["altitude", "twice"]),
        ("land now=1", ["unknown argument 'now'", "no arguments"]),
        ("land now", ["'now'", "unexpected argument"]),
        ('seek "car', ["quote"]),
        ("orbit direction=left", ["direction", "clockwise", "'left'"]),
        ("orbit radius=1 speed=5", ["speed", "1.41 m/s", "5"]),
        ("takeoff=5", ["unknown command 'takeoff=5'"]),
        ("gimbal pitch=-100", ["pitch", "-90 to 90 deg", "-100"]),
        ("seek car sweep=2", ["sweep", "5 deg", "2"]),
        ("seek car sweep_rate=5", ["sweep_rate needs sweep"]),
        ("seek car pattern=square radius=20 sweep=-60", ["pattern=square", "sweep"]),
        ("seek car pattern=square", ["pattern=square needs radius"]),
        ("seek car pattern=lawnmower width=10", ["needs width and height"]),
        ("seek car radius=10", ["pattern=turn does not use radius"]),
        ("seek car pattern=square radius=10 width=3", ["does not use width"]),
        ("seek car pattern=zigzag", ["square or lawnmower"]),
        ("approach car retries=1.5", ["whole number"]),
        ("follow", ["class or track or marker", "missing", "follow CLASS|track=…"]),
        ("follow car track=17", ["class or track", "both"]),
        ("approach car track=17", ["class or track", "both"]),
        ("approach car marker=7", ["class", "marker"]),
        ("orbit car track=17", ["class or track", "both"]),
        ("orbit car marker=7", ["class", "marker"]),
        ("orbit track=3 marker=7", ["track", "marker"]),
        ("follow track=0", ["track", "track_id", "0"]),
        ("follow track=1.5", ["track", "track_id", "1.5"]),
        ("follow track=car", ["track", "track_id", "car"]),
        ("follow track=99999999999999999999", ["track", "track_id"]),
        ("approach marker=7.5", ["marker", "'7.5'"]),
        ("follow marker=1024", ["marker", "1024", "0 to 1023"]),
        ("gimbal pitch=-30 track=17", ["track", "pitch", "both"]),
        ("gimbal class=persn", ["persn", "person"]),
        ("gimbal class=person track=3", ["both", "class", "track"]),
        ("gimbal pitch=-5 latitude=1 longitude=1", ["both", "pitch", "latitude"]),
        ("gimbal latitude=47.5", ["longitude", "missing"]),
        ("gimbal altitude=5", ["latitude and longitude", "missing"]),
        ("gimbal latitude=91 longitude=0", ["latitude", "-90 to 90 deg", "91"]),
        ("goto", ["exactly one pair"]),
        ("goto 3", ["one is missing"]),
        ("goto 3 4 forward=1 right=2", ["forward and right"]),
        ("goto 3 99999", ["-5000 to 5000"]),
        ("follow-path", ["points is missing"]),
        ("follow-path 1,2 3", ["'3'"]),
        ("follow-path 1,nan", ["'1,nan'"]),
        ("follow-path 1e308,0 1,1", ["within 5000 m"]),
        ("follow-path 1,1,-50 1,2", ["1 to 500 m high"]),
        ("follow-path 1,1 1,2 laps=0.5", ["laps must be 0, or 1 or more"]),
        ("figure-eight radius=1", ["3 to 200"]),
        ("patrol 0,0 classes=car", ["2 points"]),
        ("patrol 0,0 9,9", ["classes is missing"]),
        ("patrol 0,0 9,9 classes=car,zebra", ["unknown class 'zebra'"]),
        ("patrol 0,0 9,9 classes=car on_detection=photo", ["hold or approach"]),
        ('patrol "0,0 9,9" classes=car do=hold', ["do= ", "renamed ", "on_detection=", "0.2.0"]),
        ("follow-path 0,0 nose=along", ["nose= ", "renamed ", "yaw_mode=", "0.2.0"]),
        ("land-on-marker 7 pad=still", ["pad= ", "renamed ", "target=", "0.2.0"]),
    ],
)
def test_errors_are_one_line_with_key_and_range(text: str, parts: list[str]) -> None:
    with pytest.raises(GrammarError) as caught:
        parse(text, NAMES)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_any_class_name_is_accepted_without_a_detector() -> None:
    assert parse("seek dragon") == Seek("dragon")


def test_help_lists_every_command_and_argument() -> None:
    text = describe()
    for kind in COMMANDS.values():
        assert kind.word in text
    assert "(1 to 100 m)" in text
    assert "takeoff [altitude=2.5]" in text


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


class_names = st.text(st.characters(min_codepoint=32, max_codepoint=0x24F), min_size=1, max_size=20).filter(
    lambda name: name.strip() and name.isprintable()
)
subjects = (
    st.builds(Subject, class_names)
    | st.builds(Subject, track_id=st.integers(1, 2**63 - 1))
    | st.builds(Subject, marker_id=st.integers(0, 1023))
)
directions = st.sampled_from(["clockwise", "counterclockwise"])
orbits = st.tuples(number(1, 100), number(0.1, 1.0)).flatmap(
    lambda pair: st.builds(
        Orbit,
        st.none() | subjects,
        st.just(pair[0]),
        st.just(min(10.0, max(0.1, pair[1] * math.sqrt(2.0 * pair[0]) * 0.999))),
        number(0, 100),
        directions,
    )
)
commands = st.one_of(
    st.builds(Takeoff, number(1, 50)),
    st.builds(Land),
    st.builds(Rtl),
    st.builds(Stop),
    st.builds(Hold, number(0, 3600)),
    orbits,
    st.builds(Seek, class_names, number(0.25, 20), number(0.05, 1), number(0.05, 1), directions),
    st.builds(
        Seek,
        class_names,
        sweep_deg=number(5, 90) | number(-90, -5),
        sweep_rate_dps=number(2, 60),
    ),
    st.builds(Gimbal, number(-90, 90), number(-180, 180)),
    st.builds(Gimbal, subject=subjects),
    st.builds(Follow, subjects, number(1.5, 100)),
    st.builds(Approach, subjects, number(1, 100), number(0.2, 10), number(0.05, 1), number(0.5, 60)),
    st.builds(
        Seek, class_names, pattern=st.just("square"), radius_m=number(1, 500), speed_mps=number(0.2, 20)
    ),
    st.builds(
        Seek,
        class_names,
        pattern=st.just("lawnmower"),
        width_m=number(1, 1000),
        height_m=number(1, 1000),
        spacing_m=st.none() | number(1, 200),
    ),
)
several_names = st.lists(
    class_names.map(lambda name: name.strip()).filter(lambda name: "," not in name), min_size=1
)
without_class_name = st.one_of(
    st.builds(Mission, class_names),
    st.builds(Policy, class_names, subjects, number(1, 100), number(1, 3600)),
    st.builds(
        Patrol,
        st.sampled_from(["0,0 10,0", "0,0,5 9,9,8 -3,2"]),
        several_names.map(",".join),
        st.sampled_from(["hold", "approach"]),
        number(1, 100),
    ),
)


@given(commands | without_class_name)
def test_text_of_a_command_parses_back(command: Command) -> None:
    assert parse(str(command)) == command
    assert str(parse(str(command))) == str(command)


def test_text_has_stated_values_also_if_they_are_the_default() -> None:
    ordered, stated = "orbit car radius=10 direction=clockwise", "orbit car radius=10"
    parsed = parse("orbit car direction=clockwise radius=10m")
    assert str(parsed) == ordered
    assert str(parse("orbit car")) == "orbit car"
    assert parse(stated) == parse("orbit car")


@given(commands)
def test_every_command_builds_a_behaviour_of_its_name(command: Command) -> None:
    behaviour = command.build(NO_CONTEXT)
    assert behaviour.name == command.word
    name = getattr(command, "class_name", "")
    assert behaviour.class_names == ((name,) if name else ())
    assert behaviour.subject == getattr(command, "subject", None)


@given(st.text(max_size=60))
def test_any_text_is_a_command_or_a_one_line_error(text: str) -> None:
    try:
        command = parse(text, NAMES)
    except GrammarError as error:
        text = str(error)
    else:
        text = str(command)
    assert text
    assert "\n" not in text


def test_every_field_is_an_argument_of_the_grammar() -> None:
    for kind in COMMANDS.values():
        parts = [part.of_subject or part.name for part, _ in arguments_of(kind)]
        assert list(dict.fromkeys(parts)) == [field.name for field in fields(kind)]


@pytest.mark.parametrize("text", ["hold", "hold 5", "orbit", "orbit laps=2", "land", "figure-eight laps=0"])
def test_endless_commands(text: str) -> None:
    assert parse(text).endless is (text in ("hold", "orbit", "figure-eight laps=0"))


def test_schema_has_every_command_and_its_ranges() -> None:
    schema = json_schema(["car", "dog"])
    json.dumps(schema)
    assert set(schema["$defs"]) == set(COMMANDS)
    approach = schema["$defs"]["approach"]
    assert schema["$defs"]["seek"]["required"] == ["class"]
    assert approach["oneOf"] == [{"required": ["class"]}, {"required": ["track"]}, {"required": ["marker"]}]
    assert approach["properties"]["class"]["enum"] == ["car", "dog"]
    distance = approach["properties"]["distance"]
    assert "nearest surface" in distance.pop("description")
    assert distance == {
        "type": "number",
        "minimum": 1.0,
        "maximum": 100.0,
        "unit": "m",
        "default": 5.0,
    }
