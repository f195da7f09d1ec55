"""Task-aligned assignment of grid cells to objects, with the strength of each target.

After TOOD (Feng et al., ICCV 2021, "Task-aligned One-stage Object Detection"): a cell's alignment with an
object is t = s^α · u^β, with s its score for the object's class and u the IoU of its box with the object's.
Each object takes its `top_k` best aligned cells among those whose centre lies inside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

ALPHA = 0.5
BETA = 6.0
TOP_K = 10


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
