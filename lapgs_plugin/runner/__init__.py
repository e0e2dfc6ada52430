"""Drive a checkout's own training script as a hierarchy: `lapgs run`."""
