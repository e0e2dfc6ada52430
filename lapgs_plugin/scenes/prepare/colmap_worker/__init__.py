"""Run the long steps of COLMAP in a separate process; see `__main__.py`."""
