"""The one thing that pyproject.toml cannot say: `patches/` stands at the top of the repository, and inside the package."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["lapgs_plugin*"]), "lapgs_plugin.patches"],
    package_dir={"lapgs_plugin.patches": "patches"},
)
