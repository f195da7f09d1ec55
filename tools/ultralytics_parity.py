"""Parity with Ultralytics, for development only: it is never a dependency, and nothing imports this.

For each model table that an installed `ultralytics` knows, a network with random weights and lively
normalisation statistics is saved as its trainer saves one (a pickled model, float16). Both sides read the
file. Compared on one image of noise:

* maps: everything the head gives before boxes are selected, float32, largest difference;
* folded: the same with our normalisation folded into the convolutions, and what folding costs on their side;
* boxes: after NMS, or after the selection of an end-to-end head, at a confidence that leaves about 200 cells.

    PYTHONPATH=. OTHER_VENV/bin/python tools/ultralytics_parity.py yolov8n yolo11m yolo26n
    PYTHONPATH=. OTHER_VENV/bin/python tools/ultralytics_parity.py --counts yolov5 yolov8 yolo11

Exit code 1 if a map differs by more than 1e-4 or a box by more than 0.01 pixels.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

LARGEST_MAP_DIFFERENCE = 1e-4
LARGEST_BOX_DIFFERENCE = 1e-2


def oracle_model(name: str, classes: int | None = None) -> nn.Module:
    """A fresh network of the installed Ultralytics."""
    from ultralytics.nn.tasks import DetectionModel

    try:
        model: nn.Module = DetectionModel(f"{name}.yaml", nc=classes, verbose=False)
    except FileNotFoundError:
        # Until 8.0.50 the tables of the small and large scales lay in folders of their own.
        import ultralytics

        (table,) = Path(ultralytics.__file__).parent.rglob(f"{name}.yaml")
        model = DetectionModel(str(table), nc=classes, verbose=False)
    return model


def noise_images(count: int, height: int, width: int, generator: torch.Generator) -> Tensor:
    """Noise of every size, from a pixel to a quarter of the image, for deep layers to see."""
    image = torch.zeros(count, 3, height, width)
    for cell in (1, 4, 16, 64):
        coarse = torch.rand(count, 3, height // cell + 1, width // cell + 1, generator=generator)
        image += nn.functional.interpolate(coarse, (height, width), mode="bilinear") / 4
    return image


def enliven(model: nn.Module, image: Tensor, seed: int) -> None:
    """Statistics, scales and biases as training might leave them: no value is one that hides a mistake.

    On `image` the head then gives sides of a few cells, few confident cells, and no score of 1: of several
    classes at 1.0 either side may report another.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(tensor: Tensor, low: float, high: float) -> None:
        tensor.copy_(torch.rand(tensor.shape, generator=generator) * (high - low) + low)

    norms = [module for module in model.modules() if isinstance(module, nn.BatchNorm2d)]
    with torch.no_grad():
        for module in model.modules():
            if isinstance(getattr(module, "gamma", None), nn.Parameter):
                uniform(module.gamma, 0.2, 0.8)
        for norm in norms:
            norm.momentum = None  # A cumulative average: the statistics of exactly these images.
            norm.reset_running_stats()
            uniform(norm.weight, 0.7, 1.3)
            uniform(norm.bias, -0.2, 0.2)
        model.train()
        for _ in range(2):
            model(noise_images(2, 256, 320, generator))
        for norm in norms:
            norm.momentum = 0.03
            uniform(spread := torch.empty_like(norm.running_var), 0.8, 1.25)
            norm.running_var.mul_(spread)
    model.eval()
    head = model.model[-1]
    inputs: list[Tensor] = []
    hook = head.register_forward_pre_hook(lambda module, given: inputs.extend(x.clone() for x in given[0]))
    with torch.no_grad():
        model(image)
        hook.remove()
        for branches in ("cv2", "cv3", "one2one_cv2", "one2one_cv3"):
            middle = 1.5 if "cv2" in branches else -4.0
            for branch, x in zip(getattr(head, branches, ()), inputs, strict=False):
                spread, mean = torch.std_mean(branch(x), dim=(0, 2, 3))
                branch[-1].weight.div_(spread[:, None, None, None].clamp(min=1e-2))
                branch[-1].bias.sub_(mean).div_(spread.clamp(min=1e-2)).add_(middle)


def save(path: Path, model: nn.Module) -> None:
    """As the trainer of the installed release leaves its latest model: settings and loss are part of it."""
    import ultralytics

    try:
        from ultralytics.cfg import get_cfg
    except ImportError:
        try:
            from ultralytics.yolo.cfg import get_cfg
        except ImportError:  # 8.0.0 to 8.0.6
            from ultralytics.yolo.configs import get_config
            from ultralytics.yolo.utils import DEFAULT_CONFIG

            def get_cfg() -> Any:
                return get_config(DEFAULT_CONFIG)

    model.args = get_cfg()
    if hasattr(model, "init_criterion"):
        model.criterion = model.init_criterion()
    content = {
        "epoch": -1,
        "best_fitness": None,
        "model": deepcopy(model).half(),
        "ema": None,
        "updates": None,
        "optimizer": None,
        "train_args": {"task": "detect", "imgsz": 640},
        "date": "2026-01-01T00:00:00",
        "version": ultralytics.__version__,
        "license": "AGPL-3.0 License (https://ultralytics.com/license)",
    }
    torch.save(content, path)


def oracle_maps(output: Any, end_to_end: bool) -> Tensor:
    """(B, 4 · reg_max + classes, N) from whatever shape the release gives it."""
    if isinstance(output, tuple):
        output = output[1]
    if isinstance(output, dict) and "one2one" in output:
        output = output["one2one" if end_to_end else "one2many"]
    if isinstance(output, dict):
        return torch.cat((output["boxes"], output["scores"]), dim=1)
    return torch.cat([level.flatten(2) for level in output], dim=2)


def oracle_boxes(decoded: Tensor, confidence: float, iou: float, end_to_end: bool) -> Tensor:
    """(N, 6): xyxy, confidence, class."""
    if end_to_end:
        found: Tensor = decoded[0]
        return found[found[:, 4] > confidence]
    try:
        from ultralytics.utils.nms import non_max_suppression
    except ImportError:
        try:
            from ultralytics.utils.ops import non_max_suppression
        except ImportError:
            from ultralytics.yolo.utils.ops import non_max_suppression
    kept: Tensor = non_max_suppression(decoded, confidence, iou, max_det=300)[0]
    return kept


def compare(
    name: str, folder: Path, classes: int | None = None, folded: bool = False, seed: int = 0
) -> tuple[float, float, float, float, int]:
    """Largest differences from their maps: ours, ours folded, theirs folded; of the boxes; count of boxes."""
    from vision.yolo.checkpoint import load_checkpoint
    from vision.yolo.postprocess import select_boxes

    torch.manual_seed(seed)
    fresh = oracle_model(name, classes)
    image = noise_images(1, 256, 320, torch.Generator().manual_seed(seed + 1))
    enliven(fresh, image, seed)
    path = folder / f"{name}.pt"
    save(path, fresh.fuse() if folded else fresh)
    theirs = torch.load(path, weights_only=False)["model"].float().eval()
    ours = load_checkpoint(path).model
    if ours.end_to_end and not theirs.model[-1].end2end:
        # Late releases (8.4.190) answer with the other head, and NMS, unless asked for this one.
        theirs.model[-1].end2end = True
    with torch.inference_mode():
        output = theirs(image)
        expected = oracle_maps(output, ours.end_to_end)
        maps = ours(image)
        got = torch.cat([level.flatten(2) for level in maps], dim=2)
        if got.shape != expected.shape:
            raise SystemExit(f"{name}: maps of {tuple(got.shape)}, expected {tuple(expected.shape)}")
        scores = expected[0, 4 * ours.reg_max :].max(dim=0).values.sigmoid().sort(descending=True).values
        # Between two scores, where the last bit of neither decides.
        confidence = float((scores[200] + scores[201]) / 2)
        boxes = select_boxes(ours, maps, confidence=confidence, iou=0.7)
        reference = oracle_boxes(output[0], confidence, 0.7, ours.end_to_end)
        ours_folded = torch.cat([level.flatten(2) for level in ours.fuse()(image)], dim=2)
        theirs_folded = oracle_maps(theirs.fuse()(image), ours.end_to_end)
    mine = torch.cat(
        (
            torch.from_numpy(boxes.xyxy),
            torch.from_numpy(boxes.confidence)[:, None],
            torch.from_numpy(boxes.class_id)[:, None].float(),
        ),
        dim=1,
    )
    if mine.shape != reference.shape:
        raise SystemExit(f"{name}: {len(mine)} boxes, expected {len(reference)}")
    return (
        float((got - expected).abs().max()),
        float((ours_folded - expected).abs().max()),
        float((theirs_folded - expected).abs().max()),
        float((_ordered(mine) - _ordered(reference)).abs().max()),
        len(mine),
    )


def _ordered(boxes: Tensor) -> Tensor:
    """In an order that does not hang on the last bit of a confidence: by class, then by place."""
    keys = [tuple(round(value, 1) for value in (row[5], *row[:4])) for row in boxes.tolist()]
    return boxes[sorted(range(len(keys)), key=keys.__getitem__)]


def counts(families: Sequence[str]) -> Iterator[tuple[str, int, int]]:
    """(name, their parameters, ours) of every scale of each family."""
    from vision.yolo.architecture import ModelDescription, build

    for family in families:
        for scale in "nsmblx" if family == "yolov10" else "nsmlx":
            theirs = oracle_model(family + scale)
            names = [str(index) for index in range(theirs.yaml["nc"])]
            with torch.device("meta"):
                ours = build(ModelDescription.from_plain(theirs.yaml, names))
            yield (
                family + scale,
                sum(parameter.numel() for parameter in theirs.parameters()),
                sum(parameter.numel() for parameter in ours.parameters()),
            )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "names", nargs="+", help="model tables, as yolo11n; families with --counts, as yolo11"
    )
    parser.add_argument("--counts", action="store_true", help="compare numbers of parameters only")
    parser.add_argument("--classes", type=int, help="number of classes, else the table's")
    parser.add_argument("--fold", action="store_true", help="save the checkpoint with normalisation folded")
    parser.add_argument("--keep", type=Path, help="folder to leave the checkpoints in")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.use_deterministic_algorithms(True)
    import ultralytics

    print(f"ultralytics {ultralytics.__version__}, torch {torch.__version__}")
    wrong = False
    if arguments.counts:
        for name, theirs, ours in counts(arguments.names):
            wrong |= theirs != ours
            print(f"{name:10} {theirs:>11,} {ours:>11,} {'' if theirs == ours else 'DIFFERENT'}")
        return int(wrong)
    print(f"{'':10} {'maps':>9} {'folded':>9} {'theirs':>9} {'boxes':>9}  count")
    with tempfile.TemporaryDirectory() as temporary:
        for name in arguments.names:
            maps, folded, theirs, boxes, count = compare(
                name, arguments.keep or Path(temporary), arguments.classes, arguments.fold
            )
            bad = maps > LARGEST_MAP_DIFFERENCE or boxes > LARGEST_BOX_DIFFERENCE
            wrong |= bad
            figures = " ".join(f"{figure:9.1e}" for figure in (maps, folded, theirs, boxes))
            print(f"{name:10} {figures}  {count} {'DIFFERENT' if bad else ''}")
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
