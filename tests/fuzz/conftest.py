"""One process that reads cases, and one set of whole files, for all tests of a session."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.fuzz.harness import Fuzzer, Reader


@pytest.fixture(scope="session")
def fuzzer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fuzzer]:
    from tests.fuzz.templates import make_templates  # not here: a GPU machine may lack what writes its photos

    scratch = tmp_path_factory.mktemp("fuzz")
    with Reader(scratch / "work") as reader:
        yield Fuzzer(make_templates(scratch / "templates", reader), scratch / "work", reader)
