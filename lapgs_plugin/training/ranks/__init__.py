"""Share the views of each step out over several processes, the ranks of a run."""
