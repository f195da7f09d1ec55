"""The definitions are those of ROS: hashes, fields, and texts that others parse."""

from __future__ import annotations

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from companion.ros2.definitions import DEFINITIONS, fields_of, full_definition, type_hash
from companion.ros2.messages import OUTPUT_TOPICS
from companion.ros2.requests import STRING, TWIST_STAMPED
from tests.programs import DATA

# From rosbags with vision_msgs 4.1.1; of the three others from the wheels of ROS.
HASHES = {
    "vision_msgs/msg/Detection2DArray": "214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968",
    "vision_msgs/msg/Detection3DArray": "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
    "sensor_msgs/msg/CameraInfo": "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    "sensor_msgs/msg/CompressedImage": "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
}
VISION = tuple(name for name in DEFINITIONS if name.startswith("vision_msgs/"))


@pytest.mark.parametrize("type_name", HASHES)
def test_hash_of_a_type_is_the_known_one(type_name: str) -> None:
    assert type_hash(type_name) == f"RIHS01_{HASHES[type_name]}"


@pytest.mark.parametrize("type_name", DEFINITIONS)
def test_hash_is_that_of_rosbags(type_name: str) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in VISION:
        store.register(get_types_from_msg(DEFINITIONS[name], name))
    assert type_hash(type_name) == store.hash_rihs01(type_name)


@pytest.mark.parametrize("type_name", DEFINITIONS)
def test_whole_definition_has_every_type_inside(type_name: str) -> None:
    store = get_typestore(Stores.EMPTY)
    # The text alone, as in a bag: only the two time types are built in there.
    store.register(get_types_from_msg(full_definition(type_name), type_name))
    assert store.hash_rihs01(type_name) == type_hash(type_name)


@pytest.mark.needs("test data")
@pytest.mark.parametrize("type_name", VISION)
def test_vision_msgs_have_the_fields_of_their_project(type_name: str) -> None:
    text = (DATA / "ros2" / "vision_msgs" / f"{type_name.rpartition('/')[2]}.msg").read_text()
    theirs = get_types_from_msg(text, type_name)[type_name]
    assert get_types_from_msg(DEFINITIONS[type_name], type_name)[type_name] == theirs


def test_every_definition_is_of_a_message_in_use() -> None:
    used = {topic.type_name for topic in OUTPUT_TOPICS} | {STRING, TWIST_STAMPED}
    inside = {field.type_name for name in DEFINITIONS for field in fields_of(name) if field.nested}
    assert DEFINITIONS.keys() == used | inside


def test_unknown_type_is_named() -> None:
    for function in (type_hash, full_definition):
        with pytest.raises(ValueError, match="nav_msgs/msg/Odometry"):
            function("nav_msgs/msg/Odometry")
