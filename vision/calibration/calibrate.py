"""Calibration of a lens from views of a board: outliers, the choice of the distortion model, the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vision.calibration.boards import BoardView
from vision.calibration.fit import Fit, fit, held_out_rms_px
from vision.camera_model import PLUMB_BOB, CameraModel, DistortionModel, pixels_without_rays

LEAST_VIEWS = 6
# A view whose error is larger than the median by this factor is an outlier; below this error none is.
OUTLIER, NO_OUTLIER_PX = 3.0, 0.05
# A pinhole camera with five coefficients is taken unless another model's error on held-out views is smaller
# by the first factor; of the others the fisheye, with fewer coefficients, unless by the second.
BETTER, BETTER_OF_OTHERS = 0.9, 0.99
# Relative one-sigma error of the focal length above which the views do not determine the lens.
WORST_FOCAL = 0.02
_FOLDS = 4
_MODELS: tuple[DistortionModel, ...] = ("plumb_bob", "equidistant", "rational_polynomial")


class CalibrationError(ValueError):
    """The views give no calibration; the text says what is missing."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationResult:
    """A calibrated lens.

    Attributes:
        model: the lens.
        views: those that it was fitted to.
        fit: of these views, with their errors.
        rejected: outliers, and their RMS errors in pixels.
        held_out_px: of each distortion model, the median RMS error of a view that it was not fitted to;
            missing: it fits none.
    """

    model: CameraModel
    views: tuple[BoardView, ...]
    fit: Fit
    rejected: tuple[tuple[BoardView, float], ...]
    held_out_px: dict[DistortionModel, float]

    @property
    def rms_px(self) -> float:
        """RMS reprojection error over all corners of the used views, pixels."""
        return self.fit.rms_px


def calibrate(views: Sequence[BoardView]) -> CalibrationResult:
    """Calibrate a lens.

    Views whose error stands out are rejected. The distortion model is plumb_bob, unless another one is at
    least 10 % better on held-out views. The same holds for a model that leaves pixels of the image without a
    ray, compared with those that do not.

    Args:
        views: of images of one size, see `ViewCollector`.

    Raises:
        CalibrationError: too few views, or views that do not determine the lens.
    """
    _check_count(len(views), "")
    used, fits, rejected = list(views), _fits(views), []
    while True:
        best = min(fits.values(), key=lambda found: float(np.median(found.view_rms_px)))
        errors = best.view_rms_px
        limit = max(OUTLIER * float(np.median(errors)), NO_OUTLIER_PX)
        if (errors <= limit).all():
            break
        rejected += [(view, float(error)) for view, error in zip(used, errors, strict=True) if error > limit]
        used = [view for view, error in zip(used, errors, strict=True) if error <= limit]
        _check_count(len(used), f", after {len(rejected)} with wrong corners were rejected")
        fits = _fits(used, {kind: found.model for kind, found in fits.items()})
    held_out = {kind: _held_out_px(found, used) for kind, found in fits.items()}
    result = fits[_chosen(fits, held_out)]
    focal_sigma = float(max(result.sigmas[0] / result.model.fx, result.sigmas[1] / result.model.fy))
    if not focal_sigma < WORST_FOCAL:
        raise CalibrationError(
            f"the views do not determine the focal length (error {focal_sigma:.1%}): add views with "
            "the board tilted by 30 degrees to each side"
        )
    return CalibrationResult(result.model, tuple(used), result, tuple(rejected), held_out)


def _chosen(fits: dict[DistortionModel, Fit], held_out_px: dict[DistortionModel, float]) -> DistortionModel:
    covering = [kind for kind, found in fits.items() if not pixels_without_rays(found.model)]
    chosen, *others = covering or fits
    for kind in others:
        if held_out_px[kind] <= (BETTER if chosen == PLUMB_BOB else BETTER_OF_OTHERS) * held_out_px[chosen]:
            chosen = kind
    for kind in fits:
        if kind not in covering and held_out_px[kind] <= BETTER * held_out_px[chosen]:
            chosen = kind
    return chosen


def _check_count(count: int, after: str) -> None:
    if count < LEAST_VIEWS:
        raise CalibrationError(
            f"too few views of the board: {count} different ones{after}, at least {LEAST_VIEWS} are needed"
        )


def _fits(
    views: Sequence[BoardView], starts: dict[DistortionModel, CameraModel] | None = None
) -> dict[DistortionModel, Fit]:
    """A fit of each distortion model that fits the views."""
    fits: dict[DistortionModel, Fit] = {}
    for kind in _MODELS:
        try:
            fits[kind] = fit(kind, views, None if starts is None else starts.get(kind))
        except ValueError:
            continue
    if not fits:
        raise CalibrationError("no lens fits the views: are the board's size and kind right?")
    return fits


def _held_out_px(found: Fit, views: Sequence[BoardView]) -> float:
    """Median RMS error of views that the lens was not fitted to; infinite where it does not fit them.

    The median, since a view at the edge of what the others cover says more of them than of the model.
    """
    errors = []
    for fold in range(_FOLDS):
        others = [view for index, view in enumerate(views) if index % _FOLDS != fold]
        try:
            model = fit(found.model.distortion_model, others, found.model).model
            errors.append(held_out_rms_px(model, views[fold::_FOLDS]))
        except ValueError:
            return float("inf")
    return float(np.median(np.concatenate(errors)))
