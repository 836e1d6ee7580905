"""Claims keep their bounds, and README has their sentences word for word."""

from __future__ import annotations

import pytest

from studies import claims

ROOT = claims.ROOT


def words(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize("claim", claims.CLAIMS, ids=lambda claim: claim.text[:40])
def test_a_claim_keeps_its_bounds(claim):
    figures = claim.found()
    assert set(claim.bounds) <= set(figures)
    for name, (least, most) in claim.bounds.items():
        assert least <= figures[name] <= most, f"{name} of: {claim.sentence()}"


@pytest.mark.parametrize("claim", [one for one in claims.CLAIMS if one.in_readme], ids=lambda claim: claim.text[:40])
def test_readme_has_the_sentence(claim):
    assert words(claim.sentence()) in words((ROOT / "README.md").read_text())


@pytest.mark.parametrize("claim", [one for one in claims.CLAIMS if one.in_paper], ids=lambda claim: claim.text[:40])
def test_the_paper_has_the_sentence(claim):
    assert words(claim.sentence()) in words((ROOT / "paper" / "paper.md").read_text())


def test_readme_has_the_table_of_speeds():
    assert claims.table_of_speeds() in (ROOT / "README.md").read_text()


def test_the_page_is_up_to_date():
    """`python -m studies.claims` makes it."""
    assert claims.PAGE.read_text() == claims.page()


@pytest.mark.parametrize("claim", claims.TESTED, ids=lambda claim: claim.text[:40])
def test_tests_that_claims_name_are_there(claim):
    for name in claim.tests:
        path, _, function = name.partition("::")
        assert (ROOT / path).exists()
        assert not function or f"def {function}(" in (ROOT / path).read_text()
