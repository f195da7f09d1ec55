"""Commands that look through a camera without flying: detect, preview, markers, calibrate."""
