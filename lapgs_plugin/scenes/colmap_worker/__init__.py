"""COLMAP's long steps as a program of their own; see `__main__.py`."""
