"""Hold what a stage is for any trainer: its run, its images, its measurements, joint training."""
