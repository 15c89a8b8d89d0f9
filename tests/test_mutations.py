"""The table of wrong code that tests must notice fits the code and the tests; `make mutations` tries it."""

import mutations
import pytest


def test_every_mutation_has_its_text_once_and_its_tests() -> None:
    assert mutations.faults() == []


def test_a_text_that_is_gone_and_a_test_that_is_gone_are_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = mutations.mutation("odd", "files/seal.py", "no such text", "", "test_of_nothing")
    monkeypatch.setattr(mutations, "MUTATIONS", (wrong,))
    text, test = mutations.faults()
    assert "its text stands 0 times in gmem_jax/files/seal.py" in text
    assert "0 files have the test test_of_nothing" in test
