"""Hold one file for each backbone that `lapgs run` drives, their base class and their registry."""
