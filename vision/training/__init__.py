"""Training of a YOLO network: losses, batches, recipe, fine-tuning on labelled images."""
