"""The losses and the assignment of cells, compared with values computed by hand and with their properties."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.training.losses import (
    BINS,
    Assignment,
    Truth,
    _class_mask,
    assign_task_aligned,
    cell_grid,
    ciou,
    detection_loss,
    distribution_focal_loss,
    pairwise_iou,
)

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


Box = tuple[float, float, float, float]
side = st.floats(1, 100)
box = st.tuples(st.floats(0, 100), st.floats(0, 100), side, side).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


def test_ciou_of_equal_boxes_is_one() -> None:
    boxes = torch.tensor([[1.0, 2, 30, 40]])
    assert float(ciou(boxes, boxes)) == pytest.approx(1, abs=1e-5)


def test_ciou_of_a_shifted_box_is_iou_less_the_centre_distance() -> None:
    value = float(ciou(torch.tensor([0.0, 0, 2, 2]), torch.tensor([1.0, 0, 3, 2])))
    assert value == pytest.approx(1 / 3 - 1 / (3**2 + 2**2), abs=1e-5)


def test_ciou_weighs_the_aspect_ratio() -> None:
    first, second = torch.tensor([-2.0, -1, 2, 1]), torch.tensor([-1.0, -2, 1, 2])
    iou, aspect = 4 / 12, 4 / math.pi**2 * (math.atan(2) - math.atan(0.5)) ** 2
    assert float(ciou(first, second)) == pytest.approx(iou - aspect**2 / (1 - iou + aspect), abs=1e-5)


@settings(deadline=None)
@given(first=box, second=box)
def test_ciou_is_symmetric_and_bounded(first: Box, second: Box) -> None:
    a, b = torch.tensor(first, dtype=torch.float64), torch.tensor(second, dtype=torch.float64)
    assert float(ciou(a, b)) == pytest.approx(float(ciou(b, a)), abs=1e-9)
    assert -2 <= float(ciou(a, b)) <= 1 + 1e-9


def test_ciou_gradient_moves_a_distant_box_nearer() -> None:
    moving = torch.tensor([50.0, 50, 60, 60], requires_grad=True)
    (1 - ciou(moving, torch.tensor([0.0, 0, 10, 10]))).backward()  # type: ignore[no-untyped-call]  # not typed by torch
    assert moving.grad is not None
    assert (moving.grad > 0).sum() >= 2


def test_a_distribution_at_the_two_right_bins_has_the_least_loss() -> None:
    distance = torch.full((1, 4), 3.25)
    right = torch.full((1, 4, BINS), -30.0)
    right[..., 3], right[..., 4] = math.log(0.75), math.log(0.25)
    least = -(0.75 * math.log(0.75) + 0.25 * math.log(0.25))
    assert float(distribution_focal_loss(right, distance)) == pytest.approx(least, abs=1e-5)
    assert float(distribution_focal_loss(torch.zeros(1, 4, BINS), distance)) == pytest.approx(math.log(BINS))


def test_distances_beyond_the_bins_are_clipped_not_lost() -> None:
    loss = distribution_focal_loss(torch.zeros(2, 4, BINS), torch.tensor([[40.0] * 4, [-3.0] * 4]))
    assert loss.tolist() == pytest.approx([math.log(BINS)] * 2)


def test_cells_are_counted_level_by_level_and_row_by_row() -> None:
    centres, strides = cell_grid([(1, 2), (1, 1)], [8, 16])
    assert centres.tolist() == [[4, 4], [12, 4], [8, 8]]
    assert strides.tolist() == [8, 8, 16]


def head_maps(
    classes: int, sure_of: tuple[int, float, float, float, float] | None = None
) -> tuple[list[torch.Tensor], tuple[int, ...]]:
    """Outputs for a 64 × 64 input; with `sure_of`, the head predicts exactly that class and box."""
    strides, maps = (8, 16, 32), []
    for stride in strides:
        cells = 64 // stride
        level = torch.zeros(1, 4 * BINS + classes, cells, cells)
        level[:, 4 * BINS :] = -12
        if sure_of is not None and stride == 8:
            class_id, left, top, right, bottom = sure_of
            for row in range(cells):
                for column in range(cells):
                    x, y = (column + 0.5) * 8, (row + 0.5) * 8
                    if not (left <= x <= right and top <= y <= bottom):
                        continue
                    level[:, 4 * BINS + class_id, row, column] = 12
                    for index, distance in enumerate((x - left, y - top, right - x, bottom - y)):
                        cell, part = divmod(distance / 8, 1)
                        bins = level[0, index * BINS : (index + 1) * BINS, row, column]
                        bins.fill_(-30)
                        bins[int(cell)] = math.log(max(1 - part, 1e-9))
                        bins[int(cell) + 1] = math.log(max(part, 1e-9))
        maps.append(level.requires_grad_())
    return maps, strides


def one_object(class_id: int, *corners: float) -> Truth:
    return Truth(
        torch.tensor([[corners]], dtype=torch.float32),
        torch.tensor([[class_id]]),
        torch.ones(1, 1, dtype=torch.bool),
    )


def test_correct_head_has_almost_no_loss() -> None:
    maps, strides = head_maps(3, sure_of=(1, 12, 12, 28, 28))
    loss = detection_loss(maps, strides, one_object(1, 12, 12, 28, 28))
    assert loss.box == pytest.approx(0, abs=1e-3)
    assert loss.classes == pytest.approx(0, abs=1e-2)
    assert loss.foreground > 0


def test_the_wrong_class_costs_classification_and_no_box_loss() -> None:
    maps, strides = head_maps(3, sure_of=(1, 12, 12, 28, 28))
    loss = detection_loss(maps, strides, one_object(2, 12, 12, 28, 28))
    assert loss.classes > 5
    assert loss.box == pytest.approx(0, abs=1e-3)


def test_empty_image_trains_background_only() -> None:
    maps, strides = head_maps(3)
    loss = detection_loss(
        maps,
        strides,
        Truth(
            torch.zeros(1, 0, 4), torch.zeros(1, 0, dtype=torch.int64), torch.zeros(1, 0, dtype=torch.bool)
        ),
    )
    assert loss.box == 0
    assert loss.distribution == 0
    assert loss.classes > 0
    loss.total.backward()  # type: ignore[no-untyped-call]  # not typed by torch
    assert all(m.grad is not None and torch.isfinite(m.grad).all() for m in maps)


def test_following_the_gradient_lowers_the_loss() -> None:
    maps, strides = head_maps(3)
    truth = one_object(0, 10, 10, 40, 50)
    optimiser = torch.optim.Adam(maps, 0.3)
    first = float(detection_loss(maps, strides, truth).total.detach())
    for _ in range(60):
        optimiser.zero_grad()
        loss = detection_loss(maps, strides, truth)
        loss.total.backward()  # type: ignore[no-untyped-call]  # not typed by torch
        optimiser.step()
    assert float(detection_loss(maps, strides, truth).total.detach()) < first / 3


def test_outputs_without_class_channels_are_rejected() -> None:
    with pytest.raises(ValueError, match="got 64"):
        detection_loss([torch.zeros(1, 64, 2, 2)], [8], one_object(0, 0, 0, 8, 8))


def test_ignored_object_masks_only_its_class() -> None:
    nothing_there = Truth(
        torch.zeros(1, 0, 4), torch.zeros(1, 0, dtype=torch.int64), torch.zeros(1, 0).bool()
    )
    corners = torch.tensor([[[12.0, 12.0, 28.0, 28.0]]])
    absent, present = torch.zeros(1, 1).bool(), torch.ones(1, 1).bool()
    maps, strides = head_maps(3, sure_of=(1, 12, 12, 28, 28))
    wrong = detection_loss(maps, strides, nothing_there).classes
    same = detection_loss(maps, strides, Truth(corners, torch.tensor([[1]]), absent, present)).classes
    other = detection_loss(maps, strides, Truth(corners, torch.tensor([[2]]), absent, present)).classes
    assert same < 0.1 * wrong
    assert other == pytest.approx(wrong, rel=0.01)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 5))
def test_mask_is_that_of_a_loop_over_ignored_objects(seed: int, count: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    centres, sizes = cell_grid([(8, 8), (4, 4)], [8, 16])
    # Whole multiples of 4 pixels: some edges touch those of cells.
    corners = torch.randint(-2, 18, (2, count, 2, 2), generator=rng).sort(2).values.float() * 4
    truth = Truth(
        corners.reshape(2, count, 4),
        torch.randint(3, (2, count), generator=rng),
        torch.zeros(2, count).bool(),
        torch.rand(2, count, generator=rng) < 0.7,
    )
    assert truth.ignored is not None
    scores = torch.rand(2, len(centres), 3, generator=rng) * (torch.rand(2, 80, 3, generator=rng) < 0.3)
    expected = torch.ones(2, len(centres), 3)
    for image in range(2):
        for item in range(count):
            left, top, right, bottom = truth.boxes[image, item].tolist()
            of_class = int(truth.classes[image, item])
            for cell, ((x, y), size) in enumerate(zip(centres.tolist(), sizes.tolist(), strict=True)):
                across = x + size / 2 > left and x - size / 2 < right
                down = y + size / 2 > top and y - size / 2 < bottom
                learned = float(scores[image, cell, of_class]) > 0
                if truth.ignored[image, item] and across and down and not learned:
                    expected[image, cell, of_class] = 0
    assert torch.equal(_class_mask(truth, centres, sizes, scores), expected)
