"""What pyproject.toml cannot say: `docs/` and `patches/`, at the top of the repository, go into the package."""

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

DOCS = "lapgs_plugin.docs"


class PagesOfDocs(build_py):
    """Leave out the scripts of `docs/`."""

    def find_package_modules(self, package, package_dir):
        return [] if package == DOCS else super().find_package_modules(package, package_dir)


setup(
    packages=[*find_packages(include=["lapgs_plugin*", "lapgs_bench*"]), DOCS, "lapgs_plugin.patches"],
    package_dir={DOCS: "docs", "lapgs_plugin.patches": "patches"},
    cmdclass={"build_py": PagesOfDocs},
)
