"""Apply small anchored edits to the sources of CUDA extensions and revert them: the engine of `lapgs patch`.

`recipe` reads the edits of each extension from `patches/*.toml`, `tokens` finds code by tokens instead of lines,
`blocks` marks an edit in a file, `engine` plans the changes, and `files` writes all files or none. Training never
patches anything.
"""
