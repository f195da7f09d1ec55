"""The visible world: solids, colours and textures of its objects."""
