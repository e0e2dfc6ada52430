"""Show a run in a web browser, band by band: `lapgs view` and `--view`. The page is viser's, the pictures are ours."""
