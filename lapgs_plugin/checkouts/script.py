"""Run a checkout's training script as Python would, in two steps: definitions, then main block.

Symbols are replaced between the two, when everything that the script defines and imports exists.
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType, TracebackType

from lapgs_plugin.checkouts.other_trainers import known_trainer
from lapgs_plugin.checkouts.rewriting import FUTURE
from lapgs_plugin.checkouts.syntax import file_of_script, parsed
from lapgs_plugin.errors import UserInputError

INSTALLED = {"site-packages", "dist-packages"}
"""Names of folders of installed packages."""


@dataclass(frozen=True)
class Script:
    """Hold a script whose definitions have been executed.

    Attributes:
        path: absolute path of the script.
        module: the script's namespace, `__main__` while it is loaded.
    """

    path: Path
    module: ModuleType
    _main: CodeType

    def run_main(self) -> None:
        """Execute the main block. Its exceptions, including SystemExit and KeyboardInterrupt, are passed on."""
        exec(self._main, self.module.__dict__)


def frames_of_script(error: BaseException) -> TracebackType | None:
    """Return the part of an exception's traceback that begins in a script; None if no script was executed."""
    frames = error.__traceback__
    while frames is not None and frames.tb_frame.f_code.co_filename != __file__:
        frames = frames.tb_next
    while frames is not None and frames.tb_frame.f_code.co_filename == __file__:
        frames = frames.tb_next
    return frames


def require_script(path: Path) -> Path:
    """Return the absolute path of a script, or of its target if it is a link.

    Raises:
        UserInputError: it is not a file.
    """
    if not path.is_file():
        advice = (
            known_trainer(path) or "expected the training script of a checkout, as in `lapgs run train.py -s SCENE`"
        )
        raise UserInputError(f"{path} is not a file; {advice}")
    return file_of_script(path)


@contextmanager
def loaded_script(path: Path, arguments: Sequence[str]) -> Iterator[Script]:
    """Execute the definitions of a script in a fresh `__main__`, with its arguments in `sys.argv`.

    The script's folder takes the place of the launcher's in `sys.path`, as with `python`. At the end
    `sys.argv`, `sys.path`, the standard streams (some checkouts replace them) and `__main__` are restored.
    The checkout's modules are removed from `sys.modules`: another checkout may have modules of the same names.

    Raises:
        UserInputError: it is not Python, or has no main block.
    """
    path = require_script(path)
    definitions, main = _split(parsed(path), path)
    module = ModuleType("__main__")
    module.__file__ = str(path)
    before = sys.argv, sys.path[:], sys.stdout, sys.stderr, sys.modules["__main__"]
    known = set(sys.modules)
    sys.path[: _is_launcher(Path(sys.argv[0]))] = [str(path.parent)]
    sys.argv = [str(path), *arguments]
    sys.modules["__main__"] = module
    try:
        exec(definitions, module.__dict__)
        yield Script(path, module, main)
    finally:
        # Some scripts lie in a folder of the checkout, and add its root themselves.
        folders = {path.parent, *set(path.parents).intersection(map(_plain, set(sys.path).difference(before[1])))}
        sys.argv, sys.path[:], sys.stdout, sys.stderr, sys.modules["__main__"] = before
        # All are found before any is removed: a package without an __init__ looks up its parent when it is inspected.
        for name in [name for name in set(sys.modules) - known if _is_under(sys.modules[name], folders)]:
            del sys.modules[name]


def _is_launcher(program: Path) -> bool:
    """Return whether Python put the folder of `lapgs`, or of `python -m lapgs_plugin`, first in `sys.path`."""
    return (program.stem == "lapgs" or program.parent.name == "lapgs_plugin") and not sys.flags.safe_path


def _split(tree: ast.Module, path: Path) -> tuple[CodeType, CodeType]:
    """Return the script without its main block, and the main block, both with the script's line numbers."""
    blocks = [node for node in tree.body if _is_main_block(node)]
    if not blocks:
        raise UserInputError(
            f'{path} has no `if __name__ == "__main__":` block; expected the training script of a 3DGS checkout'
        )
    main = ast.Module(body=list(blocks), type_ignores=[])
    definitions = ast.Module(body=[node for node in tree.body if node not in blocks], type_ignores=[])
    # dont_inherit: the script must not get this file's future statements. Its own are among its definitions.
    defining = compile(definitions, str(path), "exec", dont_inherit=True)
    return defining, compile(main, str(path), "exec", defining.co_flags & FUTURE, dont_inherit=True)


def _is_main_block(node: ast.stmt) -> bool:
    if not isinstance(node, ast.If) or not isinstance(node.test, ast.Compare):
        return False
    sides = [node.test.left, *node.test.comparators]
    names = [side.id for side in sides if isinstance(side, ast.Name)]
    values = [side.value for side in sides if isinstance(side, ast.Constant)]
    return names == ["__name__"] and values == ["__main__"]


def _plain(entry: str) -> Path:
    """Return an absolute path without `..`; links stay."""
    return Path(os.path.normpath(Path(entry).absolute()))


def _is_under(module: ModuleType | None, folders: Iterable[Path]) -> bool:
    """Return whether a module lies in one of these folders, and is not installed in an environment there."""
    # Entries of `sys.modules` may be objects that have any attribute, including `__path__`.
    known = getattr(module, "__dict__", {})
    package = known.get("__path__")
    entries = [known.get("__file__"), *(package if isinstance(package, Iterable) else ())]
    places = [_plain(entry) for entry in entries if isinstance(entry, str)]
    own = [place for place in places if INSTALLED.isdisjoint(place.parts)]
    return any(place.is_relative_to(folder) for place in own for folder in folders)
