"""The figures of `test_outputs_match_the_reference`, from the reference, for development only.

PYTHONPATH=. OTHER_VENV/bin/python tools/golden_maps.py
"""

from __future__ import annotations

import sys

import torch
from ultralytics.nn.tasks import DetectionModel, yaml_model_load

from tests.vision.test_model_families import FEW, GOLDEN, facts, fill, make_image
from tools.ultralytics_parity import oracle_maps


def main() -> int:
    wrong = False
    for (model_family, scale), recorded in GOLDEN.items():
        table = yaml_model_load(f"{model_family.lower().removesuffix('u')}{scale}.yaml")
        table |= {"scale": scale, "scales": {scale: [0.34, 0.25, 1024]}}
        model = DetectionModel(table, nc=len(FEW), verbose=False).eval()
        state = model.state_dict()
        fill(state)
        model.load_state_dict(state)
        end_to_end = model_family in ("YOLOv10", "YOLO26")
        with torch.inference_mode():
            output = model(make_image())
        got = facts([oracle_maps(output, end_to_end)[..., None]])
        different = max(abs(a - b) for a, b in zip(got, recorded, strict=True)) > 1e-4 * got[1]
        wrong |= different
        numbers = ", ".join(f"{value:.6g}" for value in got)
        print(f'    ("{model_family}", "{scale}"): ({numbers}),{"  # differs" if different else ""}')
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
