"""Hold the parts of a stage that every trainer needs: its run, its images, its measurements, joint training."""
