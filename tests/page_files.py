"""The reader's files, which commands of the pages name: small ones of the same kinds."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).parent.parent
SIZE = (96, 96)


def put_photographs(folder: Path) -> None:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(1)
    for index in range(16):  # as many as a calibration for int8 needs
        image = cv2.resize(rng.integers(0, 256, (6, 8, 3), np.uint8), (160, 120))
        cv2.imwrite(str(folder / f"{index:02}.jpg"), image)


def put_video(path: Path) -> None:
    """Two seconds of the size that README's pipe states."""
    image = cv2.resize(np.asarray(cv2.imread(str(ROOT / "docs/images/demo.png"))), (640, 272))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 20.0, (640, 272))
    for _ in range(40):
        writer.write(image)
    writer.release()


def put_decoder(path: Path) -> None:
    """Stand in for README's ffmpeg where there is none; it does not wait between frames, as `-re` does."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(
        f"#!{sys.executable}\nimport cv2, sys\nvideo = cv2.VideoCapture(sys.argv[sys.argv.index('-i') + 1])\n"
        "while (read := video.read())[0]:\n    sys.stdout.buffer.write(read[1].tobytes())\n"
    )
    path.chmod(0o755)


def put_labelled_set(folder: Path) -> None:
    """As YOLO has it."""
    put_photographs(folder / "images")
    (folder / "labels").mkdir()
    for image in (folder / "images").iterdir():
        (folder / "labels" / f"{image.stem}.txt").write_text("0 0.5 0.5 0.4 0.4\n")


def put_coco(path: Path) -> None:
    """COCO's JSON, and its images in the folder `val2017`."""
    put_photographs(path.parent.parent / "val2017")
    images = [{"id": i, "file_name": f"{i:02}.jpg", "width": 160, "height": 120} for i in range(16)]
    box = {"bbox": [48, 36, 64, 48], "area": 3072, "iscrowd": 0, "category_id": 1}
    labels = [{"id": i, "image_id": i, **box} for i in range(16)]
    path.parent.mkdir()
    path.write_text(
        json.dumps({"images": images, "annotations": labels, "categories": [{"id": 1, "name": "car"}]})
    )


def put_pulled_model(path: Path) -> None:
    """What `companion models pull` leaves; the network is smaller."""
    from tests.vision.foreign_checkpoints import SMALL, trained_model
    from vision.training.published import yolov8_description
    from vision.yolo.checkpoint import save_checkpoint

    path.parent.mkdir(parents=True, exist_ok=True)
    save_checkpoint(path, trained_model(yolov8_description(SMALL, ("person", "car"))), metadata={})


def put_ultralytics_exports(path: Path) -> None:
    """`best.onnx`, and beside it the other kinds."""
    from tests.vision.foreign_checkpoints import NAMES, trained_model
    from tests.vision.foreign_files import ultralytics_onnx, ultralytics_openvino, ultralytics_torchscript

    ultralytics_onnx(path, trained_model(), SIZE)
    ultralytics_openvino(path.with_name("best_openvino_model"), path, NAMES, SIZE)
    ultralytics_torchscript(path.with_suffix(".torchscript"), trained_model(), SIZE)


def put_yolox_checkpoint(path: Path) -> None:
    import torch

    from tests.vision.test_yolox import save_yolox

    save_yolox(path)
    content = torch.load(path, weights_only=True)
    for name, weights in content["model"].items():
        if "obj_preds" in name and name.endswith("bias"):
            weights.fill_(-20.0)  # no object anywhere
    torch.save(content, path)


def put_yolox_export(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    from tests.vision.foreign_files import constant_onnx

    cells = sum((96 // stride) ** 2 for stride in (8, 16, 32))
    constant_onnx(path, {"output": np.zeros((1, cells, 85), np.float32)}, size=SIZE)


def put_policy(path: Path) -> None:
    shutil.copyfile(ROOT / "companion" / "guidance" / "policies" / "approach.onnx", path)


def put_examples(folder: Path) -> None:
    shutil.copytree(ROOT / "examples", folder, ignore=shutil.ignore_patterns("build", "*.egg-info"))


# What a command line has; where the file is, from the folder or the home of the reader; what writes it.
MODELS = "~/.local/share/mavlink-companion/models"
GIVEN = {
    "./examples": ("examples", put_examples),
    "annotations/instances_val2017.json": ("annotations/instances_val2017.json", put_coco),
    "ffmpeg -": ("bin/ffmpeg", put_decoder),
    "best.onnx": ("best.onnx", put_ultralytics_exports),
    "coco/": ("coco", put_labelled_set),
    "models pull yolox_s": (f"{MODELS}/yolox_s.onnx", put_yolox_export),
    "my_approach.onnx": ("my_approach.onnx", put_policy),
    "photos/": ("photos", put_photographs),
    "street.mp4": ("street.mp4", put_video),
    "video.mp4": ("video.mp4", put_video),
    "yolo11n": (f"{MODELS}/yolo11n.pt", put_pulled_model),
    "yolov8n": (f"{MODELS}/yolov8n.pt", put_pulled_model),
    "yolox_nano.onnx": ("yolox_nano.onnx", put_yolox_export),
    "yolox_s.pth": ("yolox_s.pth", put_yolox_checkpoint),
}


# As installed, but vehicles climb quickly, cameras have fewer images, and a service detects at half the size
# and serves no page, which dashboard.md does.
COMPANION = f"""#!{sys.executable}
import os, sys
from companion import cli
if __name__ == "__main__":
    command = sys.argv[1:2]
    if command in (["play"], ["run"]):
        os.environ.update(COMPANION_DETECTOR_IMAGE_SIZE="320", COMPANION_DASHBOARD_LISTEN="")
    if command == ["play"]:
        from companion.simulation import play, session
        from mavlink_sim.testing import QUICK_FLIGHT
        session.SIMULATOR_PARAMETERS.update(QUICK_FLIGHT)
        play._CAMERA_RATE_HZ = 5.0
    cli.main()
"""
SIMULATOR = f"""#!{sys.executable}
import sys
from mavlink_sim.__main__ import main
from mavlink_sim.testing import QUICK_FLIGHT
if __name__ == "__main__":
    words = sys.argv[1:]
    if not words or words[0].startswith("--"):
        if "ardupilot" not in words:
            sys.argv += [f"--param={{name}}={{value}}" for name, value in QUICK_FLIGHT.items()]
        if {{"--camera", "--camera-output"}} & {{*words}} and "--camera-rate" not in words:
            sys.argv += ["--camera-rate", "5"]
    main()
"""


def put_quick_programs(folder: Path) -> None:
    """`companion` and `mavlink-sim`, with the same command line."""
    folder.mkdir()
    for name, text in (("companion", COMPANION), ("mavlink-sim", SIMULATOR)):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)


def put_files(lines: Sequence[str], folder: Path, home: Path) -> None:
    """Write the files that the lines name."""
    for part, (name, put) in GIVEN.items():
        if any(part in line for line in lines):
            put(home / name.removeprefix("~/") if name.startswith("~/") else folder / name)
