"""Task-aligned assignment, on cases small enough to check by hand."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.yolo.assigner import Assignment, assign_task_aligned, pairwise_iou

CENTRES = torch.tensor([[x + 4.0, y + 4.0] for y in range(0, 64, 8) for x in range(0, 64, 8)])
CELLS = len(CENTRES)


def boxes_around_centres(half: float) -> torch.Tensor:
    return torch.cat([CENTRES - half, CENTRES + half], -1)[None]


def assign(
    true_boxes: list[list[float]],
    classes: list[int],
    *,
    boxes: torch.Tensor | None = None,
    scores: torch.Tensor | None = None,
    top_k: int = 10,
    present: torch.Tensor | None = None,
) -> Assignment:
    corners = torch.tensor([true_boxes], dtype=torch.float32).reshape(1, -1, 4)
    count = corners.shape[1]
    return assign_task_aligned(
        torch.full((1, CELLS, 3), 0.5) if scores is None else scores,
        boxes_around_centres(12.0) if boxes is None else boxes,
        CENTRES,
        corners,
        torch.tensor([classes], dtype=torch.int64).reshape(1, count),
        torch.ones(1, count, dtype=torch.bool) if present is None else present,
        smallest_cell=8.0,
        top_k=top_k,
    )


def test_iou_of_half_overlapping_boxes_is_a_third() -> None:
    iou = pairwise_iou(
        torch.tensor([[0.0, 0, 2, 2]]), torch.tensor([[1.0, 0, 3, 2], [5, 5, 6, 6], [0, 0, 0, 0]])
    )
    assert iou.tolist()[0] == pytest.approx([1 / 3, 0, 0])


def test_only_cells_inside_an_object_are_given_to_it() -> None:
    found = assign([[16, 16, 40, 40]], [1])
    inside = ((CENTRES > 16) & (CENTRES < 40)).all(-1)
    assert not (found.foreground[0] & ~inside).any()
    assert found.foreground[0].sum() == 9
    assert (found.boxes[0][inside] == torch.tensor([16.0, 16, 40, 40])).all()


def test_an_object_takes_its_best_aligned_cells_alone() -> None:
    found = assign([[16, 16, 40, 40]], [1], top_k=1)
    # The cell at its centre predicts it exactly.
    assert found.foreground[0].nonzero().flatten().tolist() == [3 * 8 + 3]
    assert found.class_scores[0, 3 * 8 + 3].tolist() == pytest.approx([0, 1, 0])


def test_the_target_of_the_best_cell_is_the_best_iou() -> None:
    found = assign([[16, 16, 40, 40]], [2], boxes=boxes_around_centres(6.0))
    assert float(found.class_scores.max()) == pytest.approx(12 * 12 / (24 * 24))
    assert float(found.class_scores[..., :2].max()) == 0


def test_a_higher_class_score_wins_between_equal_boxes() -> None:
    scores = torch.full((1, CELLS, 3), 0.1)
    scores[0, 2 * 8 + 2, 0] = 0.9
    same = torch.tensor([16.0, 16, 40, 40]).repeat(1, CELLS, 1)
    found = assign([[16, 16, 40, 40]], [0], boxes=same, scores=scores, top_k=1)
    assert found.foreground[0].nonzero().flatten().tolist() == [2 * 8 + 2]


def test_contested_cell_goes_to_the_largest_overlap() -> None:
    found = assign([[8, 8, 56, 56], [16, 16, 40, 40]], [0, 1])
    middle = 3 * 8 + 3
    assert found.boxes[0, middle].tolist() == [16, 16, 40, 40]
    assert int(found.class_scores[0, middle].argmax()) == 1


def test_object_between_cell_centres_is_assigned() -> None:
    found = assign([[7, 7, 9, 9]], [0])
    assert found.foreground.any()


def test_faint_overlaps_still_make_targets() -> None:
    """With β = 6 the alignment of a small object in big initial boxes is 1e-14; it must not round to zero."""
    found = assign([[18, 18, 22, 22]], [0], boxes=boxes_around_centres(60.0))
    assert float(found.class_scores.max()) == pytest.approx(16 / 120**2, rel=1e-3)


def test_padding_is_given_nothing() -> None:
    found = assign([[16, 16, 40, 40]], [1], present=torch.zeros(1, 1, dtype=torch.bool))
    assert not found.foreground.any()
    assert float(found.class_scores.sum()) == 0


def test_a_batch_without_objects_is_all_background() -> None:
    found = assign([], [])
    assert found.foreground.shape == (1, CELLS)
    assert not found.foreground.any()


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 6))
def test_targets_are_proper_for_any_objects(seed: int, count: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator) * 50
    truth = torch.cat([corner, corner + 1 + torch.rand(count, 2, generator=generator) * 40], -1)
    classes = torch.randint(0, 3, (count,), generator=generator)
    found = assign(
        truth.tolist(),
        classes.tolist(),
        scores=torch.rand(1, CELLS, 3, generator=generator),
        boxes=boxes_around_centres(float(torch.rand((), generator=generator)) * 20 + 1),
    )
    assert bool(((found.class_scores >= 0) & (found.class_scores <= 1)).all())
    assert bool(((found.class_scores > 0).sum(-1) <= 1).all())
    assert not bool((found.class_scores.sum(-1) > 0)[~found.foreground].any())
    known = {(tuple(box), int(c)) for box, c in zip(truth.tolist(), classes, strict=True)}
    for image, cell in found.foreground.nonzero().tolist():
        if float(found.class_scores[image, cell].max()) > 0:
            pair = (tuple(found.boxes[image, cell].tolist()), int(found.class_scores[image, cell].argmax()))
            assert pair in known
