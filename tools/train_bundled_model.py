"""Train the bundled detector on a GPU within a given time, from scenes drawn while it runs.

    python -m tools.train_bundled_model runs/default.safetensors --minutes 9

`companion learn train` does the same on a processor, in hours. Here processes draw the scenes of
`mavlink_sim.datasets.training_scenes` into a pool in shared memory and replace the oldest ones without end.
The trainer keeps a copy of the pool on the GPU and makes its batches there, as
`vision.training.scene_batches` does on the processor: a whole scene, reduced, or a part of it, mirrored and
recoloured. Images of both sizes of `SIZES` alternate. The learning rate falls with the time, to almost zero
at its end. The result is the average of the weights. The biases of the classes are then lowered until the
precision of each is `PRECISION` at the confidence that confirms a track, on images of 640 pixels, the size of
the camera; other sizes are not calibrated. It is not repeatable to the bit: how many scenes are drawn depends
on the machine.

Several `--rate` train as many networks at the same time, on the same scenes.
"""

from __future__ import annotations

import argparse
import copy
import logging
import math
import mmap
import multiprocessing
import multiprocessing.connection
import os
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from benchmarks.bundled_model import CONFIRMED, detect, draw
from mavlink_sim.datasets.training_scenes import training_scene
from mavlink_sim.world.shapes import CLASS_NAMES
from vision.detector import RENDERED_SCENES
from vision.evaluation.metrics import operating_points
from vision.training.losses import Truth, detection_loss
from vision.training.published import yolov8_description
from vision.training.recipe import HELD_OUT_SEED, HELD_OUT_SIZE, NMS_IOU, REFINEMENT, evaluate
from vision.training.scene_batches import PADDING_GREY
from vision.training.training import prepare_start, update_average
from vision.yolo.architecture import YoloModel, build
from vision.yolo.checkpoint import load_checkpoint, save_checkpoint

WIDTH, HEIGHT = 640, 480
"""Pixels of a drawn scene."""
SIZES = ((320, 256, 256), (320, 256, 256), (640, 480, 96))
"""Width, height and batch size of the images of one step after another."""
MOST_OBJECTS = 32
WARMUP_STEPS = 300
FIRST_SCENES = 512
"""Training starts when so many are drawn."""
AVERAGE_DECAY = 0.9995
BETAS = (0.9, 0.99)
TINT = 0.04
"""Largest relative change of each channel; stands for the hue of `Augmentation`."""
AIMED = 0.7
"""Of the parts of a scene, so many show one of its objects."""
COPIED_AT_ONCE = 64
LOGGED_STEPS = 100
HELD_OUT_SCENES = 100
CALIBRATION_SEED, CALIBRATION_FRAMES, CALIBRATION_WORLD = 20_000_000, 2000, 101
"""Of other frames than training and evaluation use."""
PRECISION = 0.955
"""A little more than the 0.95 that the evaluation asks."""
SCENE_SEED = 40_000_000
"""Of the drawn scenes: far from the seeds of evaluations and flights."""


@dataclass(frozen=True, slots=True)
class Pool:
    """Scenes in memory that the processes share. Renderer r draws into the places r, r + R, r + 2R …

    Attributes:
        images: (N, HEIGHT, WIDTH, 3) uint8 RGB.
        boxes: (N, MOST_OBJECTS, 4) float32, pixels xyxy.
        ids: (N, MOST_OBJECTS) int64, of `LabelledImage`; LACKING where there is no object.
        drawn: (R,) int64, how many each renderer has drawn.
        begun: (R,) int64, how many it has begun to write.
    """

    images: NDArray[np.uint8]
    boxes: NDArray[np.float32]
    ids: NDArray[np.int64]
    drawn: NDArray[np.int64]
    begun: NDArray[np.int64]

    @classmethod
    def of_size(cls, scenes: int, renderers: int) -> Pool:
        """An empty pool of about `scenes` places, a multiple of `renderers`."""
        count = max(1, scenes // renderers) * renderers
        return cls(
            _shared((count, HEIGHT, WIDTH, 3), np.uint8),
            _shared((count, MOST_OBJECTS, 4), np.float32),
            _shared((count, MOST_OBJECTS), np.int64),
            _shared((renderers,), np.int64),
            _shared((renderers,), np.int64),
        )


LACKING = -1000


def _shared(shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
    size = math.prod(shape) * np.dtype(dtype).itemsize
    return np.frombuffer(mmap.mmap(-1, size), dtype).reshape(shape)


def render(pool: Pool, renderer: int, seed: int) -> None:
    """Draw scenes without end, the oldest places again."""
    os.nice(5)
    cv2.setNumThreads(1)
    renderers, rounds = len(pool.drawn), len(pool.images) // len(pool.drawn)
    while True:
        number = int(pool.drawn[renderer])
        place = renderer + renderers * (number % rounds)
        rng = np.random.default_rng([seed, renderer, number])
        image, boxes, ids = training_scene(rng, WIDTH, HEIGHT)
        count = min(len(ids), MOST_OBJECTS)
        pool.begun[renderer] = number + 1
        pool.images[place] = image[:, :, ::-1]
        pool.boxes[place, :count] = boxes[:count]
        pool.ids[place] = LACKING
        pool.ids[place, :count] = ids[:count]
        pool.drawn[renderer] = number + 1


class PoolCopy:
    """The pool on the trainer's device, updated by a thread."""

    def __init__(self, pool: Pool, device: torch.device) -> None:
        self._pool, self._device = pool, device
        self.images = torch.zeros(pool.images.shape, dtype=torch.uint8, device=device)
        self.boxes = torch.zeros(pool.boxes.shape, device=device)
        self.ids = torch.full(pool.ids.shape, LACKING, dtype=torch.int64, device=device)
        self._copied = np.zeros_like(pool.drawn)
        self._filled = np.zeros(len(pool.images), np.bool_)
        self._lock = threading.Lock()
        self._failure: Exception | None = None

    @property
    def available(self) -> int:
        """The first so many places have a scene."""
        return len(self._filled) if self._filled.all() else int(self._filled.argmin())

    @property
    def scenes(self) -> int:
        """How many different scenes were copied."""
        return int(self._copied.sum())

    def take(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Images, boxes and ids of the same scenes, also while another thread updates."""
        with self._lock:
            return self.images[places], self.boxes[places], self.ids[places]

    def update(self) -> None:
        """Copy what was drawn since the last call, except what its renderer draws over meanwhile."""
        renderers, rounds = len(self._copied), len(self.images) // len(self._copied)
        for renderer, drawn in enumerate(self._pool.drawn.tolist()):
            first = max(int(self._copied[renderer]), drawn - rounds)
            for start in range(first, drawn, COPIED_AT_ONCE):
                numbers = np.arange(start, min(start + COPIED_AT_ONCE, drawn))
                places = renderer + renderers * (numbers % rounds)
                copies = [of[places] for of in (self._pool.images, self._pool.boxes, self._pool.ids)]
                torn = max(0, int(self._pool.begun[renderer]) - rounds - start)
                places = places[torn:]
                to = torch.from_numpy(places).to(self._device)
                images, boxes, ids = (torch.from_numpy(one[torn:]).to(self._device) for one in copies)
                with self._lock:
                    self.images[to], self.boxes[to], self.ids[to] = images, boxes, ids
                self._filled[places] = True
            self._copied[renderer] = drawn

    def follow(self, ended: threading.Event) -> None:
        """Update until `ended`, or until an error, which `check` raises."""
        try:
            while not ended.wait(0.5):
                self.update()
        except Exception as error:
            self._failure = error

    def check(self) -> None:
        """Raise RuntimeError if `follow` has failed."""
        if self._failure is not None:
            raise RuntimeError(f"the drawn scenes could not be copied: {self._failure}") from self._failure


def batch(pool: PoolCopy, width: int, height: int, count: int, rng: torch.Generator) -> tuple[Tensor, Truth]:
    """Augmented images (count, 3, height, width) float32 in 0..1 and their objects."""
    limits, device = REFINEMENT.augmentation, pool.images.device

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape or (count,), device=device, generator=rng)

    chosen = torch.randint(pool.available, (count,), device=device, generator=rng)
    scenes, boxes, ids = pool.take(chosen)
    window = torch.tensor([width, height], device=device, dtype=torch.float32)
    whole = torch.tensor([WIDTH, HEIGHT], device=device, dtype=torch.float32)
    least = float((window / whole).min())
    zoomed = uniform(0, 1) < limits.zoom_probability
    zoom = torch.exp(uniform(math.log(least * limits.zoom_min), math.log(limits.zoom_max)))
    zoom = torch.where(zoomed, zoom, torch.full_like(zoom, least))[:, None]
    margin = window - zoom * whole
    shift = uniform(0, 1, count, 2) * margin
    # Most of a large scene is empty: prefer a part with an object.
    target = torch.multinomial((ids != LACKING).float() + 1e-6, 1, generator=rng)[:, :, None].expand(-1, 1, 4)
    centre = boxes.gather(1, target)[:, 0].reshape(count, 2, 2).mean(1) * zoom
    aimed = uniform(0.1, 0.9, count, 2) * window - centre
    aimed = torch.minimum(torch.maximum(aimed, margin.clamp(max=0)), margin.clamp(min=0))
    aims = (uniform(0, 1) < AIMED) & (ids != LACKING).any(1)
    shift = torch.where(aims[:, None], aimed, shift)
    shift = torch.where(zoomed[:, None], shift, margin / 2)

    moved = boxes * zoom[:, None] + shift.repeat(1, 2)[:, None]
    mirrored = uniform(0, 1) < limits.mirror
    flipped = torch.stack([width - moved[..., 2], moved[..., 1], width - moved[..., 0], moved[..., 3]], -1)
    moved = torch.where(mirrored[:, None, None], flipped, moved)
    clipped = torch.minimum(moved.clamp(min=0), window.repeat(2))
    sides = (clipped[..., 2:] - clipped[..., :2]).clamp(min=0)
    area, visible = (moved[..., 2:] - moved[..., :2]).prod(-1), sides.prod(-1)
    hidden = visible < limits.visible_fraction * area.clamp(min=1e-9)
    small = (sides.amin(-1) < limits.min_side_px) | (visible < limits.min_area_px)
    exists = (ids != LACKING) & (visible > 0)
    learned = exists & (ids >= 0) & ~hidden & ~small
    classes = torch.where(ids < 0, -1 - ids, ids).clamp(0, len(CLASS_NAMES) - 1)

    # Pixel x of the image shows the scene's (x - shift) / zoom, mirrored: of the image's other side.
    sign = torch.where(mirrored, -1.0, 1.0)
    across, down = window[0] / (zoom[:, 0] * whole[0]), window[1] / (zoom[:, 0] * whole[1])
    matrix = torch.zeros(count, 2, 3, device=device)
    matrix[:, 0, 0], matrix[:, 1, 1] = sign * across, down
    matrix[:, 0, 2] = across - 2 * shift[:, 0] / (zoom[:, 0] * whole[0]) - 1
    matrix[:, 1, 2] = down - 2 * shift[:, 1] / (zoom[:, 0] * whole[1]) - 1
    grid = F.affine_grid(matrix, [count, 3, height, width], align_corners=False)
    centred = scenes.permute(0, 3, 1, 2).float() - PADDING_GREY
    images = (F.grid_sample(centred, grid, align_corners=False) + PADDING_GREY) / 255.0
    # Saturation and brightness of HSV; small gains of each channel stand for the hue.
    value = images.amax(1, keepdim=True)
    saturation = 1 + uniform(-limits.saturation, limits.saturation)[:, None, None, None]
    gain = 1 + uniform(-limits.brightness, limits.brightness)[:, None, None, None]
    tint = uniform(1 - TINT, 1 + TINT, count, 3)[:, :, None, None]
    images = ((value - (value - images) * saturation) * gain * tint).clamp(0, 1)
    return images, Truth(clipped, classes, learned, exists & ~learned)


def train(pool: Pool, highest_rate: float, output: Path, given: argparse.Namespace) -> None:
    """Train one network until the time is over; its average is written every minute and at the end.

    Raises:
        TimeoutError: the time was over before the first scenes were drawn.
        RuntimeError: scenes could not be copied.
        FloatingPointError: the loss is not finite.
    """
    device = torch.device(given.device)
    torch.set_num_threads(1)
    torch.manual_seed(given.seed)
    torch.set_float32_matmul_precision("high")
    rng = torch.Generator(device).manual_seed(given.seed)
    copied, ended = PoolCopy(pool, device), threading.Event()
    needed = min(FIRST_SCENES, len(copied.images))
    copied.update()
    while copied.available < needed:
        if time.monotonic() >= given.end:
            raise TimeoutError(
                f"the time was over when {copied.available} of the first {needed} places had a scene; "
                "training starts with all: give more --minutes or --renderers"
            )
        time.sleep(0.2)
        copied.update()
    threading.Thread(target=copied.follow, args=(ended,), daemon=True).start()

    scale = (REFINEMENT.depth_multiple, given.width, REFINEMENT.max_channels)
    model = build(yolov8_description(scale, CLASS_NAMES)).train()
    prepare_start(model)
    if given.start is not None:
        model.load_state_dict(load_checkpoint(given.start).model.state_dict())
    model = model.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(model).eval()
    decayed = [
        parameter for parameter in model.parameters() if parameter.requires_grad and parameter.ndim > 1
    ]
    others = [
        parameter for parameter in model.parameters() if parameter.requires_grad and parameter.ndim <= 1
    ]
    optimiser = torch.optim.AdamW(
        [
            {"params": decayed, "weight_decay": REFINEMENT.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ],
        highest_rate,
        betas=BETAS,
        fused=device.type == "cuda",
    )
    started, written, step, images_done = time.monotonic(), time.monotonic(), 0, 0
    end, sizes = given.end, _sizes(given.batch_share)
    while (now := time.monotonic()) < end or step == 0:
        copied.check()
        width, height, count = sizes[step % len(sizes)]
        share = min(1.0, (now - started) / max(end - started, 1e-9))
        rate = highest_rate * min(1.0, (step + 1) / WARMUP_STEPS) * (0.5 + 0.5 * math.cos(math.pi * share))
        for group in optimiser.param_groups:
            group["lr"] = rate
        images, truth = batch(copied, width, height, count, rng)
        with torch.autocast(device.type, torch.bfloat16):
            outputs = model(images.to(memory_format=torch.channels_last))
        loss = detection_loss([level.float() for level in outputs], model.strides, truth)
        optimiser.zero_grad(set_to_none=True)
        loss.total.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), REFINEMENT.gradient_limit)
        optimiser.step()
        step, images_done = step + 1, images_done + count
        update_average(average, model, min(AVERAGE_DECAY, step / (step + 10)))
        if step % LOGGED_STEPS == 0:
            logging.info(
                "%s %.0f s: step %d, %d images, %d scenes, losses %.3f %.3f %.3f, rate %.2g",
                output.name,
                now - started,
                step,
                images_done,
                copied.scenes,
                loss.box,
                loss.classes,
                loss.distribution,
                rate,
            )
            if not math.isfinite(float(loss.total)):
                raise FloatingPointError(f"the loss of step {step} is {float(loss.total)}: lower --rate")
        if now - written > 60:
            _write(output, average, given, highest_rate, step, images_done, copied.scenes)
            written = now
    ended.set()
    copied.check()
    _write(output, average, given, highest_rate, step, images_done, copied.scenes)


def _sizes(batch_share: float) -> list[tuple[int, int, int]]:
    return [(width, height, max(1, int(count * batch_share))) for width, height, count in SIZES]


def _write(
    output: Path,
    average: YoloModel,
    given: argparse.Namespace,
    rate: float,
    steps: int,
    images: int,
    scenes: int,
) -> None:
    metadata = {
        "licence": "Apache-2.0",
        "nms_iou": NMS_IOU,
        "trained_on": f"{RENDERED_SCENES}mavlink_sim.datasets.training_scenes",
        "trained_by": "tools.train_bundled_model",
        "seed": given.seed,
        "minutes": given.minutes,
        "learning_rate": rate,
        "steps_done": steps,
        "images": images,
        "scenes": scenes,
        "renderers": given.renderers,
        "pool_scenes": given.scenes,
        "steps_of_width_height_batch": [list(size) for size in _sizes(given.batch_share)],
        "warmup_steps": WARMUP_STEPS,
        "average_decay": AVERAGE_DECAY,
        "optimiser": "AdamW",
        "betas": list(BETAS),
        "weight_decay": REFINEMENT.weight_decay,
        "gradient_limit": REFINEMENT.gradient_limit,
        "augmentation": {
            **{name: value for name, value in asdict(REFINEMENT.augmentation).items() if name != "hue"},
            "tint": TINT,
            "aimed": AIMED,
        },
    }
    output.parent.mkdir(parents=True, exist_ok=True)
    save_checkpoint(output, copy.deepcopy(average).cpu(), metadata=metadata)


@torch.no_grad()
def lower_confidence(output: Path) -> tuple[YoloModel, dict[str, float]]:
    """The written network with lower class biases, and class name → by how much.

    The precision at CONFIRMED becomes PRECISION, on frames like those of `benchmarks.bundled_model`, of other
    seeds, at 640 pixels. A class that is more precise stays as it is. One that is never so precise gets the
    last threshold, and a warning names it.
    """
    with tempfile.TemporaryDirectory() as folder:
        drawn = draw(Path(folder), CALIBRATION_FRAMES, CALIBRATION_SEED, CALIBRATION_WORLD)
        found = detect(drawn, str(output), max(HELD_OUT_SIZE))
    results = [result for of_scene in found.results.values() for result in of_scene]
    thresholds = [round(CONFIRMED + 0.01 * step, 2) for step in range(60)]
    points = [operating_points(results, found.names, threshold) for threshold in thresholds]
    model, lowered = load_checkpoint(output).model, {}
    for name in found.names:
        precise = [t for t, at in zip(thresholds, points, strict=True) if at[name].precision >= PRECISION]
        threshold = precise[0] if precise else thresholds[-1]
        if not precise:
            logging.warning(
                "%s: the precision of %s is below %g up to confidence %g; its bias is lowered as for that",
                output.name,
                name,
                PRECISION,
                threshold,
            )
        lowered[name] = round(_logit(threshold) - _logit(CONFIRMED), 3)
        for branch in model.detect.cv3:
            branch[-1].bias[model.class_names.index(name)] -= lowered[name]  # type: ignore[index]
    return model, lowered


def _logit(probability: float) -> float:
    return math.log(probability / (1 - probability))


def _finish(output: Path) -> None:
    """Calibrate the written network, evaluate it, and write it again."""
    model, lowered = lower_confidence(output)
    width, height = HELD_OUT_SIZE
    score = evaluate(model, training_scene, HELD_OUT_SEED, HELD_OUT_SCENES, width, height)
    per_class = {name: asdict(of_class) for name, of_class in score.per_class.items()}
    metadata = load_checkpoint(output).metadata | {
        "class_biases_lowered_by": lowered,
        "calibration": {
            "precision": PRECISION,
            "confidence": CONFIRMED,
            "seed": CALIBRATION_SEED,
            "first_world": CALIBRATION_WORLD,
            "frames": CALIBRATION_FRAMES,
            "image_size": max(HELD_OUT_SIZE),
        },
        "score": {
            "map50": round(score.map50, 4),
            "map50_95": round(score.map50_95, 4),
            "per_class": per_class,
            "held_out_scenes": HELD_OUT_SCENES,
            "held_out_seed": HELD_OUT_SEED,
            "held_out_size": [width, height],
        },
    }
    save_checkpoint(output, model, metadata=metadata)


def join(trainers: Sequence[BaseProcess], renderers: Sequence[BaseProcess]) -> None:
    """Wait until all trainers have ended; none of the processes is left.

    Raises:
        SystemExit: a renderer ended before them, or a trainer failed.
    """
    try:
        while running := [trainer for trainer in trainers if trainer.is_alive()]:
            multiprocessing.connection.wait([process.sentinel for process in (*running, *renderers)])
            for number, renderer in enumerate(renderers):
                if not renderer.is_alive():
                    raise SystemExit(
                        f"renderer {number} ended with exit code {renderer.exitcode}; training was stopped: "
                        "see its error above; without one, it may have been killed for memory (--scenes)"
                    )
    finally:
        for process in (*trainers, *renderers):
            process.terminate()
            process.join()
    if any(trainer.exitcode for trainer in trainers):
        raise SystemExit(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, start the renderers and a trainer for each rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("output", type=Path, help="NAME.safetensors; of several rates NAME-RATE.safetensors")
    parser.add_argument(
        "--rate", type=float, action="append", help="highest learning rate, default 0.003; repeatable"
    )
    parser.add_argument("--width", type=float, default=REFINEMENT.width_multiple, help="multiple of YOLOv8")
    parser.add_argument(
        "--minutes",
        type=float,
        default=9.0,
        help="of drawing the first scenes and training; calibration and evaluation follow",
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--renderers", type=int, default=max(1, (os.cpu_count() or 2) - 2))
    parser.add_argument(
        "--scenes",
        type=int,
        default=24_000,
        help="places of the pool, 0.92 MB of shared memory each, and as much on the GPU for each --rate",
    )
    parser.add_argument("--batch-share", type=float, default=1.0, help="smaller batches, for a small GPU")
    parser.add_argument("--start", type=Path, help="weights of the same width to start from")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    given.end = time.monotonic() + 60 * given.minutes
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    rates = given.rate or [3e-3]
    # Forked, so that they share the pool's memory; before CUDA and torch's threads start.
    processes = multiprocessing.get_context("fork")
    pool = Pool.of_size(given.scenes, given.renderers)
    renderers, trainers, outputs = [], [], []
    for number in range(given.renderers):
        seed = SCENE_SEED + given.seed
        renderers.append(processes.Process(target=render, args=(pool, number, seed), daemon=True))
        renderers[-1].start()
    for rate in rates:
        output = given.output
        if len(rates) > 1:
            output = output.with_name(f"{output.stem}-{rate:g}{output.suffix}")
        outputs.append(output)
        trainers.append(processes.Process(target=train, args=(pool, rate, output, given)))
        trainers[-1].start()
    join(trainers, renderers)
    for output in outputs:
        _finish(output)


if __name__ == "__main__":
    main()
