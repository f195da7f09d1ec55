"""The official models for download by name, with size and SHA-256.

They are YOLOX's of its authors' release 0.1.1rc0, and the assets of Ultralytics' release v8.4.0, from
published tables. Every digest was found in at least two independent tables, except the scales m, l and x of
YOLOv5u: these are from one table, whose n and s others confirm. No digests of YOLOX m, l
and x are known here.
"""

from __future__ import annotations

from dataclasses import dataclass

_YOLOX_RELEASE = "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0"
_RELEASE = "https://github.com/ultralytics/assets/releases/download/v8.4.0"
AGPL = "AGPL-3.0"
APACHE = "Apache-2.0"
LICENCE_NOTES = {
    APACHE: (
        "these weights are Megvii's, under Apache-2.0: keep the licence and the notices when you ship them"
    ),
    AGPL: (
        "these weights are Ultralytics', under AGPL-3.0 (or their commercial licence). AGPL-3.0 asks whoever "
        "lets others use a program over a network to offer them its source. That is between you and "
        "Ultralytics: https://www.ultralytics.com/license"
    ),
}


@dataclass(frozen=True, slots=True)
class KnownModel:
    """An official model file.

    Attributes:
        name: argument of `pull`; the file is the name with `suffix`.
        url: address of the file.
        size_bytes: of the file.
        sha256: 64 hexadecimal digits.
        licence: SPDX identifier.
        about: one-line description.
    """

    name: str
    url: str
    size_bytes: int
    sha256: str
    licence: str
    about: str
    suffix: str = ".pt"

    @property
    def file(self) -> str:
        return f"{self.name}{self.suffix}"


_PINNED = {
    "yolov5nu": (5562759, "9e9c1be448b0e1b8598975a9abcab9a0fd0e21182eb422cda7f044a0442d0937"),
    "yolov5su": (18581255, "054272ddbbb3035cea7ff6b97e5becea63d2cc57a4f06a2a8133f4d1a56e74ed"),
    "yolov5mu": (50589507, "02a430d1cec02dfabdcaf8afa05e3b967c19d3795a42c0ab8ad78bf2e24d016c"),
    "yolov5lu": (106913919, "4c78fd8b24761480f1e855361df39eaab131512babf2ba73ba6b394bba3c9061"),
    "yolov5xu": (195132283, "b173a82e928b444456f5d3d3d7cf11197fda04df8f59c114801d837036e25061"),
    "yolov8n": (6549796, "f59b3d833e2ff32e194b5bb8e08d211dc7c5bdf144b90d2c8412c47ccfc83b36"),
    "yolov8s": (22588772, "1f47a78bf100391c2a140b7ac73a1caae18c32779be7d310658112f7ac9aa78a"),
    "yolov8m": (52136884, "5d4a90cdc7a21786cc59cd19778e9eafff836df9e2da32524737c7ee6efe4fe5"),
    "yolov8l": (87792836, "64c9115303f6a25575f82200d1b22ec409fa6bd7d08d0313884fc20d919478cd"),
    "yolov8x": (136890692, "3df4ada6b4dad6d657868f2fdf7faecfb34dcfccf3a25c4b82079064718524c8"),
    "yolo11n": (5613764, "0ebbc80d4a7680d14987a577cd21342b65ecfd94632bd9a8da63ae6417644ee1"),
    "yolo11s": (19313732, "85a76fe86dd8afe384648546b56a7a78580c7cb7b404fc595f97969322d502d5"),
    "yolo11m": (40684120, "d5ffc1a674953a08e11a8d21e022781b1b23a19b730afc309290bd9fb5305b95"),
    "yolo11l": (51387343, "9ebd0e09d59811db4b1d61e2bc6730649608b1ac47f8dd01e2da6bca7c20023f"),
    "yolo11x": (114636239, "7bc158aa95c0ebfdd87f70f01653c1131b93e92522dbe15c228bcd742e773a24"),
    "yolo12n": (5595063, "419ff3dca37d69bacc93a50fa0c186a1c6f9fe62fae0f108b0872829689e9ca6"),
    "yolo12s": (19006455, "e915c2c4286e3f6f8610ef106fa3f94a7b8c19b30eccede5887e22c33ef75f58"),
    "yolo12m": (40904955, "4c6d179786eddf6134ee469ae2f4ce04cbe4e9d1a47d6b669d9cd6b9c6c513d8"),
    "yolo12l": (53699086, "0babd8dc8f775bb64bb052debdff3d8b9e9b57efa9d7bfa11c84bb82c3fec336"),
    "yolo12x": (119322638, "682ce8dadee004dbe964950f1bf3eda451671815a6ed62db80b398916b9b7c6f"),
    "yolo26n": (5544453, "9b09cc8bf347f0fc8a5f7657480587f25db09b34bf33b0652110fb03a8ad4fef"),
    "yolo26s": (20422725, "646f8bc3fe0a656803d95c294f7852321748cb29d13466a1af8862e2db384a1b"),
    "yolo26m": (44255705, "401cea9ab23ad19246ff7744859816bc599f350e93c9dd30367b6f0a0745d0b7"),
    "yolo26l": (53211173, "9fe3c544f2b19bebad7ea41e76d7ad3d88b7c2f10d11d24430c5311f6b32db26"),
    "yolo26x": (118667365, "9fdd44a31c504547ffb81d2c6d9e6dac3493c8eaa8b0398d3f43bae6c7003e92"),
}
_FAMILIES = {
    "yolov5": "YOLOv5u",
    "yolov8": "YOLOv8",
    "yolo11": "YOLO11",
    "yolo12": "YOLO12",
    "yolo26": "YOLO26",
}


_YOLOX = {
    "yolox_nano": (3659407, "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d"),
    "yolox_tiny": (20219662, "427cc366d34e27ff7a03e2899b5e3671425c262ea2291f88bb942bc1cc70b0f7"),
    "yolox_s": (35858002, "c5c2d13e59ae883e6af3b45daea64af4833a4951c92d116ec270d9ddbe998063"),
}


def _about(name: str) -> str:
    return f"{_FAMILIES[name[:6]]}, scale {name[6]}, 80 classes of COCO"


# The permissive ones first: `models show` shows them in this order.
KNOWN: dict[str, KnownModel] = {
    name: KnownModel(
        name,
        f"{_YOLOX_RELEASE}/{name}.onnx",
        size,
        digest,
        APACHE,
        f"YOLOX, scale {name.removeprefix('yolox_')}, 80 classes of COCO, ONNX",
        ".onnx",
    )
    for name, (size, digest) in _YOLOX.items()
} | {
    name: KnownModel(name, f"{_RELEASE}/{name}.pt", size, digest, AGPL, _about(name))
    for name, (size, digest) in _PINNED.items()
}


CAMERA_MODEL = "yolox_s"
"""For camera images, where no model is named: Apache-2.0, and it runs on what a plain installation has."""


def known_by_digest(sha256: str) -> KnownModel | None:
    """Return the official model whose file has this SHA-256; None if there is none."""
    return next((model for model in KNOWN.values() if model.sha256 == sha256), None)
