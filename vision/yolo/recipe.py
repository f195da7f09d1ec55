"""The course of training that made the bundled weights, and the scenes they are judged on."""

from __future__ import annotations

from vision.yolo.training import Stage, TrainingSettings

HELD_OUT_SEED = 10_000_000
"""Seed of the scenes the model is judged on. No training seed comes near it."""

HELD_OUT_SIZE = (640, 480)
"""Width and height of those scenes, pixels: the size of the built-in vehicle's camera."""

DEFAULT_RECIPE = TrainingSettings(
    class_names=("person", "bicycle", "car", "truck", "boat", "dog", "chair"),
    depth_multiple=1 / 3,
    width_multiple=0.125,
    max_channels=1024,
    stages=(Stage(320, 256, 16, 2400), Stage(640, 480, 8, 300)),
    learning_rate=3e-3,
    decay_steps=700,
    seed=1,
    threads=2,
    workers=1,
)
