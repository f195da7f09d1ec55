"""Fit of a lens and of the board's poses to views: damped least squares (Levenberg, Marquardt).

The poses are eliminated from the normal equations (Schur complement), as in bundle adjustment (Triggs et al.
2000). Residuals are weighted after Huber, so that a few wrong corners have little influence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.calibration.boards import BoardView
from vision.camera_model import RATIONAL, CameraModel, DistortionModel

Array = NDArray[np.float64]

HUBER_PX = 1.0
COEFFICIENTS: dict[DistortionModel, int] = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
# Focal lengths from which a fit starts, in widths of the image: 131 to 23 degrees across without distortion.
_STARTS = (0.23, 0.35, 0.5, 0.7, 1.0, 1.5, 2.5)
_MAX_STEPS = 60
# A relative decrease of the cost that ends the fit.
_CONVERGED = 1e-7
_STEP = 1e-6
# Views determine little more of a rational lens than the quotient of its two polynomials, so that fits differ
# widely where no corner is. The coefficients are therefore observed, weakly: as those of an ideal equidistant
# lens (the Padé approximant of atan(r) / r in r²), with this one-sigma error, at the weight of one corner
# with an error of _PRIOR_PX. All pixels of 8 of the lenses of benchmarks/calibration.py then have rays (of 5
# without it), and the rays in the images' corners are closer to the true ones.
_IDEAL = np.array([50 / 39, 283 / 715, 0.0, 0.0, 256 / 15015, 21 / 13, 105 / 143, 35 / 429])
_IDEAL_SIGMA = np.array([0.3, 0.3, np.inf, np.inf, 0.1, 0.3, 0.3, 0.1])
_PRIOR_PX = 0.1
# For the first pose of a board only corners well ahead of the camera are used.
_AHEAD = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted lens.

    Attributes:
        model: the lens.
        rotations: (V, 3, 3) `optical_from_board` of each view.
        positions_m: (V, 3) the board's origin in the optical frame.
        residuals_px: of each view (N, 2), projected minus detected.
        sigmas: (4 + K,) one-sigma errors of fx, fy, cx, cy and the coefficients, from the residuals; infinite
            where the views do not determine them.
    """

    model: CameraModel
    rotations: Array
    positions_m: Array
    residuals_px: tuple[Array, ...]
    sigmas: Array

    @property
    def view_rms_px(self) -> Array:
        """(V,) RMS reprojection error of each view, pixels."""
        return np.array([_rms(residuals) for residuals in self.residuals_px])

    @property
    def rms_px(self) -> float:
        """RMS reprojection error over all corners, pixels."""
        return _rms(np.concatenate(self.residuals_px))


def fit(kind: DistortionModel, views: Sequence[BoardView], start: CameraModel | None = None) -> Fit:
    """Fit a lens of this distortion model.

    Args:
        views: of images of one size.
        start: a lens near the solution; None: it is searched.

    Raises:
        ValueError: no lens fits at all.
    """
    count = 4 + COEFFICIENTS[kind]
    stages: tuple[int, ...] = (0, count)
    if start is None:
        start, stages = _start(kind, views), (0, 4, count)
    problem = _Problem(views)
    rotations, positions = problem.first_poses(start)
    for free in stages:
        start, rotations, positions = problem.solve(start, rotations, positions, free)
    # With the fitted lens a board whose first pose led to a wrong minimum may have a better one.
    better = problem.better_poses(start, rotations, positions)
    if better is not None:
        start, rotations, positions = problem.solve(start, *better, count)
    return problem.result(start, rotations, positions)


def held_out_rms_px(model: CameraModel, views: Sequence[BoardView]) -> Array:
    """(V,) RMS errors, pixels, of views that the lens was not fitted to; only the board's poses are."""
    problem = _Problem(views)
    _, rotations, positions = problem.solve(model, *problem.first_poses(model), 0)
    squares = (problem.residuals(model, rotations, positions) ** 2).sum(axis=1)
    counts = [len(view.points_m) for view in views]
    return np.asarray(np.sqrt(np.add.reduceat(squares, problem.starts) / counts), np.float64)


def _start(kind: DistortionModel, views: Sequence[BoardView]) -> CameraModel:
    """The lens that fits best among a few focal lengths: undistorted, a rational one ideally equidistant."""
    width, height = views[0].size
    problem = _Problem(views)
    best, least = None, math.inf
    for share in _STARTS:
        focal = share * width
        lens = tuple(_IDEAL.tolist()) if kind == RATIONAL else (0.0,) * COEFFICIENTS[kind]
        model = CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, lens, kind)
        try:
            poses = problem.first_poses(model)
        except ValueError:
            continue
        cost = float(np.median(np.abs(problem.residuals(model, *poses))))
        if cost < least:
            best, least = model, cost
    if best is None:
        raise ValueError("no lens fits the views")
    return best


class _Problem:
    """The corners of all views, one after the other."""

    def __init__(self, views: Sequence[BoardView]) -> None:
        self.views = views
        counts = [len(view.points_m) for view in views]
        self.starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        self.view = np.repeat(np.arange(len(views)), counts)
        points = np.concatenate([view.points_m for view in views])
        self.points = np.column_stack([points, np.zeros(len(points))])
        self.corners = np.concatenate([view.corners_px for view in views])

    def first_poses(self, model: CameraModel) -> tuple[Array, Array]:
        """The board's poses from homographies. Raises ValueError where there is none."""
        rays = np.split(model.rays(self.corners), self.starts[1:])
        poses = [_first_pose(view, seen) for view, seen in zip(self.views, rays, strict=True)]
        return np.array([rotation for rotation, _ in poses]), np.array([position for _, position in poses])

    def better_poses(
        self, model: CameraModel, rotations: Array, positions: Array
    ) -> tuple[Array, Array] | None:
        """The poses, with those from homographies where they fit much better; None: they do nowhere."""
        try:
            others = self.first_poses(model)
        except ValueError:
            return None
        errors = [
            np.add.reduceat((self.residuals(model, *poses) ** 2).sum(axis=1), self.starts)
            for poses in ((rotations, positions), others)
        ]
        wrong = errors[1] < 0.5 * errors[0]
        if not wrong.any():
            return None
        return (
            np.where(wrong[:, None, None], others[0], rotations),
            np.where(wrong[:, None], others[1], positions),
        )

    def optical(self, rotations: Array, positions: Array) -> tuple[Array, Array]:
        """(N, 3) the corners rotated, and in the optical frame."""
        rotated = np.einsum("nij,nj->ni", rotations[self.view], self.points)
        return rotated, rotated + positions[self.view]

    def residuals(self, model: CameraModel, rotations: Array, positions: Array) -> Array:
        """(N, 2) projected minus detected, pixels."""
        residuals: Array = model.project(self.optical(rotations, positions)[1]) - self.corners
        return residuals

    def solve(
        self, model: CameraModel, rotations: Array, positions: Array, free: int
    ) -> tuple[CameraModel, Array, Array]:
        """Refine the poses and the first `free` parameters of the lens."""
        damping = 1e-3
        errors = self.residuals(model, rotations, positions)
        cost = _cost(errors) + _prior(model, free)[0]
        for _ in range(_MAX_STEPS):
            if not math.isfinite(cost):
                break
            lens, mixed, poses, lens_side, pose_side = self.normal(model, rotations, positions, errors, free)
            improved = False
            while damping < 1e9:
                step = _solve(lens, mixed, poses, lens_side, pose_side, damping)
                candidate = None if step is None else _moved(model, step[0])
                if step is not None and candidate is not None:
                    turned = np.array(
                        [cv2.Rodrigues(turn)[0] @ old for turn, old in zip(step[1], rotations, strict=True)]
                    )
                    shifted = positions + step[2]
                    new_errors = self.residuals(candidate, turned, shifted)
                    new_cost = _cost(new_errors) + _prior(candidate, free)[0]
                    if new_cost < cost:
                        improved = True
                        break
                damping *= 10.0
            if not improved:
                break
            assert candidate is not None
            gained = (cost - new_cost) / cost
            model, rotations, positions, errors, cost = candidate, turned, shifted, new_errors, new_cost
            damping = max(damping / 10.0, 1e-12)
            if gained < _CONVERGED:
                break
        return model, rotations, positions

    def normal(
        self, model: CameraModel, rotations: Array, positions: Array, errors: Array, free: int
    ) -> tuple[Array, Array, Array, Array, Array]:
        """The normal equations.

        Returns:
            (F, F) of the lens, (V, F, 6) mixed, (V, 6, 6) of the poses (a small rotation about the camera's
            axes, then the position), and their right sides (F,) and (V, 6).
        """
        rotated, optical = self.optical(rotations, positions)
        weight = np.sqrt(_weights(errors))[:, None]
        by_point = np.empty((len(optical), 2, 3))
        scale = _STEP * np.maximum(np.abs(optical).max(axis=1), 1e-6)
        for axis in range(3):
            offset = np.zeros((len(optical), 3))
            offset[:, axis] = scale
            difference = model.project(optical + offset) - model.project(optical - offset)
            by_point[:, :, axis] = difference / (2 * scale[:, None])
        by_point *= weight[:, :, None]
        by_pose = np.empty((len(optical), 2, 6))
        x, y, z = rotated.T
        zero = np.zeros_like(x)
        # d(ω × r)/dω
        cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
        by_pose[:, :, :3] = by_point @ cross
        by_pose[:, :, 3:] = by_point
        by_lens = np.zeros((len(optical), 2, free))
        if free:
            u, v = (errors + self.corners).T
            by_lens[:, 0, 0], by_lens[:, 1, 1] = (u - model.cx) / model.fx, (v - model.cy) / model.fy
            by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
        for index in range(4, free):
            ahead, back = (_moved(model, sign * np.eye(free)[index]) for sign in (_STEP, -_STEP))
            assert ahead is not None
            assert back is not None
            by_lens[:, :, index] = (ahead.project(optical) - back.project(optical)) / (2 * _STEP)
        by_lens *= weight[:, :, None]
        np.nan_to_num(by_pose, copy=False)  # at the edge of a fisheye
        np.nan_to_num(by_lens, copy=False)
        wrong = -(errors * weight)
        add = np.add.reduceat
        poses = add(np.einsum("nki,nkj->nij", by_pose, by_pose), self.starts)
        mixed = add(np.einsum("nki,nkj->nij", by_lens, by_pose), self.starts)
        pose_side = add(np.einsum("nki,nk->ni", by_pose, wrong), self.starts)
        _, weights, pulls = _prior(model, free)
        lens = np.einsum("nki,nkj->ij", by_lens, by_lens) + np.diag(weights)
        return lens, mixed, poses, np.einsum("nki,nk->i", by_lens, wrong) + pulls, pose_side

    def result(self, model: CameraModel, rotations: Array, positions: Array) -> Fit:
        errors = self.residuals(model, rotations, positions)
        if not np.isfinite(errors).all():
            raise ValueError(f"no {model.distortion_model} lens fits the views")
        count = 4 + COEFFICIENTS[model.distortion_model]
        lens, mixed, poses, _, _ = self.normal(model, rotations, positions, errors, count)
        spare = max(errors.size - count - 6 * len(self.views), 1)
        variance = float((_weights(errors)[:, None] * errors**2).sum()) / spare
        reduced = lens - np.einsum("vij,vjk,vlk->il", mixed, np.linalg.inv(poses), mixed)
        # Scaled, since the parameters differ by orders of magnitude.
        scale = np.sqrt(np.maximum(np.diag(lens), 1e-300))
        try:
            covariance = np.linalg.inv(reduced / np.outer(scale, scale)) / np.outer(scale, scale)
            diagonal = np.diag(covariance) * variance
        except np.linalg.LinAlgError:
            diagonal = np.full(count, np.inf)
        sigmas = np.sqrt(np.where(diagonal >= 0.0, diagonal, np.inf))
        return Fit(model, rotations, positions, tuple(np.split(errors, self.starts[1:])), sigmas)


def _first_pose(view: BoardView, rays: Array) -> tuple[Array, Array]:
    """The board's rotation and position from the homography to its corners' rays (Zhang 2000)."""
    used = rays[:, 2] > _AHEAD  # NaN is not
    plane = rays[used, :2] / rays[used, 2:]
    homography = cv2.findHomography(view.points_m[used], plane)[0] if used.sum() >= 4 else None
    if homography is None:
        raise ValueError(f"{view.name}: the board has no pose")
    first, second, position = np.asarray(homography, np.float64).T
    scale = math.sqrt(float(np.linalg.norm(first) * np.linalg.norm(second)))
    if position[2] < 0.0:
        scale = -scale
    first, second, position = first / scale, second / scale, position / scale
    left, _, right = np.linalg.svd(np.column_stack([first, second, np.cross(first, second)]))
    return np.asarray(left @ right, np.float64), position


def _moved(model: CameraModel, change: Array) -> CameraModel | None:
    """The lens with changed parameters, the first ones; None if that is no lens."""
    values = np.array([model.fx, model.fy, model.cx, model.cy, *model.coefficients])
    values[: len(change)] += change
    fx, fy, cx, cy, *lens = values.tolist()
    if not np.isfinite(values).all() or fx <= 0.0 or fy <= 0.0:
        return None
    return replace(model, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(lens))


def _solve(
    lens: Array, mixed: Array, poses: Array, lens_side: Array, pose_side: Array, damping: float
) -> tuple[Array, Array, Array] | None:
    """The damped step of the lens (F,), of the rotations (V, 3) and of the positions (V, 3)."""
    damped = poses.copy()
    damped[:, range(6), range(6)] *= 1.0 + damping
    try:
        inverse = np.linalg.inv(damped)
        step = np.zeros(0)
        if len(lens):
            reduced = lens + np.diag(np.diag(lens) * damping)
            reduced -= np.einsum("vij,vjk,vlk->il", mixed, inverse, mixed)
            side = lens_side - np.einsum("vij,vjk,vk->i", mixed, inverse, pose_side)
            step = np.linalg.solve(reduced, side)
        by_pose = np.einsum("vij,vj->vi", inverse, pose_side - np.einsum("vij,i->vj", mixed, step))
    except np.linalg.LinAlgError:
        return None
    return step, by_pose[:, :3], by_pose[:, 3:]


def _weights(errors: Array) -> Array:
    """(N,) Huber's weights of the corners."""
    length = np.sqrt((errors**2).sum(axis=1))
    return np.asarray(HUBER_PX / np.maximum(length, HUBER_PX), np.float64)


def _prior(model: CameraModel, free: int) -> tuple[float, Array, Array]:
    """Cost, weights (F,) and right side (F,) of the observed coefficients; zero unless they are free."""
    weights, off = np.zeros(free), np.zeros(free)
    if model.distortion_model == RATIONAL and free > 4:
        weights[4:] = (_PRIOR_PX / _IDEAL_SIGMA) ** 2
        off[4:] = _IDEAL - model.coefficients
    return float(weights @ off**2), weights, weights * off


def _cost(errors: Array) -> float:
    """Huber's cost; infinite where a corner is not seen at all."""
    length = np.sqrt((errors**2).sum(axis=1))
    small = length <= HUBER_PX
    total = float(np.where(small, length**2, 2 * HUBER_PX * length - HUBER_PX**2).sum())
    return total if math.isfinite(total) else math.inf


def _rms(residuals: Array) -> float:
    """RMS distance over corners, pixels."""
    return math.sqrt(float((residuals**2).sum()) / max(len(residuals), 1))
