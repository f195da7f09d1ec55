"""A node of pyzeros: an implementation of rmw_zenoh's wire format that is not ours, and not rmw_zenoh.

`python pyzeros_receiver.py ROUTER DOMAIN [[TYPE, NAME], …]` subscribes, and prints a JSON line for everything
that it gets: samples, and liveliness tokens with what pyzeros itself would declare for the same publisher.
Run in an environment of its own.
"""

import json
import sys
import threading
from dataclasses import asdict, dataclass, field

import zenoh
from pyzeros import Node
from pyzeros.pub import token_keyexpr
from pyzeros.qos import QosProfile
from pyzeros.sub import RawSub
from pyzeros.utils import ros_type_to_dds_type
from ros2_pyterfaces.cyclone import all_msgs
from ros2_pyterfaces.cyclone.all_msgs import Header, Pose, PoseWithCovariance, Vector3
from ros2_pyterfaces.cyclone.all_msgs import TransformStamped as Stamped
from ros2_pyterfaces.cyclone.idl import IdlStruct, types


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs/msg/TFMessage"):
    transforms: types.sequence[Stamped] = field(default_factory=list)


@dataclass
class Point2D(IdlStruct, typename="vision_msgs/msg/Point2D"):
    x: types.float64 = 0.0
    y: types.float64 = 0.0


@dataclass
class Pose2D(IdlStruct, typename="vision_msgs/msg/Pose2D"):
    position: Point2D = field(default_factory=Point2D)
    theta: types.float64 = 0.0


@dataclass
class BoundingBox2D(IdlStruct, typename="vision_msgs/msg/BoundingBox2D"):
    center: Pose2D = field(default_factory=Pose2D)
    size_x: types.float64 = 0.0
    size_y: types.float64 = 0.0


@dataclass
class BoundingBox3D(IdlStruct, typename="vision_msgs/msg/BoundingBox3D"):
    center: Pose = field(default_factory=Pose)
    size: Vector3 = field(default_factory=Vector3)


@dataclass
class ObjectHypothesis(IdlStruct, typename="vision_msgs/msg/ObjectHypothesis"):
    class_id: str = ""
    score: types.float64 = 0.0


@dataclass
class ObjectHypothesisWithPose(IdlStruct, typename="vision_msgs/msg/ObjectHypothesisWithPose"):
    hypothesis: ObjectHypothesis = field(default_factory=ObjectHypothesis)
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)


@dataclass
class Detection2D(IdlStruct, typename="vision_msgs/msg/Detection2D"):
    header: Header = field(default_factory=Header)
    results: types.sequence[ObjectHypothesisWithPose] = field(default_factory=list)
    bbox: BoundingBox2D = field(default_factory=BoundingBox2D)
    id: str = ""


@dataclass
class Detection2DArray(IdlStruct, typename="vision_msgs/msg/Detection2DArray"):
    header: Header = field(default_factory=Header)
    detections: types.sequence[Detection2D] = field(default_factory=list)


@dataclass
class Detection3D(IdlStruct, typename="vision_msgs/msg/Detection3D"):
    header: Header = field(default_factory=Header)
    results: types.sequence[ObjectHypothesisWithPose] = field(default_factory=list)
    bbox: BoundingBox3D = field(default_factory=BoundingBox3D)
    id: str = ""


@dataclass
class Detection3DArray(IdlStruct, typename="vision_msgs/msg/Detection3DArray"):
    header: Header = field(default_factory=Header)
    detections: types.sequence[Detection3D] = field(default_factory=list)


# No postponed annotations above: pyzeros reads them as they are.
OURS = {kind.get_type_name(): kind for kind in (TFMessage, Detection2DArray, Detection3DArray)}


lock = threading.Lock()


def say(**values: object) -> None:
    with lock:
        print(json.dumps(values, default=str), flush=True)


def on_token(session: zenoh.Session, kinds: dict[str, type], sample: zenoh.Sample) -> None:
    key = str(sample.key_expr)
    parts = key.split("/")
    expected = ""
    if parts[5] == "MP" and (name := parts[9].replace("%", "/")) in kinds:
        kind = kinds[name]
        latched = parts[12].split(":")[1] == "1"
        expected = token_keyexpr(
            name,
            ros_type_to_dds_type(kind.get_type_name()),
            kind.hash_rihs01(),
            QosProfile(depth=1, durability="transient_local") if latched else QosProfile(),
            node_name=parts[8],
            session=session,
            domain_id=parts[1],
            namespace=parts[7].replace("%", "/"),
            _zenoh_id=parts[2],
            _node_id=parts[3],
            _entity_id=parts[4],
        )
    say(token=key, alive=sample.kind == zenoh.SampleKind.PUT, expected=expected)


def on_sample(name: str, kind: type, sample: zenoh.Sample) -> None:
    value = asdict(kind.deserialize(sample.payload.to_bytes()))
    if "data" in value and not isinstance(value["data"], str):
        value["data"] = len(value["data"])
    # pyzeros itself would compile what reads an attachment.
    say(name=name, attachment=sample.attachment.to_bytes().hex(), value=value)


def main() -> None:
    router, domain, topics = sys.argv[1], int(sys.argv[2]), json.loads(sys.argv[3])
    kinds = {name: OURS.get(kind) or getattr(all_msgs, kind.rpartition("/")[2]) for kind, name in topics}
    for kind in kinds.values():
        kind.deserialize(kind().serialize())  # which it prepares once, and not safely from many threads
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')  # as every node of rmw_zenoh
    config.insert_json5("connect/endpoints", json.dumps([router]))
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/exit_on_failure", "false")
    with zenoh.open(config) as session:
        node = Node("receiver", session, domain_id=domain)
        watching = session.liveliness().declare_subscriber(
            f"@ros2_lv/{domain}/**", lambda sample: on_token(session, kinds, sample), history=True
        )
        readers = [
            RawSub(
                kind, name, lambda sample, name=name, kind=kind: on_sample(name, kind, sample), session=node
            )
            for name, kind in kinds.items()
        ]
        say(ready=len(readers))
        sys.stdin.read()
        del watching


main()
