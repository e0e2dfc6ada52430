"""What pyproject.toml cannot say: `patches/`, at the top of the repository, is installed inside the package."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["lapgs_plugin*"]), "lapgs_plugin.patches"],
    package_dir={"lapgs_plugin.patches": "patches"},
)
