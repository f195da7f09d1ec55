"""The three losses of the YOLOv8 head, and the assignment of grid cells to objects.

Boxes: CIoU (Zheng et al., AAAI 2020, "Distance-IoU Loss") and the distribution focal loss over distance bins
(Li et al., NeurIPS 2020, "Generalized Focal Loss"). Classes: binary cross-entropy against task-aligned soft
targets (TOOD, Feng et al., ICCV 2021, "Task-aligned One-stage Object Detection"): a cell's alignment with an
object is t = s^α · u^β, with s its score for the object's class and u the IoU of its box with the object's.
Each object takes its `top_k` best aligned cells among those whose centre lies inside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

ALPHA = 0.5
BETA = 6.0
TOP_K = 10
BINS = 16
"""Distance bins per side of a box; bin k is k strides."""
BOX_GAIN = 7.5
CLASS_GAIN = 0.5
DISTRIBUTION_GAIN = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """Training targets of each of A cells of B images.

    Attributes:
        foreground: (B, A) bool, the cells with an object.
        boxes: (B, A, 4) float, pixels xyxy: the cell's object; zeros for background.
        class_scores: (B, A, classes) float in 0..1: the soft classification target, the alignment
            normalised so that an object's best cell gets the object's best IoU.
    """

    foreground: Tensor
    boxes: Tensor
    class_scores: Tensor


def pairwise_iou(first: Tensor, second: Tensor) -> Tensor:
    """(..., N, 4) and (..., M, 4) boxes xyxy → (..., N, M) intersection over union, 0 for empty boxes."""
    top_left = torch.maximum(first[..., :, None, :2], second[..., None, :, :2])
    bottom_right = torch.minimum(first[..., :, None, 2:], second[..., None, :, 2:])
    intersection = (bottom_right - top_left).clamp(min=0).prod(-1)
    area_first = (first[..., 2:] - first[..., :2]).clamp(min=0).prod(-1)
    area_second = (second[..., 2:] - second[..., :2]).clamp(min=0).prod(-1)
    union = area_first[..., :, None] + area_second[..., None, :] - intersection
    return intersection / union.clamp(min=1e-9)


@torch.no_grad()
def assign_task_aligned(
    scores: Tensor,
    boxes: Tensor,
    centres: Tensor,
    true_boxes: Tensor,
    true_classes: Tensor,
    present: Tensor,
    *,
    smallest_cell: float,
    top_k: int = TOP_K,
    alpha: float = ALPHA,
    beta: float = BETA,
) -> Assignment:
    """Match the predictions of B images with up to M objects each.

    Args:
        scores: (B, A, classes) predicted class probabilities in 0..1.
        boxes: (B, A, 4) predicted boxes, pixels xyxy.
        centres: (A, 2) cell centres, pixels.
        true_boxes: (B, M, 4) pixels xyxy, padded.
        true_classes: (B, M) int64, padded with any valid id.
        present: (B, M) bool, false for the padding.
        smallest_cell: the finest stride in pixels. A thinner object is extended to this width when testing
            which centres lie inside it, so that it contains at least one.
        top_k: cells per object.
        alpha: exponent of the class score.
        beta: exponent of the IoU.

    Returns:
        An `Assignment` for the A cells of each image. A cell claimed by several objects goes to the one with
        the largest overlap.
    """
    batch, cells, _ = scores.shape
    most = true_boxes.shape[1]
    if most == 0:
        return Assignment(
            scores.new_zeros(batch, cells, dtype=torch.bool),
            torch.zeros_like(boxes),
            torch.zeros_like(scores),
        )

    centre = (true_boxes[..., :2] + true_boxes[..., 2:]) / 2
    reach = ((true_boxes[..., 2:] - true_boxes[..., :2]) / 2).clamp(min=smallest_cell / 2)
    offset = (centres[None, None] - centre[:, :, None]).abs()
    # ≤: an object exactly between two cells belongs to both.
    candidate = (offset <= reach[:, :, None]).all(-1) & present[..., None]

    overlap = pairwise_iou(true_boxes, boxes) * candidate
    of_class = true_classes[:, :, None].expand(-1, -1, cells)
    class_score = scores.transpose(1, 2).gather(1, of_class)
    alignment = class_score.pow(alpha) * overlap.pow(beta)

    # Cells outside an object rank below every cell inside it, even while all alignments are zero.
    ranked = torch.where(candidate, alignment, torch.full_like(alignment, -1.0))
    best = ranked.topk(min(top_k, cells), dim=-1).indices
    claimed = torch.zeros_like(candidate).scatter_(-1, best, True) & candidate

    contested = claimed.sum(1, keepdim=True) > 1
    preferred = torch.where(claimed, overlap, torch.full_like(overlap, -1.0)).argmax(1, keepdim=True)
    chosen_only = torch.zeros_like(claimed).scatter_(1, preferred, True) & claimed
    claimed = torch.where(contested, chosen_only, claimed)

    foreground = claimed.any(1)
    owner = claimed.to(torch.uint8).argmax(1)
    cell_boxes = true_boxes.gather(1, owner[..., None].expand(-1, -1, 4)) * foreground[..., None]

    alignment = alignment * claimed
    strongest = alignment.amax(-1, keepdim=True).clamp(min=torch.finfo(alignment.dtype).tiny)
    best_overlap = (overlap * claimed).amax(-1, keepdim=True)
    strength = (alignment / strongest * best_overlap).amax(1)
    cell_classes = true_classes.gather(1, owner)
    targets = torch.zeros_like(scores).scatter_(-1, cell_classes[..., None], strength[..., None])
    return Assignment(foreground, cell_boxes, targets)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionLoss:
    """The weighted sum to minimise, and its weighted parts for the log.

    Attributes:
        total: scalar with gradient, the mean per image.
        box: scalar, CIoU part, detached.
        classes: scalar, classification part, detached.
        distribution: scalar, distribution focal part, detached.
        foreground: number of foreground cells per image, on average.
    """

    total: Tensor
    box: float
    classes: float
    distribution: float
    foreground: float


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Ground truth of B images, padded to the largest number of objects.

    Attributes:
        boxes: (B, M, 4) float32, pixels xyxy of the network's input.
        classes: (B, M) int64.
        present: (B, M) bool, false for padding.
        ignored: (B, M) bool: objects too small or too occluded to be learned. Inside one, its class does not
            contribute to the loss; other classes do. None: there is none.
    """

    boxes: Tensor
    classes: Tensor
    present: Tensor
    ignored: Tensor | None = None


def ciou(first: Tensor, second: Tensor) -> Tensor:
    """Complete IoU of paired boxes: (..., 4) and (..., 4) pixels xyxy → (...) in -1.5..1.

    IoU, less the squared centre distance over the enclosing box's squared diagonal, less the weighted
    difference of aspect ratios. The weight has no gradient, as in the paper.
    """
    tiny = 1e-7
    size_first = (first[..., 2:] - first[..., :2]).clamp(min=0)
    size_second = (second[..., 2:] - second[..., :2]).clamp(min=0)
    inner = torch.minimum(first[..., 2:], second[..., 2:]) - torch.maximum(first[..., :2], second[..., :2])
    intersection = inner.clamp(min=0).prod(-1)
    union = size_first.prod(-1) + size_second.prod(-1) - intersection
    iou = intersection / (union + tiny)

    outer = torch.maximum(first[..., 2:], second[..., 2:]) - torch.minimum(first[..., :2], second[..., :2])
    diagonal = outer.square().sum(-1) + tiny
    distance = (first[..., :2] + first[..., 2:] - second[..., :2] - second[..., 2:]).square().sum(-1) / 4

    angle_first = torch.atan2(size_first[..., 0], size_first[..., 1] + tiny)
    angle_second = torch.atan2(size_second[..., 0], size_second[..., 1] + tiny)
    aspect = (4 / math.pi**2) * (angle_first - angle_second).square()
    with torch.no_grad():
        weight = aspect / (1 - iou + aspect + tiny)
    return iou - distance / diagonal - weight * aspect


def distribution_focal_loss(logits: Tensor, distances: Tensor) -> Tensor:
    """Cross-entropy against the two bins around each true distance, weighted by proximity.

    Args:
        logits: (N, 4, BINS) raw bins of each side.
        distances: (N, 4) true distances in strides; clipped to the bins' range.

    Returns:
        (N,) the mean over the four sides.
    """
    bins = logits.shape[-1]
    clipped = distances.clamp(0, bins - 1 - 0.01)
    lower = clipped.floor()
    toward_upper = clipped - lower
    log_probability = logits.log_softmax(-1)
    index = lower.long()[..., None]
    at_lower = log_probability.gather(-1, index)[..., 0]
    at_upper = log_probability.gather(-1, index + 1)[..., 0]
    return -(at_lower * (1 - toward_upper) + at_upper * toward_upper).mean(-1)


def cell_grid(
    shapes: Sequence[tuple[int, int]], strides: Sequence[float], device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """Centres (A, 2) in pixels and strides (A,) of all cells: level after level, row by row."""
    centres, sizes = [], []
    for (height, width), stride in zip(shapes, strides, strict=True):
        rows = (torch.arange(height, device=device, dtype=torch.float32) + 0.5) * stride
        columns = (torch.arange(width, device=device, dtype=torch.float32) + 0.5) * stride
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        centres.append(torch.stack([x, y], -1).reshape(-1, 2))
        sizes.append(torch.full((height * width,), float(stride), device=device))
    return torch.cat(centres), torch.cat(sizes)


def detection_loss(outputs: Sequence[Tensor], strides: Sequence[float], truth: Truth) -> DetectionLoss:
    """The loss of one batch.

    Args:
        outputs: raw head outputs, one per stride, (B, 4 · BINS + classes, H, W): first the bins of left, top,
            right and bottom, then the class logits.
        strides: pixels per cell of each output.
        truth: the objects of the B images.

    Raises:
        ValueError: an output has no class logits.
    """
    channels = outputs[0].shape[1]
    if channels <= 4 * BINS:
        raise ValueError(f"head outputs must have {4 * BINS} + classes channels, got {channels}")
    centres, cell_sizes = cell_grid([(m.shape[2], m.shape[3]) for m in outputs], strides, outputs[0].device)
    flat = torch.cat([m.flatten(2) for m in outputs], 2).transpose(1, 2)
    bin_logits = flat[..., : 4 * BINS].reshape(*flat.shape[:2], 4, BINS)
    class_logits = flat[..., 4 * BINS :]

    with torch.no_grad():
        predicted = _boxes_from_bins(bin_logits, centres, cell_sizes[:, None])
        target = assign_task_aligned(
            class_logits.sigmoid(),
            predicted,
            centres,
            truth.boxes,
            truth.classes,
            truth.present,
            smallest_cell=float(min(strides)),
        )
    # The sum of the soft targets normalises the loss; with less than one object it must not inflate it.
    evidence = target.class_scores.sum().clamp(min=1.0)
    entropy = F.binary_cross_entropy_with_logits(class_logits, target.class_scores, reduction="none")
    classes = (entropy * _class_mask(truth, centres, cell_sizes, target.class_scores)).sum() / evidence

    image, cell = target.foreground.nonzero(as_tuple=True)
    weight = target.class_scores[image, cell].sum(-1)
    chosen = bin_logits[image, cell]
    centre, size = centres[cell], cell_sizes[cell][:, None]
    true_boxes = target.boxes[image, cell]
    box = ((1 - ciou(_boxes_from_bins(chosen, centre, size), true_boxes)) * weight).sum() / evidence
    distances = torch.cat([centre - true_boxes[:, :2], true_boxes[:, 2:] - centre], -1) / size
    distribution = (distribution_focal_loss(chosen, distances) * weight).sum() / evidence

    box, classes, distribution = BOX_GAIN * box, CLASS_GAIN * classes, DISTRIBUTION_GAIN * distribution
    return DetectionLoss(
        box + classes + distribution,
        float(box.detach()),
        float(classes.detach()),
        float(distribution.detach()),
        len(image) / max(len(flat), 1),
    )


def _class_mask(truth: Truth, centres: Tensor, cell_sizes: Tensor, class_scores: Tensor) -> Tensor:
    """(B, A, classes) weights: 0 inside an ignored object of the class, 1 elsewhere."""
    if truth.ignored is None or not truth.boxes.shape[1]:
        return torch.ones_like(class_scores)
    reach = cell_sizes[:, None] / 2
    low, high = centres - reach, centres + reach
    boxes = truth.boxes[:, :, None]
    inside = (high > boxes[..., :2]).all(-1) & (low < boxes[..., 2:]).all(-1) & truth.ignored[..., None]
    of_class = F.one_hot(truth.classes, class_scores.shape[-1]).to(class_scores.dtype)
    hidden = torch.einsum("bma,bmc->bac", inside.to(class_scores.dtype), of_class) > 0
    return torch.where(hidden & (class_scores <= 0), 0.0, 1.0)


def _boxes_from_bins(bin_logits: Tensor, centres: Tensor, cell_sizes: Tensor) -> Tensor:
    """(..., 4, BINS) → (..., 4) pixels xyxy: each side's distance is its distribution's mean."""
    steps = torch.arange(bin_logits.shape[-1], dtype=bin_logits.dtype, device=bin_logits.device)
    distances = (bin_logits.softmax(-1) * steps).sum(-1) * cell_sizes
    return torch.cat([centres - distances[..., :2], centres + distances[..., 2:]], -1)
