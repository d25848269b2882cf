"""`reseau schema`: documents that the project writes are valid, and no kind of document is missing."""

from __future__ import annotations

import importlib
import json
import pkgutil
from collections.abc import Iterator

import pytest

import reseau
from reseau.cli import run
from reseau.cli.program import documents
from reseau.designs import coded_testfield
from reseau.io.document import Document


def kinds(of: type[Document]) -> Iterator[type[Document]]:
    for kind in of.__subclasses__():
        yield kind
        yield from kinds(kind)


def test_every_kind_of_document_has_a_schema() -> None:
    for module in pkgutil.walk_packages(reseau.__path__, "reseau."):
        importlib.import_module(module.name)
    own = {kind for kind in kinds(Document) if kind.__module__.startswith("reseau.")}
    assert {kind.SCHEMA for kind in own} == set(documents())


def test_a_document_is_valid_by_its_schema_and_another_key_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    assert run(["schema", "testfield-design/1"]) == 0
    schema = json.loads(capsys.readouterr().out)
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    design = coded_testfield().to_dict()
    validator.validate(design)
    assert "not_a_key" in next(validator.iter_errors(design | {"not_a_key": 1})).message
    assert "'testfield-design/1'" in next(validator.iter_errors(design | {"schema": "other/1"})).message


def test_all_schemas_are_listed_and_an_unknown_name_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["schema"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(documents())
    assert run(["schema", "reseau-net/1"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_without_the_packages_of_an_extra_the_other_schemas_are_listed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def imported(name: str) -> object:
        if name == "reseau.capture.bench":
            raise ModuleNotFoundError("No module named 'bluesky'", name="bluesky")
        return importlib.import_module(name)

    monkeypatch.setattr("reseau.cli.program.import_module", imported)
    assert run(["schema"]) == 0
    printed = capsys.readouterr()
    assert "reseau-network/1" in printed.out
    assert "reseau-bench/1" not in printed.out
    assert "left out: needs bluesky, which is not installed; pip install 'reseau[bench]'" in printed.err
    assert run(["schema", "reseau-network/1"]) == 0
    assert capsys.readouterr().err == ""
