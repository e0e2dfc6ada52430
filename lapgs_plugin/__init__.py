"""Laplacian frequency hierarchies for 3D Gaussian Splatting codebases.

Importing this package pulls in neither torch nor a backbone, so that `lapgs --help` is instant.
"""

__version__ = "0.1.0"
