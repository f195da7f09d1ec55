"""Learning and its data: collected frames, training, evaluation, policies."""
