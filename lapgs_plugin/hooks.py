"""Where code can step into a stage: the hooks, what they are told, and the order in which they run."""
