"""Training of a YOLOv8 network on rendered scenes: loop, settings, and checkpoints to resume from."""

from __future__ import annotations

import copy
import itertools
import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from vision.training.losses import DetectionLoss, detection_loss
from vision.training.published import model_family_of, yolov8_description
from vision.training.scene_batches import Augmentation, SceneKey, SceneSource, network_input, scene_batches
from vision.yolo.architecture import YoloModel, build
from vision.yolo.description import ModelDescription

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of the training at one image size. Width and height in pixels, multiples of 32.

    `scenes` is the number of different scenes; they repeat, shuffled and with new augmentation each time.
    None: every image is a new scene.

    Over the last `decay_steps` the learning rate falls; before, it is constant, so that this part can be
    extended without changing what went before. `rate` is the value it falls from, as a share of the settings'
    `learning_rate`.

    `drawn` is the (width, height) at which scenes are drawn; an image then shows a whole one, reduced, or a
    part of it. None: the image's size.
    """

    width: int
    height: int
    batch_size: int
    steps: int
    scenes: int | None = None
    decay_steps: int = 0
    rate: float = 1.0
    drawn: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.width % 32 or self.height % 32 or self.width <= 0 or self.height <= 0:
            raise ValueError(
                f"training images must be multiples of 32 pixels, got {self.width}x{self.height}"
            )
        if self.batch_size < 1 or self.steps < 1 or (self.scenes is not None and self.scenes < 1):
            raise ValueError(f"a stage needs a batch size, steps and scenes of 1 or more, got {self}")
        if not 0 <= self.decay_steps <= self.steps:
            raise ValueError(f"decay_steps of a stage must be from 0 to its steps, got {self}")
        if not 0 < self.rate <= 1:
            raise ValueError(f"rate of a stage must be above 0 and at most 1, got {self}")

    def with_steps(self, ratio: float) -> Stage:
        """The same stage with `ratio` times as many steps, at least one."""
        steps = max(1, round(self.steps * ratio))
        return replace(self, steps=steps, decay_steps=min(steps, math.ceil(self.decay_steps * ratio)))


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """Everything that determines the weights. Same settings, scenes and machine: same weights.

    Attributes:
        class_names: id → name, as numbered by the scene source.
        stages: run in sequence, each with its own learning rate schedule.
        depth_multiple, width_multiple, max_channels: the network's scale (`yolov8_description`).
        optimiser: AdamW, or SGD with Nesterov momentum.
        learning_rate: the highest, reached after the warm-up.
        weight_decay: of convolution weights; biases and normalisations have none.
        momentum: of SGD.
        warmup_steps: the rate rises linearly over these.
        decay: shape of the rate's fall within a stage.
        final_rate: its end value, as a share of `learning_rate`.
        fixed_normalisation: keep the running statistics of the start; its few images have others.
        normalisation_momentum: share of a batch in the running statistics; YOLOv8's own 0.03 lags behind the
            weights in a short training.
        gradient_limit: largest norm of the gradient (clipping).
        average_decay: of the running average of the weights, which is the result.
        new_classes: the last so many classes are new to the network that the training starts from.
        new_class_rate: their weights in the last convolutions learn so many times faster than the rest, which
            are trained already.
        seed: of the initial weights and of every scene.
        augmentation: of the drawn scenes.
        threads: of torch. The order of summation, and so the last digits of the weights, depends on it.
        bfloat16: compute the network's forward pass in bfloat16; a third faster if the processor supports it.
        workers: processes that draw scenes; they do not change the result.
        time_limit_s: stop after this time even if steps remain; None for no limit.
        checkpoint_every_s: checkpoint interval, if there is one.
    """

    class_names: tuple[str, ...]
    stages: tuple[Stage, ...]
    depth_multiple: float = 1 / 3
    width_multiple: float = 0.125
    max_channels: int = 1024
    optimiser: Literal["adamw", "sgd"] = "adamw"
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    momentum: float = 0.937
    warmup_steps: int = 100
    decay: Literal["linear", "cosine"] = "linear"
    final_rate: float = 0.01
    fixed_normalisation: bool = False
    normalisation_momentum: float = 0.1
    gradient_limit: float = 10.0
    average_decay: float = 0.998
    new_classes: int = 0
    new_class_rate: float = 30.0
    seed: int = 0
    augmentation: Augmentation = field(default_factory=Augmentation)
    threads: int = 1
    bfloat16: bool = False
    workers: int = 1
    time_limit_s: float | None = None
    checkpoint_every_s: float = 120.0

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueError("training needs at least one stage")
        if self.learning_rate <= 0 or not 0 < self.final_rate <= 1:
            raise ValueError(
                "training needs a learning rate above 0 and a final rate in 0..1 of it, "
                f"got {self.learning_rate} and {self.final_rate}"
            )
        if not 0 <= self.average_decay < 1:
            raise ValueError(f"average_decay must be in 0..1, got {self.average_decay}")

    @property
    def steps(self) -> int:
        """Number of steps of all stages together."""
        return sum(stage.steps for stage in self.stages)

    def with_steps(self, steps: int) -> TrainingSettings:
        """The same schedule scaled to about `steps` steps, at least one per stage."""
        ratio = steps / self.steps
        return replace(
            self,
            stages=tuple(stage.with_steps(ratio) for stage in self.stages),
            warmup_steps=max(1, round(self.warmup_steps * min(ratio, 1.0))),
        )

    def rate_at(self, step: int) -> float:
        """The learning rate of a step, counted from 0."""
        if step < self.warmup_steps:
            return self.learning_rate * (step + 1) / self.warmup_steps
        stage = self.stages[-1]
        for stage in self.stages:
            if step < stage.steps:
                break
            step -= stage.steps
        else:
            step += stage.steps
        decayed = min(max((step - (stage.steps - stage.decay_steps)) / max(stage.decay_steps, 1), 0.0), 1.0)
        if self.decay == "cosine":
            decayed = (1 - math.cos(math.pi * decayed)) / 2
        return self.learning_rate * (stage.rate + decayed * (self.final_rate - stage.rate))


@dataclass(frozen=True, slots=True)
class Progress:
    """State of the training after a step (`step` of `steps` are done). Losses are of that step's batch."""

    step: int
    steps: int
    box_loss: float
    class_loss: float
    distribution_loss: float
    learning_rate: float
    images_per_s: float
    elapsed_s: float
    remaining_s: float


@dataclass(frozen=True, slots=True, eq=False)
class TrainedModel:
    """The averaged weights, in evaluation mode, and how they were trained."""

    model: YoloModel
    settings: TrainingSettings
    steps_done: int
    elapsed_s: float


def train(
    settings: TrainingSettings,
    scenes: SceneSource,
    on_progress: Callable[[Progress], None],
    *,
    checkpoint: Path | None = None,
    resume: bool = False,
    start: YoloModel | None = None,
    network: ModelDescription | None = None,
    origin: Mapping[str, str] | None = None,
) -> TrainedModel:
    """Train from the initial weights, or resume from a checkpoint, to the last step or the time limit.

    Args:
        settings: network, schedule and data.
        scenes: draws the images; see `SceneSource`.
        on_progress: called after every step, in this thread.
        checkpoint: file for the state, written periodically and at the end; None for none.
        resume: resume from `checkpoint`. The result is that of an uninterrupted run.
        start: a trained network of the same scale and classes to start from; None: random weights.
        network: the network to train, with the settings' classes; None: YOLOv8 of the settings' scale.
        origin: what identifies `scenes` and `start`. It is stored in the checkpoint with the seed and the
            sizes of the images; `resume` requires the same.

    Raises:
        FileNotFoundError: `resume` without such a file.
        ValueError: the checkpoint is of another network, seed, size or `origin`; `start` is of another
            network; or `scenes` returns an invalid scene.
        FloatingPointError: the loss is not finite, or exactly 0.
    """
    started = time.monotonic()
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    scale = (settings.depth_multiple, settings.width_multiple, settings.max_channels)
    model = build(network or yolov8_description(scale, settings.class_names)).train()
    if start is None:
        prepare_start(model)
    else:
        _copy_weights(start, model)
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = settings.normalisation_momentum
            module.train(not settings.fixed_normalisation)
    model = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(model).eval()
    optimiser = _optimiser(model, settings)
    new_weights = _weights_of_last_classes(model, settings.new_classes)
    first, identity = 0, _identity(settings, origin or {})
    if resume:
        if checkpoint is None:
            raise ValueError("resume needs a checkpoint")
        first = _restore(checkpoint, settings, identity, model, average, optimiser)
        logger.info("training resumes from %s at step %d of %d", checkpoint, first, settings.steps)

    plan = _plan(settings)[first:]
    batches = scene_batches(
        scenes,
        plan,
        class_count=len(settings.class_names),
        augmentation=settings.augmentation,
        workers=settings.workers,
    )
    step, saved_s, images_done = first, started, 0
    loop_started = time.monotonic()
    for images, truth in batches:
        rate = settings.rate_at(step)
        for group in optimiser.param_groups:
            group["lr"] = rate
        with torch.autocast("cpu", torch.bfloat16, enabled=settings.bfloat16):
            outputs = model(network_input(images))
        loss = detection_loss([level.float() for level in outputs], model.strides, truth)
        # At exactly 0 every class probability has underflowed: there is no gradient.
        if not torch.isfinite(loss.total) or loss.total == 0:
            raise FloatingPointError(
                f"the loss of step {step} is {float(loss.total.detach())}; lower the learning rate"
            )
        optimiser.zero_grad(set_to_none=True)
        loss.total.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), settings.gradient_limit)
        _step(optimiser, new_weights, settings.new_class_rate)
        step += 1
        # Small at first, so that the initial weights fade quickly.
        update_average(average, model, min(settings.average_decay, step / (step + 10)))

        now = time.monotonic()
        images_done += len(images)
        on_progress(
            _progress(
                settings, step, loss, rate, images_done, now - started, now - loop_started, step - first
            )
        )
        if checkpoint is not None and now - saved_s >= settings.checkpoint_every_s:
            _save(checkpoint, settings, identity, step, model, average, optimiser)
            saved_s = now
        if settings.time_limit_s is not None and now - started >= settings.time_limit_s:
            logger.warning("training stops at its time limit after %d of %d steps", step, settings.steps)
            break
    if checkpoint is not None:
        _save(checkpoint, settings, identity, step, model, average, optimiser)
    return TrainedModel(average.eval(), settings, step, time.monotonic() - started)


@torch.no_grad()
def update_average(average: nn.Module, model: nn.Module, decay: float) -> None:
    """Move the averaged weights and normalisation statistics towards the model's: a ← d·a + (1 - d)·m."""
    for kept, new in zip(_floats(average), _floats(model), strict=True):
        kept.lerp_(new, 1 - decay)


def _floats(module: nn.Module) -> list[Tensor]:
    return [tensor for tensor in module.state_dict().values() if tensor.is_floating_point()]


def prepare_start(model: YoloModel) -> None:
    """Let every side's distribution fall off by bin, so that the initial boxes are about four cells wide.

    A flat distribution gives boxes of 15 cells; their IoU with a small object is near zero, and with
    β = 6 the alignment vanishes: a short training would spend its time shrinking boxes.
    """
    slope = -0.4 * torch.arange(model.reg_max, dtype=torch.float32)
    with torch.no_grad():
        for branch in model.detect.cv2:
            last = branch[-1]  # type: ignore[index]
            last.bias.copy_(slope.repeat(4))


def _copy_weights(source: YoloModel, model: YoloModel) -> None:
    weights = source.state_dict()
    shapes = {name: value.shape for name, value in weights.items()}
    if source.class_names != model.class_names or shapes != {
        name: value.shape for name, value in model.state_dict().items()
    }:
        raise ValueError("the model to start from has another scale or other classes than the settings")
    model.load_state_dict({name: value.float() for name, value in weights.items()})


def _optimiser(model: nn.Module, settings: TrainingSettings) -> torch.optim.Optimizer:
    trainable = [parameter for parameter in model.parameters() if parameter.requires_grad]
    groups: list[dict[str, Any]] = [
        {"params": [p for p in trainable if p.ndim > 1], "weight_decay": settings.weight_decay},
        {"params": [p for p in trainable if p.ndim <= 1], "weight_decay": 0.0},
    ]
    if settings.optimiser == "sgd":
        return torch.optim.SGD(groups, settings.learning_rate, momentum=settings.momentum, nesterov=True)
    return torch.optim.AdamW(groups, settings.learning_rate, betas=(0.9, 0.99), foreach=True)


def _weights_of_last_classes(model: YoloModel, count: int) -> list[Tensor]:
    """Views of the last `count` classes' weights and biases in the last convolutions."""
    last = [branch[-1] for branch in model.detect.cv3]  # type: ignore[index]
    return [p.detach()[len(p) - count :] for layer in last for p in layer.parameters() if count]


def _step(optimiser: torch.optim.Optimizer, faster: Sequence[Tensor], rate: float) -> None:
    """One step, `rate` times as long for the weights `faster`."""
    before = [weights.clone() for weights in faster]
    optimiser.step()
    for weights, old in zip(faster, before, strict=True):
        weights.copy_(old.lerp(weights, rate))


def _plan(settings: TrainingSettings) -> list[list[SceneKey]]:
    """The images of every batch. The start of a stage does not depend on its length."""
    plan: list[list[SceneKey]] = []
    for number, stage in enumerate(settings.stages):
        # Scenes of each stage are numbered from its own multiple of 10⁹, so that none is repeated.
        first = number * 1_000_000_000
        order = _scene_order(np.random.default_rng([settings.seed, number]), stage)
        for _ in range(stage.steps):
            batch = [next(order) for _ in range(stage.batch_size)]
            plan.append(
                [
                    SceneKey(
                        settings.seed,
                        first + scene,
                        *(stage.drawn or (stage.width, stage.height)),
                        view,
                        None if stage.drawn is None else (stage.width, stage.height),
                    )
                    for scene, view in batch
                ]
            )
    return plan


def _scene_order(rng: np.random.Generator, stage: Stage) -> Iterator[tuple[int, int]]:
    """(scene, number of times it was used before), forever."""
    if stage.scenes is None:
        yield from ((scene, 0) for scene in itertools.count())
        return
    for view in itertools.count():
        yield from ((int(scene), view) for scene in rng.permutation(stage.scenes))


def _progress(
    settings: TrainingSettings,
    step: int,
    loss: DetectionLoss,
    rate: float,
    images: int,
    elapsed_s: float,
    loop_s: float,
    steps_here: int,
) -> Progress:
    pixels = _pixels_until(settings.stages, step)
    speed = (pixels - _pixels_until(settings.stages, step - steps_here)) / max(loop_s, 1e-9)
    return Progress(
        step=step,
        steps=settings.steps,
        box_loss=loss.box,
        class_loss=loss.classes,
        distribution_loss=loss.distribution,
        learning_rate=rate,
        images_per_s=images / max(loop_s, 1e-9),
        elapsed_s=elapsed_s,
        remaining_s=(_pixels_until(settings.stages, settings.steps) - pixels) / speed,
    )


def _pixels_until(stages: Sequence[Stage], step: int) -> int:
    """Pixels processed in the first `step` steps: proportional to the time, if stages differ in size."""
    pixels = 0
    for stage in stages:
        steps = min(step, stage.steps)
        pixels += steps * stage.batch_size * stage.width * stage.height
        step -= steps
    return pixels


_CHECKPOINT_KIND = "yolo training state 2"


def _network(model: YoloModel, settings: TrainingSettings) -> dict[str, Any]:
    description = model.description
    return {
        "family": model_family_of(model),
        "scale": [description.depth_multiple, description.width_multiple, description.max_channels],
        "class_names": list(settings.class_names),
        "optimiser": settings.optimiser,
    }


def _identity(settings: TrainingSettings, origin: Mapping[str, str]) -> dict[str, str]:
    """What a resumed training has in common with its beginning. The number of steps may differ."""
    sizes = (f"{stage.batch_size} of {stage.width}x{stage.height}" for stage in settings.stages)
    identity = {**origin, "seed": str(settings.seed), "batches": ", ".join(sizes)}
    if settings.new_classes:
        identity["new classes"] = f"{settings.new_classes}, learning {settings.new_class_rate:g} times faster"
    return identity


def _save(
    path: Path,
    settings: TrainingSettings,
    identity: dict[str, str],
    step: int,
    model: YoloModel,
    average: nn.Module,
    optimiser: torch.optim.Optimizer,
) -> None:
    """Write a temporary file, then rename it: a reader sees the old state or the new one, never a part."""
    state = {
        "kind": _CHECKPOINT_KIND,
        "network": _network(model, settings),
        "settings": asdict(settings),
        "identity": identity,
        "step": step,
        "model": model.state_dict(),
        "average": average.state_dict(),
        "optimiser": optimiser.state_dict(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    torch.save(state, part)
    os.replace(part, path)
    logger.info("training state of step %d written to %s", step, path)


def _restore(
    path: Path,
    settings: TrainingSettings,
    identity: dict[str, str],
    model: YoloModel,
    average: nn.Module,
    optimiser: torch.optim.Optimizer,
) -> int:
    if not path.is_file():
        raise FileNotFoundError(f"no training checkpoint at {path}")
    state = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(state, dict) or state.get("kind") != _CHECKPOINT_KIND:
        raise ValueError(f"{path} is not a training checkpoint of this program ({_CHECKPOINT_KIND!r})")
    if state["network"] != _network(model, settings):
        raise ValueError(
            f"{path} is of the network {state['network']}, the settings require {_network(model, settings)}"
        )
    kept: dict[str, str] = state["identity"]
    if kept != identity:
        differences = (
            f"{key}: {kept.get(key, 'none')} (now {identity.get(key, 'none')})"
            for key in {**kept, **identity}
            if kept.get(key) != identity.get(key)
        )
        raise ValueError(
            f"{path} is of another training, {'; '.join(differences)}; repeat its options, "
            "or train to another output"
        )
    model.load_state_dict(state["model"])
    average.load_state_dict(state["average"])
    optimiser.load_state_dict(state["optimiser"])
    return int(state["step"])
