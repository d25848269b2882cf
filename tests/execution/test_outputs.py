"""Outputs are kept by what they were computed from; what is partial is replaced."""

from __future__ import annotations

from pathlib import Path

import pytest

from reseau.execution import Outputs

ABOUT = {"compute": "length", "unit": "px"}


@pytest.fixture
def made() -> list[str]:
    return []


def output(outputs: Outputs, made: list[str], name: str = "ab12") -> bytes:
    def compute() -> bytes:
        made.append(name)
        return f"length of {name}".encode()

    return outputs.read(outputs.made({"image": name}, compute))


def test_what_exists_is_not_computed_again(tmp_path: Path, made: list[str]) -> None:
    for _ in range(3):
        assert output(Outputs(str(tmp_path), ABOUT), made) == b"length of ab12"
    assert made == ["ab12"]


@pytest.mark.parametrize(
    ("about", "name"), [(ABOUT, "cd34"), (ABOUT | {"unit": "mm"}, "ab12"), ({"compute": "width"}, "ab12")]
)
def test_other_inputs_or_parameters_are_another_output(
    tmp_path: Path, made: list[str], about: dict[str, str], name: str
) -> None:
    output(Outputs(str(tmp_path), ABOUT), made)
    output(Outputs(str(tmp_path), about), made, name)
    assert len(made) == 2


def test_the_order_of_parameters_does_not_matter(tmp_path: Path, made: list[str]) -> None:
    output(Outputs(str(tmp_path), ABOUT), made)
    output(Outputs(str(tmp_path), dict(reversed(ABOUT.items()))), made)
    assert made == ["ab12"]


@pytest.mark.parametrize("which", ["record", "output"])
@pytest.mark.parametrize("how", ["empty", "cut", "lost", "other"])
def test_what_is_damaged_is_replaced(tmp_path: Path, made: list[str], which: str, how: str) -> None:
    outputs = Outputs(str(tmp_path), ABOUT)
    output(outputs, made)
    records = list(tmp_path.glob("records/*/*.json"))
    (path,) = (
        records if which == "record" else [p for p in tmp_path.glob("*/*.json") if "records" not in str(p)]
    )
    if how == "lost":
        path.unlink()
    else:
        path.write_bytes({"empty": b"", "cut": path.read_bytes()[:5], "other": b'{"sha256": 7}'}[how])
    assert output(outputs, made) == b"length of ab12"
    assert made == ["ab12", "ab12"]
    assert output(outputs, made) == b"length of ab12"
    assert len(made) == 2


def test_a_computation_that_fails_keeps_nothing(tmp_path: Path, made: list[str]) -> None:
    outputs = Outputs(str(tmp_path), ABOUT)
    with pytest.raises(ZeroDivisionError):
        outputs.made({"image": "ab12"}, lambda: bytes(1 // 0))
    assert not list(tmp_path.rglob("*.json"))
    assert output(outputs, made) == b"length of ab12"


def test_a_record_says_how_its_output_came_about(tmp_path: Path, made: list[str]) -> None:
    import json

    output(Outputs(str(tmp_path), ABOUT), made)
    (path,) = tmp_path.glob("records/*/*.json")
    record = json.loads(path.read_text())
    assert record["schema"] == "reseau-output/1"
    assert record["about"] == ABOUT
    assert record["inputs"] == {"image": "ab12"}


def test_a_store_may_be_a_url(made: list[str]) -> None:
    place = "memory://test-outputs"
    for _ in range(2):
        assert output(Outputs(place, ABOUT), made) == b"length of ab12"
    assert made == ["ab12"]
