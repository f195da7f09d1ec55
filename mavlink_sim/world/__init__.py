"""What there is to see: the solids, colours and textures of what stands on the ground."""
