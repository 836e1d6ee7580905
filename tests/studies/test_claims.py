"""Claims keep their bounds, and README and the draft of the paper have them with the figures of the records."""

import re
from dataclasses import replace

import pytest

from studies import claims, readme, trust

ROOT = trust.ROOT
#: What would have to be measured: a number with a unit of results. Times, masses and steps are settings.
MEASURED = re.compile(r"\d[\d.]*\s*(?:%|times\b|K\b|kJ|ns/day|ns a day)|\w+fold\b")


def words(text: str) -> str:
    return " ".join(text.split())


# --- the list ---


def test_claims_keep_their_bounds():
    assert {claim.text: claim.broken() for claim in claims.CLAIMS if claim.broken()} == {}


def test_a_broken_bound_is_named():
    """Each bound alone, set above its figure."""
    for claim in claims.CLAIMS:
        assert claim.bounds
        figures = claim.found()
        for name in claim.bounds:
            above = figures[name] + max(abs(figures[name]), 1) / 2
            (broken,) = replace(claim, bounds={name: (above, trust.ANY)}).broken()
            assert broken.startswith(trust.in_words(name, (above, trust.ANY)))


def test_a_figure_that_is_not_known_keeps_no_bound():
    unknown = trust.Claim("{gain:.1f}", "whole-run.json", lambda _: {"gain": float("nan")}, {"gain": (0, trust.ANY)})
    assert unknown.broken() == ["gain ≥ 0, got nan"]


def test_a_record_without_the_row_is_named():
    lacking = trust.Claim("It is {gain:.1f}.", "whole-run.json", claims.figures.gain(liquid="ice"), {})
    with pytest.raises(LookupError, match=r"'It is {gain:.1f}.': 0 rows .*ice"):
        lacking.sentence()


# --- what is made of it ---


def test_the_page_lists_every_claim():
    page = (ROOT / "docs" / "measurements" / "trust.md").read_text()
    for topic, listed in claims.TOPICS.items():
        assert f'claims("{topic}")' in page
        assert trust.listed(listed).count("Bounds: ") == len(listed)


@pytest.mark.parametrize(("text", "claimed_by"), [("README.md", "in_readme"), ("paper/paper.md", "in_paper")])
def test_a_text_has_its_claims_with_the_figures_of_the_records(text, claimed_by):
    """Word for word."""
    has = words((ROOT / text).read_text())
    sentences = [words(claim.sentence()) for claim in claims.CLAIMS if getattr(claim, claimed_by)]
    assert sentences
    missing = [sentence for sentence in sentences if sentence not in has]
    assert not missing, "\n".join([f"{text} should have:", *missing])


def test_readme_has_the_list_of_uses():
    assert readme.uses() in (ROOT / "README.md").read_text(), f"README.md should have:\n{readme.uses()}"


def test_readme_has_no_figure_of_its_own():
    """Neither in sentences nor in tables."""
    text = (ROOT / "README.md").read_text()
    text = words(re.sub(r"```.*?```|^ {4}.*?$", "", text, flags=re.DOTALL | re.MULTILINE))
    for claim in claims.CLAIMS:
        if claim.in_readme:
            text = text.replace(words(claim.sentence()), "")
    assert MEASURED.findall(text) == []


def test_figures_of_its_own_are_found():
    assert len(MEASURED.findall("a gain of 3.5 times and 4 %, 2 to 3 K too cold, threefold, at 4 fs, 4 dalton")) == 4
